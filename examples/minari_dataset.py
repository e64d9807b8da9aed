"""Shows Minari: a dataset of shielded episodes for offline learning, with the cost of every step among the infos.

Takes about five seconds on one core; needs minari with its extras "create" and "hdf5". The dataset goes into Minari's
own folder.
"""

import gymnasium as gym
from minari import DataCollector

from shields import SafetyShield

env = DataCollector(SafetyShield(gym.make("ncs_gym:ncs_gym/TruckTrailerCruise-v0")), record_infos=True)
env.action_space.seed(0)
for seed in range(3):
    env.reset(seed=seed)
    while not any(env.step(env.action_space.sample())[2:4]):
        pass
dataset = env.create_dataset("ncs-gym/cruise-v0", algorithm_name="random")
costs = [float(episode.infos["cost"].sum()) for episode in dataset.iterate_episodes()]
print(f"{dataset.total_steps} steps in {dataset.total_episodes} episodes; violating steps of each: {costs}")
