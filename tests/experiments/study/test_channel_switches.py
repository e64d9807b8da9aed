"""Impairments on and off: every combination keeps the contract, and the agents are those that a comparison left."""

from dataclasses import replace
from itertools import combinations
from unittest import mock

import gymnasium as gym
import pytest

from experiments.backends.execution import results_of
from experiments.runs.arms import run_of_arm
from experiments.runs.loops import certificate_of, changed_channel, loop_config
from experiments.settings import CompareSettings
from experiments.settings.learning import NETWORK_ENVS
from experiments.study.channel_switches import SWITCHES, channel_switches, switched, trained_agents
from ncs_gym.envs.env import ncs_env
from tests.workers import no_worker_processes

TANK = NETWORK_ENVS[0]


@pytest.mark.parametrize("env_id", [*NETWORK_ENVS, "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/CartPole-v0"])
def test_every_combination_keeps_the_contract_and_has_what_is_on(env_id):
    env = ncs_env(gym.make(env_id))
    for count in range(len(SWITCHES) + 1):
        for on in combinations(SWITCHES, count):
            channel = changed_channel(env.channel, switched(env.channel, env.contract, on)) or env.channel
            assert env.contract is None or env.contract.is_kept_by(channel)
            assert (
                channel.loss > 0.0,
                channel.delay > 0,
                channel.send_period > 1,
                channel.quantization_step > 0.0,
            ) == (tuple(name in on for name in SWITCHES))


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A comparison with two short trainings behind lookahead, and its agents."""
    settings = CompareSettings(
        env=TANK,
        arms=("lookahead",),
        seeds=2,
        steps=256,
        hyperparams=dict(n_envs=8, n_steps=32, batch_size=64),
        episodes=2,
        jobs=1,
        safe_set="ellipsoid",
        out=tmp_path_factory.mktemp("trained"),
    )
    loop = loop_config(TANK)
    certificate = certificate_of(loop, safe_set="ellipsoid")
    runs = [run_of_arm(settings.completed, loop, certificate, "lookahead", index) for index in range(2)]
    with no_worker_processes():
        results_of(runs, settings.out, settings)
    return settings, trained_agents(settings)


@pytest.mark.slow
def test_agents_are_those_that_the_comparison_left(compared):
    settings, agents = compared
    assert tuple(agents) == ("lookahead",)
    for index, files in enumerate(agents["lookahead"]):
        folder = settings.out / "models" / f"lookahead-{index}"
        assert files == {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(FileNotFoundError, match="lookahead-2"):
        trained_agents(replace(settings, seeds=3))


@pytest.mark.slow
def test_losses_decide_for_the_regulator_and_nothing_breaks_lookahead(compared):
    settings, agents = compared
    settings = replace(settings, episodes=12, out=settings.out / "channels")
    two = {"SWITCHES": ("loss",), "SWITCHED_REGULATORS": ("lqr", "lqr+lookahead")}
    with no_worker_processes(), mock.patch.multiple("experiments.study.channel_switches", **two):
        rows = channel_switches(settings, agents)
        assert channel_switches(settings, agents) == rows  # read again
    violating = {(tuple(row["on"]), row["arm"]): row["violating"] for row in rows}
    assert violating[(), "lqr"] == 0
    assert violating[("loss",), "lqr"] >= 3
    assert all(count == 0 for (_, arm), count in violating.items() if arm.endswith("lookahead"))
    of_agents = [row for row in rows if row["arm"] == "lookahead"]
    assert all((row["episodes"], row["policies"]) == (12, 2) for row in of_agents)
