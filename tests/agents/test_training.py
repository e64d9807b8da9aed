from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorWrapper
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import KVWriter, Logger

from agents import SafetyCallback, SB3VecEnv
from agents.loop import LoopConfig, ShieldSettings
from agents.training import require_trainable, train, untrained
from tests.certificates import certificate_of

CRUISE = LoopConfig(env="ncs_gym/TruckTrailerCruise-v0")
TINY = dict(n_envs=4, n_steps=64, batch_size=128, n_epochs=1)
TINY_REPLAY = dict(n_envs=4, gradient_steps=1, batch_size=32, buffer_size=1000, learning_starts=64)
OBSERVATIONS = np.random.default_rng(0).standard_normal((20, 3))


def shielded(mode="project", env=CRUISE.env):
    plant = CRUISE.single().unwrapped.plant
    return LoopConfig(env=env, shield=ShieldSettings(certificate_of(plant), mode))


@cache
def trained(mode=None, steps=256, seed=3):
    """A short training, the same for all tests that look at it."""
    return train(CRUISE if mode is None else shielded(mode), steps, seed, hyperparams=TINY)


def actions_of(result):
    return result.agent.act(OBSERVATIONS)


def test_same_seed_trains_the_same_agent():
    first, second = trained(), train(CRUISE, 256, 3, hyperparams=TINY)
    np.testing.assert_array_equal(actions_of(first), actions_of(second))
    assert [point.violation_steps for point in first.history] == [point.violation_steps for point in second.history]
    assert (actions_of(trained(seed=4)) != actions_of(first)).any()
    start, again = (untrained(CRUISE, 3, hyperparams=TINY) for _ in range(2))
    assert start.checksum == again.checksum != first.agent.checksum  # a single rollout is learned from


def test_training_counts_every_violating_step(monkeypatch):
    # Counted again from the true states, at every step of the vector environment.
    counted = []

    class Counter(VectorWrapper):
        def step(self, actions):
            result = self.env.step(actions)
            states = result[4]["state"] @ self.env.unwrapped.plant.box.T
            counted.extend((np.abs(states).max(axis=1) > 1.0).tolist())
            return result

    make_vec, reported = gym.make_vec, []
    monkeypatch.setattr(gym, "make_vec", lambda *arguments, **keywords: Counter(make_vec(*arguments, **keywords)))
    result = train(CRUISE, 512, 0, hyperparams=TINY, on_progress=reported.append)
    assert result.steps == len(counted) == sum(reported) == 512
    assert result.violation_steps == sum(counted) > 0
    assert result.history[-1].violation_steps == result.violation_steps
    assert result.interventions == 0


def test_monitored_training_is_the_unshielded_one_and_counts_what_the_shield_would_do():
    one, other = trained("monitor"), trained()
    np.testing.assert_array_equal(actions_of(one), actions_of(other))
    assert one.violation_steps == other.violation_steps > 0
    assert one.interventions > 0


@pytest.mark.cases(1)
@pytest.mark.parametrize(
    ("algorithm", "settings", "again"),
    [
        ("A2C", dict(n_envs=4, n_steps=8), True),
        ("TRPO", dict(n_envs=4, n_steps=64, batch_size=128, n_critic_updates=2), False),
        *((name, TINY_REPLAY, name == "SAC") for name in ("SAC", "TD3", "TQC", "CrossQ")),
    ],
)
def test_every_algorithm_trains_counts_and_repeats_itself(algorithm, settings, again):
    first = train(shielded(), 320, 3, algorithm, settings)
    assert first.steps >= 320
    assert first.violation_steps == 0 < first.interventions
    assert [point.steps for point in first.history] == sorted({point.steps for point in first.history})
    assert first.history[-1].steps == first.steps
    assert len(first.history) <= 201
    if again:
        second = train(shielded(), 320, 3, algorithm, settings)
        assert (second.steps, second.interventions) == (first.steps, first.interventions)
        np.testing.assert_array_equal(actions_of(first), actions_of(second))


def test_rate_falls_from_its_full_value_to_that_of_the_last_rollout_unless_it_is_constant():
    constant, falling = (
        train(CRUISE, 2 * 256, 0, hyperparams=TINY | rate).agent for rate in ({"learning_rate": 0.003}, {})
    )
    assert [falling.model.lr_schedule(remaining) for remaining in (0.5, 0.0)] == pytest.approx([0.003, 0.0015])
    assert constant.model.lr_schedule(0.5) == pytest.approx(0.003)
    assert constant.checksum != falling.checksum


@pytest.mark.cases(1)
@pytest.mark.parametrize("change", [{"ent_coef": 0.1}, {"normalize": {"norm_reward": False}}, None])
def test_entropy_normalization_of_rewards_and_violation_penalty_change_what_is_learned(change):
    loop = LoopConfig(env=CRUISE.env, violation_penalty=5.0 * (change is None))
    agent = train(loop, 256, 3, hyperparams=TINY | (change or {})).agent
    assert agent.checksum != trained().agent.checksum


def test_missing_package_is_one_sentence(monkeypatch):
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"TQC needs sb3-contrib: in .*, pip install -e '\.\[contrib\]'$"):
        train(CRUISE, 64, 0, "TQC", TINY_REPLAY)


class Dumps(KVWriter):
    """What reaches a log, and at which step."""

    def __init__(self):
        self.found = []

    def write(self, key_values, key_excluded, step=0):
        self.found.append((step, dict(key_values)))

    def close(self):
        pass


class Steps(BaseCallback):
    """What happened in every step of each environment."""

    def __init__(self):
        super().__init__()
        self.rows = []

    def _on_step(self):
        names = "cost", "shield_intervened", "shield_correction", "shield_guaranteed"
        self.rows.append([[float(info.get(name, 0.0)) for name in names] for info in self.locals["infos"]])
        return True


def logged_alike(model, steps, log_interval, callback=None):
    """Learns, and compares every log with the steps since the last one; returns the callback."""
    dumps, seen, callback = Dumps(), Steps(), callback or SafetyCallback()
    model.set_logger(Logger(None, [dumps]))
    model.learn(steps, callback=[seen, callback], log_interval=log_interval)
    rows, start = np.array(seen.rows), 0
    names = "violation_rate", "intervention_rate", "mean_correction", "guaranteed_rate"
    logs = [(step, values) for step, values in dumps.found if "safety/violation_rate" in values]
    assert len(logs) > 1
    for step, values in logs:
        stop = step // rows.shape[1]
        found = [values[f"safety/{name}"] for name in names]
        np.testing.assert_allclose(found, rows[start:stop].mean(axis=(0, 1)), rtol=1e-9)
        start = stop
    assert [callback.violation_steps, callback.interventions] == rows.sum(axis=(0, 1))[:2].tolist()
    last = callback.history[-1]
    assert (last.violation_steps, last.interventions) == (callback.violation_steps, callback.interventions)
    assert last.steps == model.num_timesteps
    return callback


@pytest.mark.cases(1)
@pytest.mark.parametrize("kind", ["SB3VecEnv", "make_vec_env"])
def test_logs_are_about_all_steps_since_the_last_one(kind):
    monitored = shielded("monitor")
    env = SB3VecEnv(monitored.vector(4)) if kind == "SB3VecEnv" else make_vec_env(monitored.single, n_envs=4, seed=0)
    tiny = {"n_steps": 16, "batch_size": 64, "n_epochs": 1, "device": "cpu", "seed": 0}
    model = PPO("MlpPolicy", env, **tiny)
    callback = logged_alike(model, 64 * 6, 2)
    assert callback.violation_steps > 0
    again = logged_alike(PPO("MlpPolicy", env, **tiny), 64 * 4, 1, callback)  # which counts its steps anew
    assert again.violation_steps == again.history[-1].violation_steps < 64 * 4


def test_what_the_library_takes_is_not_refused():
    linear = {"clip_range": "lin_0.2", "target_kl": None, "normalize": {"norm_reward": False, "clip_obs": 5}}
    require_trainable(CRUISE, 100_000, "PPO", linear | {"gamma": 1, "use_sde": True})
    require_trainable(CRUISE, 100_000, "SAC", {"ent_coef": 0.1, "noise_std": 0.1})
