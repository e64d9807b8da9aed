"""Shows stable-baselines3's PPO, SAC and TD3 without any adapter: the shield is a wrapper like any other.

Takes about 35 seconds on one core.
"""

import argparse

import gymnasium as gym
import stable_baselines3
import torch
from stable_baselines3.common.monitor import Monitor

from shields import SafetyShield

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=1000)
options = parser.parse_args()
torch.set_num_threads(1)  # the network is small: more threads only wait for each other

# Monitor adds these infos of the last step to each episode; the last step has the totals of the episode.
keys = ("episode_violations", "episode_interventions")
for algorithm in ("PPO", "SAC", "TD3"):
    env = Monitor(SafetyShield(gym.make("ncs_gym:ncs_gym/TruckTrailerCruise-v0")), info_keywords=keys)
    model = getattr(stable_baselines3, algorithm)("MlpPolicy", env, seed=0, device="cpu").learn(options.steps)
    violating, overridden = (sum(episode[key] for episode in model.ep_info_buffer) for key in keys)
    last = env.get_episode_rewards()[-1]
    print(f"{algorithm}: last return {last:.1f}; {violating:.0f} violating steps, {overridden:.0f} actions overridden")
