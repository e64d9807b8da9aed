"""Shows TorchRL: a rollout of the shielded environment as tensors, with the constraints of every step.

Takes about five seconds on one core; needs torchrl.
"""

import gymnasium as gym
import torch
from torchrl.data import Unbounded
from torchrl.envs import GymWrapper, default_info_dict_reader

from shields import SafetyShield

env = GymWrapper(SafetyShield(gym.make("ncs_gym:ncs_gym/TruckTrailerCruise-v0")))
# TorchRL reads infos that are arrays; |c_j x| - 1 is positive where the true state violates a limit.
constraints = Unbounded(shape=(2,), dtype=torch.float64)
env.set_info_dict_reader(default_info_dict_reader(["constraint_values"], spec=[constraints]))
env.set_seed(0)
rollout = env.rollout(200)
violating = (rollout["next", "constraint_values"] > 0.0).any(dim=1).sum()
print(f"return of {len(rollout)} random steps: {rollout['next', 'reward'].sum():.1f}; violating steps: {violating}")
