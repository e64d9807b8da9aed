"""What agents, loops and trainings refuse, and the words that users need: a new refusal is a row."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from agents import evaluate
from agents.loop import LagrangianSettings, LoopConfig, ShieldSettings
from agents.training import require_trainable, train, untrained
from ncs_gym import truck_trailer
from tests.certificates import certificate_of

CRUISE = LoopConfig(env="ncs_gym/TruckTrailerCruise-v0")
REPLAY = dict(n_envs=4, gradient_steps=1, batch_size=32, buffer_size=1000, learning_starts=64)
CERTIFICATE = certificate_of(truck_trailer(mass=4000.0))
NAN, INF = float("nan"), float("inf")
OBSERVED = r"was trained in .* with observations of 3 entries.*shape \(3,\) or \(N, 3\), got "

# What an algorithm of stable-baselines3 is asked to take, and what is said of it.
HYPERPARAMS = [
    ("PPO", {"gama": 0.9}, "PPO: unknown hyperparameter 'gama'"),
    ("PPO", {"device": "cuda"}, "unknown hyperparameter 'device'"),
    ("PPO", {"n_epochs": 1.5}, "n_epochs must be a whole number >= 1, got 1.5"),
    ("PPO", {"learning_rate": -1.0}, "PPO: Invalid learning rate: -1.0"),
    ("PPO", {"learning_rate": "lin_fast"}, "PPO: could not convert"),
    ("PPO", {"policy_kwargs": {"net_arch": ["64"]}}, "^PPO: "),
    ("SAC", {"replay_buffer_class": "HerReplayBuffer"}, "SAC: .*must be a class"),
    ("PPO", {"policy_kwargs": {"net_arc": [8]}}, "PPO: .*'net_arc'"),
    ("PPO", {"batch_size": 1}, "PPO: .*batch_size"),
    ("PPO", {"normalize": {"norm_obs": False}}, "PPO: normalize must be true or"),
    ("PPO", {"normalize": {"gain": 2.0}}, "PPO: normalize: unknown hyperparameter 'gain'"),
    *(("PPO", {"n_envs": value}, "n_envs must be a whole number >= 1") for value in (0, True)),
    ("PPO", {"gamma": 1.5}, r"gamma must be in \[0, 1\], got 1.5"),
    ("TD3", {"gamma": "high"}, r"gamma must be in \[0, 1\], got 'high'"),
    ("TD3", {"noise_std": -0.1}, "TD3: noise_std must be a number >= 0"),
    ("PPO", {"policy_kwargs": {"activation_fn": print}}, "hyperparameters must be JSON values, got {'policy_kwargs': "),
    *(("PPO", {"policy_kwargs": {"activation_fn": value}}, "no activation function") for value in ("os.system", 3)),
    ("PPO", {"learning_rate": np.nan}, "hyperparameters must be JSON values, got {'learning_rate': nan"),
    ("DQN", {}, "unknown algorithm 'DQN'; known are PPO"),
]  # fmt: skip

CALLS = [
    (partial(train, CRUISE, 64, 0, "SAC", REPLAY), "a training of 64 steps trains nothing: learning starts after 64"),
    (partial(train, replace(CRUISE, lagrangian=LagrangianSettings()), 2000, 0, "SAC"),
     "lagrangian is for PPO, A2C, TRPO, which learn from what they have just done: the replay buffer of SAC keeps"),
    (partial(train, CRUISE, -5, 0), "steps must be at least 1, got -5"),
    (partial(require_trainable, CRUISE, 2_000, "SAC", {}), "a training of 2,000 steps trains nothing"),
    (partial(evaluate, CRUISE, None, 0, 0), "episodes must be at least 1, got 0"),
    (partial(ShieldSettings, CERTIFICATE.document), "certificate must be a Certificate, got dict"),
    (partial(LoopConfig, env=f"ncs_gym:{CRUISE.env}"), "import the module that registers it, and give the id alone"),
    *((partial(LoopConfig, env=CRUISE.env, violation_penalty=value), "violation_penalty must be a number >= 0")
      for value in (-50.0, NAN, "5")),
    (partial(LoopConfig, env=CRUISE.env, violation_penalty=1.0, lagrangian=LagrangianSettings()),
     "give either violation_penalty or lagrangian"),
    (partial(ShieldSettings, CERTIFICATE, penalty=-1.0), "penalty must be a number >= 0"),
    (partial(LoopConfig, env=CRUISE.env, shield=CERTIFICATE),
     r"^shield must be ShieldSettings\(certificate\), got Certificate$"),
    (partial(LoopConfig, env=CRUISE.env, shield=ShieldSettings(CERTIFICATE), filter=print),
     "give either a shield or a filter"),
    (partial(ShieldSettings, CERTIFICATE, horizon=4), 'horizon is for mode "lookahead"'),
    (partial(ShieldSettings, CERTIFICATE, mode="x"), r"^mode must be one of \["),
    *((partial(LagrangianSettings, **{name: value}), f"{name} must be >= 0")
      for name in ("cost_limit", "learning_rate", "multiplier") for value in (-0.1, NAN, INF)),
]  # fmt: skip
SHAPES = [(4, 5), (2, 4, 3), ()]


@pytest.mark.parametrize(("algorithm", "change", "words"), HYPERPARAMS)
def test_what_an_algorithm_does_not_take_is_refused_in_one_sentence(algorithm, change, words):
    with pytest.raises(ValueError, match=words) as caught:
        require_trainable(CRUISE, 100_000, algorithm, change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("call", "words"), CALLS)
def test_calls_are_refused_in_one_sentence(call, words):
    with pytest.raises(ValueError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("observations", "words"),
    [
        *((np.zeros(shape), f"{OBSERVED}{re.escape(str(shape))}$") for shape in SHAPES),
        *(([value, 0.0, 0.0], "observations must be finite numbers") for value in (NAN, INF)),
    ],
)
def test_observations_that_no_agent_knows_are_refused(observations, words):
    with pytest.raises(ValueError, match=words):
        untrained(CRUISE, 0).act(observations)
