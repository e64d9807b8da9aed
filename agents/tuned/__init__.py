"""Settings of the learning algorithms tuned for each registered environment, kept as data.

`ppo.json` holds the number of training steps and PPO's settings by environment id, in the form of rl-zoo3's files;
docs/agents.md says how they were searched for and how good the agents are.
"""

from agents.tuned.entries import tuned_settings, tuned_steps

__all__ = ["tuned_settings", "tuned_steps"]
