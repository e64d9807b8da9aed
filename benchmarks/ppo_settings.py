"""PPO's default settings here against stable-baselines3's: frames per second and return, in one run.

    python benchmarks/ppo_settings.py [--steps 150000] [--seeds 2]

Both learn `ncs_gym/TruckTrailerCruise-v0` unshielded from the same scalar environment with the same number of steps and
normalization; only the settings differ. Frames per second are whole training, environment included.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from agents.evaluation import evaluate
from agents.settings import PPOSettings
from agents.training import train

ENV = "ncs_gym/TruckTrailerCruise-v0"
# stable-baselines3's defaults, over 8 environments.
SB3 = PPOSettings(
    envs=8, rollout=2048, batch_size=64, epochs=10, learning_rate=3e-4, discount=0.99, gae_lambda=0.95, log_std=0.0
)
ARMS = {
    "ours": PPOSettings(),
    "stable-baselines3's defaults": SB3,
    "the same, rollout 256": PPOSettings(**{**vars(SB3), "rollout": 256}),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=150_000)
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    print(f"{'settings':32s}{'frames/s':>10s}{'return':>10s}   by seed", flush=True)
    for name, settings in ARMS.items():
        rates, returns = [], []
        for seed in range(options.seeds):
            start = time.perf_counter()
            result = train(ENV, options.steps, 1000 * seed, settings=settings)
            rates.append(result.steps / (time.perf_counter() - start))
            episodes = evaluate(ENV, lambda o, infos, agent=result.agent: agent.act(o), 100, 10**7)
            returns.append(float(np.mean([episode.episode_return for episode in episodes])))
        shown = ", ".join(f"{value:.2f}" for value in returns)
        print(f"{name:32s}{np.median(rates):10.0f}{np.mean(returns):10.2f}   {shown}", flush=True)


if __name__ == "__main__":
    main()
