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

from agents.evaluation import evaluate
from agents.settings import PPOSettings
from agents.training import train

ENV, SCALAR = "ncs_gym/TruckTrailerCruise-v0", "ScalarCruise-v0"
gym.register(id=SCALAR, entry_point="ncs_gym.scenarios:TRUCK_TRAILER_CRUISE", max_episode_steps=200)
# stable-baselines3's defaults, over 8 environments.
SB3 = PPOSettings(
    envs=8, rollout=2048, batch_size=64, epochs=10, learning_rate=3e-4, discount=0.99, gae_lambda=0.95, log_std=0.0
)
ARMS = {
    "stable-baselines3, scalar": (SCALAR, SB3),
    "the same, rollout 256": (SCALAR, PPOSettings(**{**vars(SB3), "rollout": 256})),
    "ours, scalar, 16 environments": (SCALAR, PPOSettings(envs=16, rollout=128, batch_size=1024)),
    "ours": (ENV, PPOSettings()),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=150_000)
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    print(f"{'settings':32s}{'frames/s':>10s}{'ratio':>8s}{'return':>10s}   by seed", flush=True)
    train(ENV, 1, 0)  # compiles
    base = None
    for name, (env, settings) in ARMS.items():
        rates, returns = [], []
        for seed in range(options.seeds):
            start = time.perf_counter()
            result = train(env, options.steps, 1000 * seed, settings=settings)
            rates.append(result.steps / (time.perf_counter() - start))
            episodes = evaluate(ENV, lambda o, infos, agent=result.agent: agent.act(o), 100, 10**7)
            returns.append(float(np.mean([episode.episode_return for episode in episodes])))
        shown = ", ".join(f"{value:.2f}" for value in returns)
        rate = float(np.median(rates))
        base = base or rate
        print(f"{name:32s}{rate:10.0f}{rate / base:8.1f}{np.mean(returns):10.2f}   {shown}", flush=True)


if __name__ == "__main__":
    main()
