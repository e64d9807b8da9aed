import copy
from dataclasses import astuple

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorWrapper

from agents.loop import LoopConfig, ShieldSettings
from agents.sb3_vec_env import _EPISODE_KEYS
from agents.training import require_trainable, train, untrained

CRUISE = LoopConfig(env="ncs_gym/TruckTrailerCruise-v0")
TINY = dict(n_envs=4, n_steps=64, batch_size=128, n_epochs=2)
TINY_TRUST_REGION = dict(n_envs=4, n_steps=64, batch_size=128, n_critic_updates=2)
TINY_A2C = dict(n_envs=4, n_steps=8)
TINY_REPLAY = dict(n_envs=4, gradient_steps=1, batch_size=32, buffer_size=1000, learning_starts=64)


@pytest.fixture(scope="module")
def shielded(certificate):
    return LoopConfig(env=CRUISE.env, shield=ShieldSettings(certificate))


def test_same_seed_trains_the_same_agent():
    first, second = (train(CRUISE, 512, 3, hyperparams=TINY) for _ in range(2))
    observations = np.random.default_rng(0).standard_normal((20, 3))
    np.testing.assert_array_equal(first.agent.act(observations), second.agent.act(observations))
    assert [point.violation_steps for point in first.history] == [point.violation_steps for point in second.history]
    other = train(CRUISE, 512, 4, hyperparams=TINY)
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
    result = train(CRUISE, 2048, 0, hyperparams=TINY)
    assert result.steps == len(counted) == 2048
    assert result.violation_steps == sum(counted) > 0
    assert result.history[-1].violation_steps == result.violation_steps
    assert result.interventions == 0


def test_single_environments_are_counted_alike(certificate, monkeypatch):
    # What has no vector environment is stepped one by one.
    spec = copy.deepcopy(gym.spec(CRUISE.env))
    spec.id, spec.vector_entry_point = "Scalar-v0", None
    monkeypatch.setitem(gym.registry, "Scalar-v0", spec)
    result = train(LoopConfig(env="Scalar-v0", shield=ShieldSettings(certificate)), 1024, 0, hyperparams=TINY)
    assert result.violation_steps == 0
    assert result.interventions > 20
    assert train(LoopConfig(env="Scalar-v0"), 1024, 0, hyperparams=TINY).violation_steps > 0


def test_shielded_training_has_no_violation_and_counts_interventions(shielded):
    result = train(shielded, 2048, 0, hyperparams=TINY)
    assert result.violation_steps == 0
    assert result.interventions > 50


def test_monitored_training_is_the_unshielded_one_and_counts_what_the_shield_would_do(certificate):
    monitored = LoopConfig(env=CRUISE.env, shield=ShieldSettings(certificate, "monitor"))
    one, other = train(monitored, 1024, 0, hyperparams=TINY), train(CRUISE, 1024, 0, hyperparams=TINY)
    observations = np.random.default_rng(0).standard_normal((20, 3))
    np.testing.assert_array_equal(one.agent.act(observations), other.agent.act(observations))
    assert one.violation_steps == other.violation_steps > 0
    assert one.interventions > 0


def test_violation_penalty_changes_what_is_learned():
    penalized = LoopConfig(env=CRUISE.env, violation_penalty=5.0)
    one, other = train(penalized, 1024, 0, hyperparams=TINY), train(CRUISE, 1024, 0, hyperparams=TINY)
    observations = np.random.default_rng(0).standard_normal((20, 3))
    assert (one.agent.act(observations) != other.agent.act(observations)).any()


@pytest.mark.parametrize(
    ("algorithm", "settings"),
    [
        ("A2C", TINY_A2C),
        ("TRPO", TINY_TRUST_REGION),
        *((name, TINY_REPLAY) for name in ("SAC", "TD3", "TQC", "CrossQ")),
    ],
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
    agent, start = train(CRUISE, 256, 0, hyperparams=TINY).agent, untrained(CRUISE, 0, hyperparams=TINY)
    assert agent.checksum != start.checksum


def test_rate_falls_from_its_full_value_to_that_of_the_last_rollout():
    schedule = train(CRUISE, 4 * 256, 0, hyperparams=TINY).agent.model.lr_schedule
    assert [schedule(remaining) for remaining in (0.75, 0.5, 0.25, 0.0)] == pytest.approx(
        [0.003 * fraction for fraction in (1.0, 0.75, 0.5, 0.25)]
    )


@pytest.mark.parametrize("change", [{"ent_coef": 0.1}, {"normalize": {"norm_reward": False}}])
def test_weight_of_the_entropy_and_normalization_of_rewards_change_what_is_learned(change):
    agent, other = (train(CRUISE, 512, 0, hyperparams=each).agent for each in (TINY, TINY | change))
    assert agent.checksum != other.checksum


def test_too_few_steps_to_learn_are_refused():
    with pytest.raises(ValueError, match="64 steps train nothing: learning starts after 64"):
        train(CRUISE, 64, 0, "SAC", TINY_REPLAY)
    with pytest.raises(ValueError, match="steps must be at least 1, got -5"):
        train(CRUISE, -5, 0)


@pytest.mark.parametrize(
    ("algorithm", "settings", "words"),
    [("DQN", None, "unknown algorithm 'DQN'"), ("SAC", TINY, "unknown hyperparameter 'n_epochs'")],
)
def test_unknown_algorithm_and_foreign_settings_are_refused(algorithm, settings, words):
    with pytest.raises(ValueError, match=words):
        train(CRUISE, 64, 0, algorithm, settings)


def test_missing_package_is_one_sentence(monkeypatch):
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"TQC needs sb3-contrib: in .*, pip install -e '\.\[contrib\]'$"):
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

    result = train(shielded, 512, 5, hyperparams=TINY, log_folder=tmp_path)
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    episodes = evaluate(shielded, lambda seen, _: result.agent.act(seen), 20, 5).episodes
    mean = np.mean([episode.episode_return for episode in episodes])
    assert events.Scalars("eval/mean_reward")[-1].value == pytest.approx(mean, rel=1e-5)
    rate = sum(episode.interventions for episode in episodes) / sum(episode.steps for episode in episodes)
    assert events.Scalars("eval/intervention_rate")[-1].value == pytest.approx(rate, rel=1e-5)


def test_monitor_keeps_the_episodes_totals():
    assert set(_EPISODE_KEYS) - {"episode_guaranteed"} <= set(CRUISE.single().reset(seed=0)[1])
    result = train(CRUISE, 4 * 256, 0, hyperparams=TINY)
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
    result = train(CRUISE, 1024, 0, hyperparams=TINY, on_progress=reported.append)
    assert sum(reported) == result.steps


def test_untrained_agent_is_reproducible():
    observations = np.zeros((2, 3))
    np.testing.assert_array_equal(untrained(CRUISE, 5).act(observations), untrained(CRUISE, 5).act(observations))


@pytest.mark.parametrize(
    ("algorithm", "change", "words"),
    [
        ("PPO", {"gama": 0.9}, "PPO: unknown hyperparameter 'gama'; .* are n_envs, .*n_steps.* gamma"),
        ("SAC", {"gae_lambda": 0.9}, "SAC: unknown hyperparameter 'gae_lambda'; .* noise_std.* buffer_size"),
        ("PPO", {"noise_std": 0.1}, "unknown hyperparameter 'noise_std'"),
        ("PPO", {"device": "cuda"}, "unknown hyperparameter 'device'"),
        ("PPO", {"vf_coef": "high"}, "vf_coef cannot be 'high'"),
        ("PPO", {"vf_coef": True}, "vf_coef cannot be True"),
        ("PPO", {"n_epochs": 1.5}, "n_epochs must be a whole number >= 1, got 1.5"),
        ("PPO", {"n_epochs": 0}, "n_epochs must be a whole number >= 1, got 0"),
        ("PPO", {"clip_range": [0.2]}, "clip_range cannot be"),
        ("PPO", {"learning_rate": -1.0}, "PPO: Invalid learning rate: -1.0; its hyperparameters are"),
        ("PPO", {"learning_rate": "lin_fast"}, "PPO: could not convert"),
        ("PPO", {"policy": "Cnn"}, "PPO: Policy Cnn unknown; its hyperparameters are"),
        ("PPO", {"policy_kwargs": {"net_arc": [8]}}, "PPO: .*'net_arc'; its hyperparameters are"),
        ("PPO", {"batch_size": 1}, "PPO: .*batch_size.*; its hyperparameters are"),
        ("PPO", {"normalize": False}, "PPO: normalize must be true or"),
        ("PPO", {"normalize": {"norm_obs": False}}, "PPO: normalize must be true or"),
        ("PPO", {"normalize": {"gain": 2.0}}, "PPO: normalize: unknown hyperparameter 'gain'"),
        ("PPO", {"normalize": {"norm_reward": "no"}}, "PPO: normalize: norm_reward cannot be 'no'"),
        ("A2C", {"n_steps": 0}, "n_steps must be a whole number >= 1"),
        ("PPO", {"n_envs": 0}, "n_envs must be a whole number >= 1"),
        ("PPO", {"n_envs": True}, "n_envs must be a whole number >= 1"),
        ("PPO", {"gamma": 1.5}, r"gamma must be in \[0, 1\], got 1.5"),
        ("TD3", {"gamma": "high"}, r"gamma must be in \[0, 1\], got 'high'"),
        ("TD3", {"noise_std": -0.1}, "TD3: noise_std must be >= 0"),
        ("TD3", {"noise_type": "pink"}, "TD3: noise_type cannot be 'pink'"),
        ("SAC", {"buffer_size": -1}, "buffer_size must be a whole number >= 1, got -1"),
        ("PPO", {"policy_kwargs": {"activation_fn": print}}, "hyperparameters must be JSON values"),
        ("PPO", {"learning_rate": np.nan}, "hyperparameters must be JSON values"),
    ],
)
def test_what_the_library_does_not_take_is_refused_in_one_sentence(algorithm, change, words):
    with pytest.raises(ValueError, match=words) as caught:
        require_trainable(CRUISE, 100_000, algorithm, change)
    assert "\n" not in str(caught.value)


def test_what_the_library_takes_is_not_refused():
    linear = {"clip_range": "lin_0.2", "target_kl": None, "normalize": {"norm_reward": False, "clip_obs": 5}}
    require_trainable(CRUISE, 100_000, "PPO", linear | {"gamma": 1, "use_sde": True, "policy": "MlpPolicy"})
    require_trainable(CRUISE, 100_000, "SAC", {"ent_coef": 0.1, "noise_type": "normal", "noise_std": 0.1})
    with pytest.raises(ValueError, match="2000 steps train nothing"):
        require_trainable(CRUISE, 2_000, "SAC", {})


def test_constant_rate_is_constant_and_a_linear_one_falls():
    rates = [train(CRUISE, 512, 0, hyperparams=TINY | {"learning_rate": rate}).agent for rate in (0.003, "lin_0.003")]
    assert [agent.model.lr_schedule(0.5) for agent in rates] == pytest.approx([0.003, 0.003 * 1.5 / 2 + 0.00075])
    assert rates[0].checksum != rates[1].checksum
