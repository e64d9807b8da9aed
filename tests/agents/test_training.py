import copy
from dataclasses import astuple, replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorWrapper

from agents.loop import LoopConfig, ShieldSettings
from agents.sb3_vec_env import _EPISODE_KEYS
from agents.settings import A2CSettings, OffPolicySettings, PPOSettings
from agents.training import train, untrained

CRUISE = LoopConfig(env="ncs_gym/TruckTrailerCruise-v0")
TINY = PPOSettings(envs=4, rollout=64, batch_size=128, epochs=2)
TINY_A2C = A2CSettings(envs=4, rollout=8)
TINY_REPLAY = OffPolicySettings(envs=4, gradient_steps=1, batch_size=32, buffer_size=1000, learning_starts=64)


@pytest.fixture(scope="module")
def shielded(certificate):
    return LoopConfig(env=CRUISE.env, shield=ShieldSettings(certificate))


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
            states = result[4]["state"] @ self.env.unwrapped.plant.box_rows.T
            counted.extend((np.abs(states).max(axis=1) > 1.0).tolist())
            return result

    make_vec = gym.make_vec
    monkeypatch.setattr(gym, "make_vec", lambda *arguments, **keywords: Counter(make_vec(*arguments, **keywords)))
    result = train(CRUISE, 2048, 0, settings=TINY)
    assert result.steps == len(counted) == 2048
    assert result.violation_steps == sum(counted) > 0
    assert result.history[-1].violation_steps == result.violation_steps
    assert result.interventions == 0


def test_single_environments_are_counted_alike(certificate, monkeypatch):
    # What has no vector environment is stepped one by one.
    spec = copy.deepcopy(gym.spec(CRUISE.env))
    spec.id, spec.vector_entry_point = "Scalar-v0", None
    monkeypatch.setitem(gym.registry, "Scalar-v0", spec)
    result = train(LoopConfig(env="Scalar-v0", shield=ShieldSettings(certificate)), 1024, 0, settings=TINY)
    assert result.violation_steps == 0
    assert result.interventions > 20
    assert train(LoopConfig(env="Scalar-v0"), 1024, 0, settings=TINY).violation_steps > 0


def test_shielded_training_has_no_violation_and_counts_interventions(shielded):
    result = train(shielded, 2048, 0, settings=TINY)
    assert result.violation_steps == 0
    assert result.interventions > 50


def test_monitored_training_is_the_unshielded_one_and_counts_what_the_shield_would_do(certificate):
    monitored = LoopConfig(env=CRUISE.env, shield=ShieldSettings(certificate, "monitor"))
    one, other = train(monitored, 1024, 0, settings=TINY), train(CRUISE, 1024, 0, settings=TINY)
    observations = np.random.default_rng(0).standard_normal((20, 3))
    np.testing.assert_array_equal(one.agent.act(observations), other.agent.act(observations))
    assert one.violation_steps == other.violation_steps > 0
    assert one.interventions > 0


def test_violation_penalty_changes_what_is_learned():
    penalized = LoopConfig(env=CRUISE.env, violation_penalty=5.0)
    one, other = train(penalized, 1024, 0, settings=TINY), train(CRUISE, 1024, 0, settings=TINY)
    observations = np.random.default_rng(0).standard_normal((20, 3))
    assert (one.agent.act(observations) != other.agent.act(observations)).any()


@pytest.mark.parametrize(
    ("algorithm", "settings"),
    [("A2C", TINY_A2C), ("TRPO", TINY), *((name, TINY_REPLAY) for name in ("SAC", "TD3", "TQC", "CrossQ"))],
)
def test_every_algorithm_trains_counts_and_repeats_itself(algorithm, settings, shielded):
    first, second = (train(shielded, 320, 3, algorithm, settings) for _ in range(2))
    assert first.steps == second.steps >= 320
    assert first.violation_steps == 0
    assert first.interventions == second.interventions > 0
    assert [point.steps for point in first.history] == sorted({point.steps for point in first.history})
    assert first.history[-1].steps == first.steps
    assert len(first.history) <= 201
    observations = np.random.default_rng(0).standard_normal((20, 3))
    np.testing.assert_array_equal(first.agent.act(observations), second.agent.act(observations))


def test_a_single_rollout_is_learned_from():
    agent, start = train(CRUISE, 256, 0, settings=TINY).agent, untrained(CRUISE, 0, settings=TINY)
    assert agent.checksum != start.checksum


def test_rate_falls_from_its_full_value_to_that_of_the_last_rollout():
    schedule = train(CRUISE, 4 * 256, 0, settings=TINY).agent.model.lr_schedule
    assert [schedule(remaining) for remaining in (0.75, 0.5, 0.25, 0.0)] == pytest.approx(
        [TINY.learning_rate * fraction for fraction in (1.0, 0.75, 0.5, 0.25)]
    )


@pytest.mark.parametrize("change", [{"entropy": 0.1}, {"normalize_rewards": False}])
def test_weight_of_the_entropy_and_normalization_of_rewards_change_what_is_learned(change):
    agent, other = (train(CRUISE, 512, 0, settings=settings).agent for settings in (TINY, replace(TINY, **change)))
    assert agent.checksum != other.checksum


def test_too_few_steps_to_learn_are_refused():
    with pytest.raises(ValueError, match="64 steps train nothing: learning starts after 64"):
        train(CRUISE, 64, 0, "SAC", TINY_REPLAY)
    with pytest.raises(ValueError, match="steps must be at least 1, got -5"):
        train(CRUISE, -5, 0)


@pytest.mark.parametrize(
    ("algorithm", "settings", "words"), [("DQN", None, "unknown algorithm 'DQN'"), ("SAC", TINY, "takes OffPolicy")]
)
def test_unknown_algorithm_and_foreign_settings_are_refused(algorithm, settings, words):
    with pytest.raises(ValueError, match=words):
        train(CRUISE, 64, 0, algorithm, settings)


def test_missing_package_is_one_sentence(monkeypatch):
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"TQC needs sb3-contrib: in a clone .* '\.\[contrib\]'$"):
        train(CRUISE, 64, 0, "TQC", TINY_REPLAY)


@pytest.mark.parametrize(("algorithm", "settings"), [("PPO", TINY), ("SAC", TINY_REPLAY)])
def test_rates_reach_tensorboard(algorithm, settings, shielded, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    result = train(shielded, 1024, 0, algorithm, settings, log_folder=tmp_path)
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    tags = events.Tags()["scalars"]
    assert {"safety/violation_rate", "safety/intervention_rate", "safety/violation_steps", "time/fps"} <= set(tags)
    assert max(event.value for event in events.Scalars("safety/mean_correction")) > 0.0
    assert {event.value for event in events.Scalars("safety/guaranteed_rate")} == {1.0}
    assert {event.value for event in events.Scalars("eval/success_rate")} == {1.0}
    evaluated = [event.step for event in events.Scalars("eval/mean_reward")]
    assert evaluated[0] == 0
    assert evaluated[-1] == result.steps
    assert len(evaluated) >= 4
    if algorithm == "PPO":
        rates = [event.value for event in events.Scalars("safety/intervention_rate")]
        assert sum(rates) * 256 == pytest.approx(result.interventions, abs=1)


def test_mean_correction_is_that_of_every_step(certificate):
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import Logger

    from agents import SafetyCallback, SB3VecEnv

    corrections, recorded = [], []

    class Recorder(VectorWrapper):
        def step(self, actions):
            result = self.env.step(actions)
            corrections.extend(np.linalg.norm(result[4]["input"] - result[4]["input_proposed"], axis=1))
            return result

    class Recording(Logger):
        def record(self, key, value, exclude=None):
            if key == "safety/mean_correction":
                recorded.append(value)

    loop = LoopConfig(env=CRUISE.env, shield=ShieldSettings(certificate))
    model = PPO("MlpPolicy", SB3VecEnv(Recorder(loop.vector(4))), n_steps=64, batch_size=128, n_epochs=1, device="cpu")
    model.set_logger(Recording(None, []))
    model.learn(512, callback=SafetyCallback())
    assert len(corrections) == 512
    np.testing.assert_allclose(recorded, np.mean(np.reshape(corrections, (2, 256)), axis=1), rtol=1e-9)


@pytest.mark.parametrize(("algorithm", "settings", "steps"), [("PPO", TINY, 512), ("SAC", TINY_REPLAY, 256)])
def test_evaluations_on_the_way_change_nothing(algorithm, settings, steps, tmp_path):
    plain, logged = (train(CRUISE, steps, 3, algorithm, settings, log_folder=log) for log in (None, tmp_path))
    assert plain.agent.checksum == logged.agent.checksum
    np.testing.assert_array_equal([astuple(one) for one in plain.history], [astuple(one) for one in logged.history])


def test_evaluation_of_the_end_is_that_of_the_returned_agent(shielded, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    from agents import evaluate

    result = train(shielded, 512, 5, settings=TINY, log_folder=tmp_path)
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    episodes = evaluate(shielded, lambda seen, _: result.agent.act(seen), 20, 5).episodes
    mean = np.mean([episode.episode_return for episode in episodes])
    assert events.Scalars("eval/mean_reward")[-1].value == pytest.approx(mean, rel=1e-5)
    rate = sum(episode.interventions for episode in episodes) / sum(episode.steps for episode in episodes)
    assert events.Scalars("eval/intervention_rate")[-1].value == pytest.approx(rate, rel=1e-5)


def test_monitor_keeps_the_episodes_totals():
    assert set(_EPISODE_KEYS) <= set(CRUISE.single().reset(seed=0)[1])
    result = train(CRUISE, 4 * 256, 0, settings=TINY)
    episodes = list(result.agent.model.ep_info_buffer)
    assert len(episodes) == 4
    assert sum(episode["episode_violations"] for episode in episodes) > 0
    assert all(episode["is_success"] == float(episode["episode_violations"] == 0) for episode in episodes)


def test_callback_counts_alike_on_stable_baselines3s_own_vector_environment(certificate):
    from stable_baselines3 import A2C, SAC
    from stable_baselines3.common.env_util import make_vec_env

    from agents.callbacks import SafetyCallback
    from shields import SafetyShield

    env = make_vec_env(lambda: SafetyShield(gym.make(CRUISE.env), certificate), n_envs=2, seed=0)
    for model in (A2C("MlpPolicy", env, seed=0), SAC("MlpPolicy", env, learning_starts=50, seed=0)):
        callback = SafetyCallback()
        model.learn(200, callback=callback)
        assert callback.violation_steps == 0
        assert callback.interventions == callback.history[-1].interventions > 0
        assert callback.history[-1].steps == 200


def test_eval_callback_reports_success_on_both_kinds_of_environment(certificate, tmp_path):
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import EvalCallback
    from stable_baselines3.common.env_util import make_vec_env

    from agents import SB3VecEnv

    def successes(env):
        log = tmp_path / type(env).__name__
        model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, seed=0)
        model.learn(128, callback=EvalCallback(env, n_eval_episodes=4, eval_freq=64, log_path=str(log), verbose=0))
        return np.load(log / "evaluations.npz")["successes"]

    shield = ShieldSettings(certificate)
    vector = SB3VecEnv(LoopConfig(env=CRUISE.env, shield=shield).vector(2))
    scalar = make_vec_env(lambda: LoopConfig(env=CRUISE.env, shield=shield).single(), n_envs=2, seed=0)
    for env in (vector, scalar):
        assert successes(env).all()


def test_progress_adds_up_to_the_steps():
    reported = []
    result = train(CRUISE, 1024, 0, settings=TINY, on_progress=reported.append)
    assert sum(reported) == result.steps


def test_untrained_agent_is_reproducible():
    observations = np.zeros((2, 3))
    np.testing.assert_array_equal(untrained(CRUISE, 5).act(observations), untrained(CRUISE, 5).act(observations))


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        (PPOSettings, {"envs": 0}),
        (PPOSettings, {"rollout": -1}),
        (PPOSettings, {"discount": 1.5}),
        (PPOSettings, {"learning_rate": 0.0}),
        (PPOSettings, {"epochs": 1.5}),
        (PPOSettings, {"width": True}),
        (PPOSettings, {"log_std": np.nan}),
        (PPOSettings, {"entropy": -1e-3}),
        (PPOSettings, {"normalize_rewards": 1}),
        (A2CSettings, {"rollout": 0}),
        (OffPolicySettings, {"noise": -0.1}),
        (OffPolicySettings, {"buffer_size": 0}),
    ],
)
def test_bad_settings_are_refused(kind, change):
    with pytest.raises(ValueError, match=next(iter(change))):
        kind(**change)
