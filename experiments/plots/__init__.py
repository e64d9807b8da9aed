"""Figures of comparisons and sweeps, and animations of episodes."""
