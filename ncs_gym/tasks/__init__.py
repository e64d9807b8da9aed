"""Tasks: what an agent is rewarded for."""
