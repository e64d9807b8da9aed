"""Shows Minari: a dataset of shielded episodes for offline learning, with the cost of every step among the infos.

Takes about five seconds on one core; needs minari with its extras "create" and "hdf5". The dataset goes into Minari's
own folder. The actions stored are those that were applied, which the infos tell, not those that were proposed.
"""

import gymnasium as gym
import numpy as np
from minari import DataCollector, StepDataCallback

from shields import SafetyShield


class Applied(StepDataCallback):
    """Stores the action applied in place of the one proposed."""

    def __call__(self, env, obs, info, action=None, **given):
        """Returns what is stored of a step; a reset has no action."""
        return super().__call__(env, obs, info, None if action is None else info["action_applied"], **given)


shielded = SafetyShield(gym.make("ncs_gym:ncs_gym/TruckTrailerCruise-v0"))
env = DataCollector(shielded, step_data_callback=Applied, record_infos=True)
env.action_space.seed(0)
for seed in range(3):
    env.reset(seed=seed)
    while not any(env.step(env.action_space.sample())[2:4]):
        pass
dataset = env.create_dataset("ncs-gym/cruise-v0", algorithm_name="random")
episodes = list(dataset.iterate_episodes())
costs = [float(episode.infos["cost"].sum()) for episode in episodes]
print(f"{dataset.total_steps} steps in {dataset.total_episodes} episodes; violating steps of each: {costs}")
same = all(np.array_equal(episode.actions, episode.infos["action_applied"][1:]) for episode in episodes)
print(f"the actions stored are those applied: {same}")
