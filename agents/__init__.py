"""Training and evaluation of stable-baselines3 agents; needs the `train` extra."""
