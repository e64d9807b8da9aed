"""Shows the smallest shielded episode: the policy is random, and still the coupling never exceeds its limits.

Takes about three seconds on one core.
"""

import gymnasium as gym

from shields import SafetyShield

# Without a certificate of its own, the shield synthesizes one and verifies it.
env = SafetyShield(gym.make("ncs_gym:ncs_gym/TruckTrailerCruise-v0"))
env.action_space.seed(0)
observation, info = env.reset(seed=0)
done = False
while not done:
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    done = terminated or truncated
print(f"violating steps: {info['episode_violations']:.0f}")
print(f"overridden actions: {info['episode_interventions']}")
print(f"the proof held: {info['shield_guaranteed']}")
