"""Shows Tianshou: shielded environments in processes of their own, stepped side by side.

Takes about five seconds on one core; needs tianshou.
"""

import gymnasium as gym
import numpy as np
from tianshou.env import SubprocVectorEnv

from shields import SafetyShield


def make() -> gym.Env:
    """Returns a shielded environment."""
    return SafetyShield(gym.make("ncs_gym:ncs_gym/TruckTrailerCruise-v0"))


if __name__ == "__main__":
    envs = SubprocVectorEnv([make, make])
    envs.seed(0)
    envs.reset()
    returns = np.zeros(2)
    for _ in range(200):
        _, rewards, _, _, infos = envs.step(np.ones((2, 1), np.float32))
        returns += rewards
    print(f"returns of full throttle: {returns.round(1)}; violating steps: {[i['episode_violations'] for i in infos]}")
    envs.close()
