"""Shows how to make the shield a part of an environment id, for code that takes only an id.

Importing this module registers `ShieldedCruise-v0`.
"""

import gymnasium as gym
from gymnasium.envs.registration import WrapperSpec

import ncs_gym  # noqa: F401  (registers the environment below)

cruise = gym.spec("ncs_gym/TruckTrailerCruise-v0")
gym.register(
    id="ShieldedCruise-v0",
    entry_point=cruise.entry_point,
    max_episode_steps=cruise.max_episode_steps,
    additional_wrappers=(WrapperSpec("SafetyShield", "shields:SafetyShield", {"mode": "project", "penalty": 0.1}),),
)
