"""The page of an environment says what the environment is."""

import gymnasium as gym
import pytest

from ncs_gym import Channel, register_plant
from ncs_gym.registration import registered_ids
from tests.product import linear_plant, safety_shield
from tests.site.hooks import site_hook

SECTIONS = ["Description", "Action space", "Observation space", "Rewards", "Starting state", "Episode end", "Info"]
SECTIONS += ["Arguments", "Channel and contract", "Certificate", "Version history"]


@pytest.fixture(scope="module")
def pages():
    """The module that writes the pages, which is part of no package."""
    return site_hook("environment_page")


def section(page, title):
    """Text of a section."""
    return page.partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def words(text):
    """Text without its line breaks."""
    return " ".join(str(text).split())


@pytest.mark.parametrize("env_id", registered_ids())
def test_every_environment_has_a_page_with_its_own_figures(pages, env_id):
    env = gym.make(env_id)
    page = pages.environment_page(env_id, "picture.png")
    assert [line[3:] for line in page.splitlines() if line.startswith("## ")] == SECTIONS
    assert all(section(page, title).strip() for title in SECTIONS)
    assert "](picture.png)" in page.partition("\n## ")[0]
    assert "Protocol" not in section(page, "Arguments")
    inner = env.unwrapped
    assert words(inner.plant) in words(section(page, "Description"))
    assert section(page, "Observation space").count("\n| ") == 1 + env.observation_space.shape[0]
    assert words(safety_shield(env).certificate) in words(section(page, "Certificate"))
    assert "hold in exact arithmetic" in section(page, "Certificate")
    ends = "ends the episode" if inner.terminate_on_violation else "does not end the episode"
    assert ends in section(page, "Episode end")


def test_plant_that_is_registered_gets_a_page(pages):
    bounds = dict.fromkeys(("disturbance_bound", "sensor_bound", "initial_bound"), 0.01)
    plant = linear_plant(A=[[0.9]], B=[[0.1]], box=[1.0], u_max=2.0, dt=1.0, **bounds)
    register_plant("Pages/Tank-v0", plant, channel=Channel(loss=0.25, delay=3), max_episode_steps=77)
    try:
        page = pages.environment_page("Pages/Tank-v0")
    finally:
        del gym.registry["Pages/Tank-v0"]
    assert page.startswith("# Tank\n")
    assert "](picture.png)" not in page
    assert "lost with probability 0.25. What is not lost arrives 3 steps late." in section(page, "Channel and contract")
    assert "truncated after 77 steps" in section(page, "Episode end")
    assert "| 0 | u1 | 2 |" in section(page, "Action space")
