"""The command that draws an episode, and the policies it plays."""

import gymnasium as gym
import pytest
from PIL import Image

from agents.loop import LoopConfig
from agents.training import untrained
from experiments.commands.render import RenderSettings, render
from experiments.runs.policies import policy_by_name
from ncs_gym.rendering import theme
from tests.command import succeeded

CRUISE = "ncs_gym/TruckTrailerCruise-v0"


@pytest.fixture(scope="module")
def certificate_file(certificate, tmp_path_factory):
    file = tmp_path_factory.mktemp("certificate") / "c.json"
    certificate.save(file)
    return file


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A saved agent that has learned nothing."""
    folder, agent = tmp_path_factory.mktemp("model"), untrained(LoopConfig(env=CRUISE), seed=0)
    agent.save(folder)
    return folder, agent


def settings(**changes):
    return RenderSettings(**({"steps": 3} | changes))


def test_command_writes_a_gif_of_both_arms_below_two_megabytes(tmp_path, certificate_file):
    file = tmp_path / "both.gif"
    run = succeeded("render", "--out", file, "--side-by-side", "--steps", 15, "--certificate", certificate_file)
    assert file.stat().st_size < 2e6
    with Image.open(file) as image:
        assert (image.n_frames, image.height) == (16, theme.HEIGHT)
        assert image.width > 2 * theme.WIDTH
        assert image.info["duration"] == 100
        assert image.info["loop"] == 0
    unshielded, shielded, saved = run.stdout.splitlines()
    assert unshielded.startswith("no shield: 15 steps, ")
    assert " 0 with a violation" not in unshielded
    assert shielded.startswith("project: 15 steps, 0 with a violation, shield acted ")
    assert str(file) in saved


def test_episode_that_ends_early_ends_the_animation(tmp_path, capsys):
    render(settings(env="ncs_gym/CSTR-v0", policy="random", shield="none", steps=100, out=tmp_path / "a.gif"))
    with Image.open(tmp_path / "a.gif") as image:
        assert 2 < image.n_frames < 100
    assert "1 with a violation" in capsys.readouterr().out


def test_model_of_another_environment_is_refused(model):
    with pytest.raises(ValueError, match=r"was trained in ncs_gym/TruckTrailerCruise-v0, not in ncs_gym/CartPole-v0"):
        policy_by_name(str(model[0]), "ncs_gym/CartPole-v0", gym.make("ncs_gym/CartPole-v0").unwrapped, 0)
