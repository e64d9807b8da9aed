"""Settings of the learning algorithms tuned for each registered environment, kept as data.

`ALGORITHM.json` holds settings by environment id, in the form of rl-zoo3's files; docs/agents.md says how they were
searched for and how good the agents are.
"""

from agents.tuned.tuned_settings import tuned_settings

__all__ = ["tuned_settings"]
