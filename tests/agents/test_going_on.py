"""Trainings that go on from an agent."""

import copy

import numpy as np
import pytest
import torch

from agents import LoopConfig, ShieldSettings, train
from ncs_gym import truck_trailer
from tests.certificates import certificate_of

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
SMALL = {"n_envs": 8, "n_steps": 16, "batch_size": 128, "n_epochs": 2}
REPLAY = {"n_envs": 4, "learning_starts": 40, "gradient_steps": 1, "buffer_size": 1000}


@pytest.fixture(scope="module")
def loop():
    return LoopConfig(env=CRUISE, shield=ShieldSettings(certificate_of(truck_trailer(mass=4000.0))))


def test_training_goes_on_from_an_agent(loop):
    first = train(loop, 256, 0, hyperparams=SMALL).agent
    observations = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    still = train(loop, 128, 1, hyperparams=SMALL | {"learning_rate": 1e-12}, start=first).agent
    np.testing.assert_allclose(still.act(observations), first.act(observations), atol=0.05)
    moved = train(loop, 256, 1, hyperparams=SMALL, start=first).agent
    assert moved.checksum != first.checksum
    other = train(loop, 128, 1, hyperparams=SMALL | {"learning_rate": 1e-12}).agent
    assert np.abs(other.act(observations) - first.act(observations)).max() > 0.05
    with pytest.raises(ValueError, match="the agent to go on from is PPO of"):
        train(loop, 512, 0, "A2C", start=first)
    with pytest.raises(ValueError, match="has other networks"):
        train(loop, 512, 0, hyperparams=SMALL | {"policy_kwargs": {"net_arch": [8]}}, start=first)


@pytest.mark.cases(1)
@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_agent_that_a_training_goes_on_from_stays_as_it_is(loop, algorithm):
    small = SMALL if algorithm == "PPO" else REPLAY | {"policy_kwargs": {"net_arch": [8]}}
    first = train(loop, 128, 0, algorithm, small).agent
    before = copy.deepcopy(first.model.get_parameters())
    second, third = (train(loop, 128, 1, algorithm, small, start=first).agent for _ in range(2))
    after = first.model.get_parameters()
    assert after.keys() == before.keys()
    for name, values in before.items():
        torch.testing.assert_close(after[name], values, rtol=0.0, atol=0.0)
    assert second.checksum == third.checksum
