"""Ellipsoids, sums of them, truncated noise and disturbances: what the guarantees assume about nature."""
