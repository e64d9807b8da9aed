"""A random policy behind a shield: it may do what it likes, the coupling never overstretches."""

import gymnasium as gym

from shields import SafetyShield

env = SafetyShield(gym.make("ncs_gym:ncs_gym/TruckTrailerCruise-v0"))  # synthesizes and verifies a certificate
env.action_space.seed(0)
observation, info = env.reset(seed=0)
done = False
while not done:
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    done = terminated or truncated
print(f"violating steps: {info['episode_violations']:.0f}")
print(f"overridden actions: {info['episode_interventions']}")
print(f"the proof held: {info['shield_guaranteed']}")
