"""Bisection to the edge of what a test lets pass, where a wrong rounding would show."""

from __future__ import annotations

from collections.abc import Callable


def edge_of(passes: Callable[[float], bool], high: float, tries: int = 60) -> float:
    """The largest number from 0 on that was found to pass; 0 if none was."""
    low = 0.0
    for _ in range(tries):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if passes(middle) else (low, middle)
    return low


def gained(shield, estimate):
    """K x_hat, shape (m,), as a filter applies it."""
    return shield._gained(estimate[:, None])[:, 0]
