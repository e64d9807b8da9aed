import copy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorWrapper

from agents.evaluation import evaluate
from agents.settings import PPOSettings
from agents.training import EPISODE_KEYS, Shielding, make_env, train, untrained
from shields import SafetyShield

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
TINY = PPOSettings(envs=4, rollout=64, batch_size=128, epochs=2)


@pytest.fixture(scope="module")
def shielding(certificate):
    return Shielding(certificate)


def test_same_seed_trains_the_same_agent():
    first, second = (train(CRUISE, 512, 3, settings=TINY) for _ in range(2))
    observations = np.random.default_rng(0).standard_normal((20, 3))
    np.testing.assert_array_equal(first.agent.act(observations), second.agent.act(observations))
    assert [point.violation_steps for point in first.history] == [point.violation_steps for point in second.history]
    other = train(CRUISE, 512, 4, settings=TINY)
    assert (other.agent.act(observations) != first.agent.act(observations)).any()


def test_training_counts_every_violating_step(monkeypatch):
    # Counted again from the true states, at every step of the vector environment.
    counted = []

    class Counter(VectorWrapper):
        def step(self, actions):
            result = self.env.step(actions)
            states = result[4]["state"] @ self.env.unwrapped.plant.C.T
            counted.extend((np.abs(states).max(axis=1) > 1.0).tolist())
            return result

    make_vec = gym.make_vec
    monkeypatch.setattr(gym, "make_vec", lambda *arguments, **keywords: Counter(make_vec(*arguments, **keywords)))
    result = train(CRUISE, 2048, 0, settings=TINY)
    assert result.steps == len(counted) == 2048
    assert result.violation_steps == sum(counted) > 0
    assert result.history[-1].violation_steps == result.violation_steps
    assert result.interventions == 0


def test_single_environments_are_counted_alike(shielding, monkeypatch):
    # What has no vector environment is stepped one by one.
    spec = copy.deepcopy(gym.spec(CRUISE))
    spec.id, spec.vector_entry_point = "Scalar-v0", None
    monkeypatch.setitem(gym.registry, "Scalar-v0", spec)
    result = train("Scalar-v0", 1024, 0, shielding, TINY)
    assert result.violation_steps == 0
    assert result.interventions > 20
    assert train("Scalar-v0", 1024, 0, None, TINY).violation_steps > 0


def test_shielded_training_has_no_violation_and_counts_interventions(shielding):
    result = train(CRUISE, 2048, 0, shielding, TINY)
    assert result.violation_steps == 0
    assert result.interventions > 50


def test_rates_reach_tensorboard(shielding, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    result = train(CRUISE, 1024, 0, shielding, TINY, log_folder=tmp_path)
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    tags = events.Tags()["scalars"]
    assert {"safety/violation_rate", "safety/intervention_rate", "safety/violation_steps", "time/fps"} <= set(tags)
    rates = [event.value for event in events.Scalars("safety/intervention_rate")]
    assert sum(rates) * 256 == pytest.approx(result.interventions, abs=1)


def test_monitor_keeps_the_episodes_totals(shielding):
    assert set(EPISODE_KEYS) <= set(make_env(CRUISE).reset(seed=0)[1])
    result = train(CRUISE, 4 * 256, 0, settings=TINY)
    episodes = list(result.agent.model.ep_info_buffer)
    assert len(episodes) == 4
    assert sum(episode["episode_violations"] for episode in episodes) > 0
    assert all(episode["is_success"] == float(episode["episode_violations"] == 0) for episode in episodes)


def test_saved_model_acts_alike(tmp_path):
    from stable_baselines3 import PPO

    agent = train(CRUISE, 512, 1, settings=TINY).agent
    agent.save(tmp_path)
    observations = np.random.default_rng(0).standard_normal((5, 3))
    again = PPO.load(tmp_path / "model.zip").predict(agent.normalizer.normalize_obs(observations), deterministic=True)[
        0
    ]
    np.testing.assert_array_equal(again, agent.act(observations))


def test_progress_adds_up_to_the_steps(shielding):
    told = []
    result = train(CRUISE, 1024, 0, settings=TINY, on_progress=told.append)
    assert sum(told) == result.steps


def test_make_env_shields_only_if_asked(shielding):
    assert not isinstance(make_env(CRUISE), SafetyShield)
    assert make_env(CRUISE, Shielding(shielding.certificate, "switch", 0.5)).penalty == 0.5


def test_untrained_agent_is_reproducible():
    observations = np.zeros((2, 3))
    np.testing.assert_array_equal(untrained(CRUISE, 5).act(observations), untrained(CRUISE, 5).act(observations))


@pytest.mark.parametrize(
    "change",
    [
        {"envs": 0},
        {"rollout": -1},
        {"discount": 1.5},
        {"learning_rate": 0.0},
        {"epochs": 1.5},
        {"width": True},
        {"log_std": np.nan},
    ],
)
def test_bad_settings_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        PPOSettings(**change)


def zero(observations, infos):
    return np.zeros((len(observations), 1), np.float32)


def throttle(observations, infos):
    return np.ones((len(observations), 1), np.float32)


def test_evaluation_counts_what_a_plain_loop_counts(certificate):
    records = evaluate(CRUISE, throttle, 30, 100, level_matrix=certificate.M)
    assert [record.seed for record in records] == list(range(100, 130))
    for record in records[::7]:
        env = make_env(CRUISE)
        _, info = env.reset(seed=record.seed)
        total, violations, level = 0.0, 0, info["state"] @ certificate.M @ info["state"]
        for _ in range(200):
            _, reward, _, _, info = env.step(np.ones(1, np.float32))
            total += reward
            violations += info["cost"] > 0
            level = max(level, info["state"] @ certificate.M @ info["state"])
        assert record.episode_return == pytest.approx(total)
        assert (record.violation_steps, record.steps) == (violations, 200)
        assert record.largest_level == pytest.approx(level)
        assert not record.guaranteed


def test_shielded_evaluation_is_guaranteed_and_leaves_penalties_out(shielding):
    free = evaluate(CRUISE, throttle, 3, 0, shielding)
    paid = evaluate(CRUISE, throttle, 3, 0, Shielding(shielding.certificate, penalty=1.0))
    for one, other in zip(free, paid, strict=True):
        assert one.guaranteed
        assert one.violation_steps == 0
        assert one.interventions == other.interventions > 0
        assert one.episode_return == pytest.approx(other.episode_return)


def test_arms_meet_the_same_draws_of_nature(shielding):
    bare, shielded = evaluate(CRUISE, zero, 5, 7), evaluate(CRUISE, zero, 5, 7, shielding)
    assert [record.episode_return for record in bare] == [record.episode_return for record in shielded]
