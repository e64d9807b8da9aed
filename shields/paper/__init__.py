"""The published method as printed: its bounds, its optimization problem, its search and its conditions."""
