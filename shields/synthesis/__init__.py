"""Offline synthesis of a safe set and its gain by semidefinite programming."""
