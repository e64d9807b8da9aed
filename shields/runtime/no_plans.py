"""The rule of all modes but "lookahead": it plans nothing and needs no solver."""

from __future__ import annotations

from typing import Any

import numpy as np


class NoPlans:
    """Stands where `Lookahead` does, with plans of no inputs, shape (0, m) or (0, m, N): none is begun or resumed.

    Args:
        m: Number of inputs.

    Attributes:
        horizon: Longest plan, 0 steps.
        needs_shapes: Whether plans need the error shapes themselves.
    """

    horizon, needs_shapes = 0, False

    def __init__(self, m: int) -> None:
        self._m = m

    def as_stored(self, plan: Any) -> np.ndarray:
        """Returns a plan of no inputs, shape (0, m)."""
        return np.empty((0, self._m))

    def all_as_stored(self, plans: np.ndarray) -> np.ndarray:
        """Returns plans of no inputs, shape (N, 0, m), as they are."""
        return plans

    def beginning_alone(self, *_: Any) -> None:
        """Finds no plan."""

    def may_do_better(self, *_: Any) -> bool:
        """Returns False: nothing takes the place of a projected input."""
        return False

    def keep(self, *_: Any) -> None:
        """Lets no more inputs pass."""

    def complete(self, *_: Any) -> None:
        """Leaves decisions as they are."""

    def knows_in_box(self, *_: Any) -> bool:
        """Returns False: without plans, that x is in the box proves nothing."""
        return False
