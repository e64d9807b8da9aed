"""Shows domain randomization over networks: agents train on the best channel or on a range, and meet the worst of it.

Takes about 50 seconds on one core. The environment is the cruise behind a shield.
"""

import argparse

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO

from agents import SB3VecEnv
from ncs_gym import Channel, VectorRandomChannel
from shields import VectorSafetyShield

BEST, WORST = Channel(), Channel(loss=0.7, send_period=3, delay=6)


def draw(rng: np.random.Generator) -> Channel:
    """Returns a channel between the best and the worst."""
    return Channel(loss=0.7 * rng.random(), send_period=int(rng.integers(1, 4)), delay=int(rng.integers(7)))


def mean_return(model: PPO, channel: Channel, episodes: int = 64) -> tuple[float, float]:
    """Returns the mean return of episodes over a channel, and the sum of their violating steps."""
    envs = VectorSafetyShield(gym.make_vec("ncs_gym:ncs_gym/TruckTrailerCruise-v0", num_envs=episodes))
    observations, infos = envs.reset(seed=1, options={"channel": channel})
    total = np.zeros(episodes)
    for _ in range(200):
        observations, rewards, _, _, infos = envs.step(model.predict(observations, deterministic=True)[0])
        total += rewards
    return total.mean(), infos["episode_violations"].sum()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=200_000, help="steps of each training")
    steps = parser.parse_args().steps
    for name, channels in {"the best": [BEST], "the range": draw}.items():
        shield = VectorSafetyShield(gym.make_vec("ncs_gym:ncs_gym/TruckTrailerCruise-v0", num_envs=64))
        envs = SB3VecEnv(VectorRandomChannel(shield, channels))
        settings = {"n_steps": 16, "batch_size": 256, "n_epochs": 5, "gamma": 0.9, "gae_lambda": 0.98}
        policy = {"log_std_init": -1.5}
        model = PPO("MlpPolicy", envs, learning_rate=1e-3, policy_kwargs=policy, seed=0, device="cpu", **settings)
        model.learn(steps)
        for network, channel in {"best": BEST, "worst": WORST}.items():
            score, violating = mean_return(model, channel)
            print(f"trained on {name}, {network} network: return {score:.2f}, violating steps: {violating:.0f}")
