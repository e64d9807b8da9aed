"""Compares PPO's default settings here with those of stable-baselines3: frames per second and return.

    python benchmarks/ppo_settings.py [--steps 150000] [--seeds 2]

All agents learn `ncs_gym/TruckTrailerCruise-v0` unshielded, with the same number of steps and the same normalization:
with our settings in the vector environment, with those of stable-baselines3 in a DummyVecEnv of 8 scalar environments.
Frames per second are those of the whole training, environment included; ratios are to the first line.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from agents import LoopConfig, SB3VecEnv, evaluate
from agents.agent import Normalization
from agents.algorithms import build_model, normalized_env
from agents.hyperparams import complete_hyperparams

CRUISE = LoopConfig(env="ncs_gym/TruckTrailerCruise-v0")
# Whether the environments of an arm are scalar, whether our defaults hold for it, and what is given of its settings.
ARMS: dict[str, tuple[bool, bool, dict[str, Any]]] = {
    "stable-baselines3, scalar": (True, False, {}),
    "the same, n_steps 256": (True, False, {"n_steps": 256}),
    "ours, scalar, 16 environments": (True, True, {"n_envs": 16, "n_steps": 128, "batch_size": 1024}),
    "ours": (False, True, {}),
}
SB3_ENVS = 8


def environments(scalar: bool, count: int) -> VecEnv:
    if scalar:
        return DummyVecEnv([lambda: Monitor(gym.make(CRUISE.env))] * count)
    return SB3VecEnv(CRUISE.vector(count))


def trained(
    scalar: bool, ours: bool, given: dict[str, Any], steps: int, seed: int
) -> tuple[BaseAlgorithm, VecNormalize]:
    if ours:
        hyperparams = complete_hyperparams("PPO", given)
        env = normalized_env("PPO", environments(scalar, hyperparams["n_envs"]), hyperparams)
        return build_model("PPO", env, hyperparams, seed, steps).learn(steps), env
    env = VecNormalize(environments(scalar, SB3_ENVS), gamma=0.99)
    return PPO("MlpPolicy", env, seed=seed, device="cpu", **given).learn(steps), env


def mean_return(model: BaseAlgorithm, env: VecNormalize) -> float:
    normalize = Normalization.of(env)
    result = evaluate(CRUISE, lambda o, infos: model.predict(normalize(o), deterministic=True)[0], 100, 10**7)
    return float(np.mean([episode.episode_return for episode in result.episodes]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=150_000)
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    print(f"{'settings':32s}{'frames/s':>10s}{'ratio':>8s}{'return':>10s}   by seed", flush=True)
    trained(False, True, {}, 1, 0)  # What only the first training of a process takes time for is not measured.
    base = None
    for name, (scalar, ours, given) in ARMS.items():
        rates, returns = [], []
        for seed in range(options.seeds):
            start = time.perf_counter()
            model, env = trained(scalar, ours, given, options.steps, 1000 * seed)
            rates.append(model.num_timesteps / (time.perf_counter() - start))
            returns.append(mean_return(model, env))
        shown = ", ".join(f"{value:.2f}" for value in returns)
        rate = float(np.median(rates))
        base = base or rate
        print(f"{name:32s}{rate:10.0f}{rate / base:8.1f}{np.mean(returns):10.2f}   {shown}", flush=True)


if __name__ == "__main__":
    main()
