"""PPO's default settings here against stable-baselines3's: frames per second and return, in one run.

    python benchmarks/ppo_settings.py [--steps 150000] [--seeds 2]

All learn `ncs_gym/TruckTrailerCruise-v0` unshielded with the same number of steps and normalization: with our settings
from the vector environment, with stable-baselines3's from its DummyVecEnv of 8 scalar ones. Frames per second are whole
training, environment included; ratios are to the first line.
"""

from __future__ import annotations

import argparse
import time

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from agents import SB3VecEnv
from agents.agent import Normalization
from agents.algorithms import build_model
from agents.control_loop import ControlLoop
from agents.evaluation import evaluate
from agents.settings import PPOSettings

CRUISE = ControlLoop(env="ncs_gym/TruckTrailerCruise-v0")
# Scalar environments and settings; None stands for stable-baselines3's own defaults.
ARMS = {
    "stable-baselines3, scalar": (True, None),
    "the same, rollout 256": (True, {"n_steps": 256}),
    "ours, scalar, 16 environments": (True, PPOSettings(envs=16, rollout=128, batch_size=1024)),
    "ours": (False, PPOSettings()),
}
SB3_ENVS = 8


def environments(scalar: bool, count: int) -> VecEnv:
    if scalar:
        return DummyVecEnv([lambda: Monitor(gym.make(CRUISE.env))] * count)
    return SB3VecEnv(CRUISE.vector(count))


def trained(scalar: bool, settings: PPOSettings | dict | None, steps: int, seed: int) -> tuple[PPO, VecNormalize]:
    ours = isinstance(settings, PPOSettings)
    env = VecNormalize(
        environments(scalar, settings.envs if ours else SB3_ENVS), gamma=settings.discount if ours else 0.99
    )
    model = (
        build_model("PPO", env, settings, seed)
        if ours
        else PPO("MlpPolicy", env, seed=seed, device="cpu", **settings or {})
    )
    return model.learn(steps), env


def mean_return(model: PPO, env: VecNormalize) -> float:
    normalize = Normalization.of(env)
    played = evaluate(CRUISE, lambda o, infos: model.predict(normalize(o), deterministic=True)[0], 100, 10**7)
    return float(np.mean([episode.episode_return for episode in played.episodes]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=150_000)
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    print(f"{'settings':32s}{'frames/s':>10s}{'ratio':>8s}{'return':>10s}   by seed", flush=True)
    trained(False, PPOSettings(), 1, 0)  # compiles
    base = None
    for name, (scalar, settings) in ARMS.items():
        rates, returns = [], []
        for seed in range(options.seeds):
            start = time.perf_counter()
            model, env = trained(scalar, settings, options.steps, 1000 * seed)
            rates.append(model.num_timesteps / (time.perf_counter() - start))
            returns.append(mean_return(model, env))
        shown = ", ".join(f"{value:.2f}" for value in returns)
        rate = float(np.median(rates))
        base = base or rate
        print(f"{name:32s}{rate:10.0f}{rate / base:8.1f}{np.mean(returns):10.2f}   {shown}", flush=True)


if __name__ == "__main__":
    main()
