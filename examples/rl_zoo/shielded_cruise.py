"""Importing this registers `ShieldedCruise-v0`: an id whose shield is a part of it, for code that takes only an id."""

import gymnasium as gym
from gymnasium.envs.registration import WrapperSpec

import ncs_gym  # noqa: F401  (registers the cruise)

cruise = gym.spec("ncs_gym/TruckTrailerCruise-v0")
gym.register(
    id="ShieldedCruise-v0",
    entry_point=cruise.entry_point,
    max_episode_steps=cruise.max_episode_steps,
    additional_wrappers=(WrapperSpec("SafetyShield", "shields:SafetyShield", {"mode": "project", "penalty": 0.1}),),
)
