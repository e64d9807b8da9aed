"""The control loop as a Gymnasium environment, one at a time and vectorized."""
