"""Trainings that go on from an agent, and that learn what was applied."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

from agents import AppliedActionBuffer, LoopConfig, ShieldSettings, train
from ncs_gym import truck_trailer
from tests.certificates import certificate_of
from tests.product import safety_shield

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


@pytest.mark.cases(1)
@pytest.mark.parametrize("algorithm", ["SAC", "TD3"])
def test_replay_buffers_hold_what_was_applied_if_asked_to(loop, algorithm):
    class Keeping(BaseCallback):
        def __init__(self):
            super().__init__()
            self.applied = []

        def _on_step(self):
            self.applied += self.training_env.unwrapped.batch_info["input"].tolist()
            return True

    keeping, limit = Keeping(), truck_trailer().u_max
    agent = train(loop, 120, 0, algorithm, REPLAY | {"stored_action": "applied"}, callbacks=[keeping]).agent
    stored = agent.model.replay_buffer
    actions = stored.actions[: stored.pos].reshape(-1, 1)
    np.testing.assert_allclose(actions * limit, np.array(keeping.applied), atol=1e-5)
    proposed = train(loop, 120, 0, algorithm, REPLAY).agent.model.replay_buffer
    assert not np.allclose(proposed.actions[: stored.pos].reshape(-1, 1), actions, atol=1e-3)


def test_replay_buffers_refuse_actions_that_a_wrapper_outside_changes():
    def learn(env):
        model = SAC("MlpPolicy", env, learning_starts=50, replay_buffer_class=AppliedActionBuffer, seed=0)
        model.learn(60)

    def shield():
        return safety_shield(gym.make(CRUISE))

    learn(gym.wrappers.RescaleAction(shield(), np.float32(-3.0), np.float32(5.0)))  # stable-baselines3 scales, too
    turned = gym.wrappers.TransformAction(shield(), lambda action: -0.5 * action, None)
    with pytest.raises(ValueError, match="a wrapper outside the shield changes actions"):
        learn(turned)
