"""The page of an environment says what the environment is."""

import gymnasium as gym
import pytest

from ncs_gym.registration import registered_ids
from tests.product import safety_shield
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
