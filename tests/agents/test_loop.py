from dataclasses import replace

import numpy as np
import pytest

from agents.loop import CostPenalty, LoopConfig, ShieldSettings
from experiments.baselines.filters import EstimateFilterSettings
from ncs_gym import Channel
from shields import SafetyShield, VectorSafetyShield

CRUISE = "ncs_gym/TruckTrailerCruise-v0"


def test_it_shields_only_if_asked(certificate):
    bare, shielded = LoopConfig(env=CRUISE), LoopConfig(env=CRUISE, shield=ShieldSettings(certificate, "switch", 0.5))
    assert not isinstance(bare.single(), SafetyShield)
    assert not isinstance(bare.vector(2), VectorSafetyShield)
    assert (shielded.single().penalty, shielded.single().filter.mode) == (0.5, "switch")
    assert (shielded.vector(2).penalty, shielded.vector(2).filter.mode) == (0.5, "switch")
    planning = LoopConfig(env=CRUISE, shield=ShieldSettings(certificate, "lookahead", horizon=4))
    assert planning.single().filter.horizon == planning.without_penalties.vector(2).filter.horizon == 4


def test_channel_and_downlink_reach_both_kinds_of_environment():
    env = "ncs_gym/TruckTrailerCruiseTwoWay-v0"
    assert LoopConfig(env=env).single().unwrapped.downlink_protocol.input_delay == 3
    loop = LoopConfig(env=env, kwargs={"channel": Channel(delay=7), "downlink": Channel(delay=1)})
    for made in (loop.single().unwrapped, loop.vector(2).unwrapped):
        assert (made.channel.delay, made.downlink_protocol.input_delay) == (7, 1)


@pytest.mark.parametrize("autoreset", ["NextStep", "SameStep"])
def test_every_violating_step_has_its_penalty(autoreset):
    def played(penalty):
        envs = LoopConfig(env=CRUISE, violation_penalty=penalty).vector(3, autoreset_mode=autoreset)
        envs.reset(seed=0)
        steps = [envs.step(np.ones((3, 1), np.float32)) for _ in range(201)]
        if autoreset == "NextStep":
            costs = [info["cost"] for *_, info in steps]
        else:
            none = {"cost": np.zeros(3)}
            costs = [np.where(cut, info.get("final_info", none)["cost"], info["cost"]) for *_, cut, info in steps]
        return np.array([step[1] for step in steps]), np.array(costs)

    (free, costs), (penalized, _) = played(0.0), played(2.0)
    assert costs.sum() > 0
    np.testing.assert_allclose(free - penalized, 2.0 * costs)


def test_loop_without_penalties_has_the_environments_own_rewards(certificate):
    loop = LoopConfig(env=CRUISE, shield=ShieldSettings(certificate, penalty=1.0), violation_penalty=2.0)
    assert isinstance(loop.vector(1), CostPenalty)
    assert not isinstance(loop.without_penalties.vector(1), CostPenalty)
    assert loop.without_penalties.shield.penalty == 0.0
    settings = EstimateFilterSettings("trusting", certificate, penalty=3.0)
    assert LoopConfig(env=CRUISE, filter=settings).without_penalties.filter == replace(settings, penalty=0.0)
    assert LoopConfig(env=CRUISE, filter=own_filter).without_penalties.filter is own_filter


def own_filter(env):
    """A filter about whose rewards nothing is known."""
    return env


def test_changed_arguments_are_those_of_the_changed_loop_alone():
    loop = LoopConfig(env=CRUISE, kwargs={"channel": {"delay": 7}})
    changed = loop.with_kwargs(channel=None, noise="gaussian")
    assert (changed.kwargs, changed.channel) == ({"noise": "gaussian"}, None)
    assert (loop.kwargs, loop.channel) == ({"channel": {"delay": 7}}, Channel(delay=7))
