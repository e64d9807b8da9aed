"""A step function as the process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.body_simulation import Body
from ncs_gym.processes.process import Process
from ncs_gym.validation import as_flag, as_setting, shown


@dataclass(frozen=True)
class FunctionProcess(Process):
    """x+ = f(x, u) + d for a function f; the plant's declared disturbances without its remainder act on top.

    Attributes:
        function: Returns x+ of shape (n,), given x of shape (n,) and u of shape (m,) [physical units].
        vectorized: Whether it also takes arrays (n, N) and (m, N) of many environments, and returns (n, N).

    Raises:
        ValueError: If the function is none, or `vectorized` no truth value.
    """

    function: Callable[[np.ndarray, np.ndarray], np.ndarray]
    vectorized: bool = False

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise ValueError(f"the process must be a function (x, u) -> x+, got {shown(self.function)}")
        object.__setattr__(self, "vectorized", as_flag(self.vectorized, "vectorized"))

    def body(self, plant: LinearPlant, size: int | None) -> Body:
        """Returns what calls the function."""
        return FunctionBody(self.function, self.vectorized)


class FunctionBody(Body):
    """Calls a function, for all environments at once or for one after the other.

    Args:
        function: Returns x+, given x and u.
        vectorized: Whether it takes many environments at once.
    """

    def __init__(self, function: Callable[[np.ndarray, np.ndarray], np.ndarray], vectorized: bool) -> None:
        self._function, self.is_vectorized = function, vectorized

    def step(self, state: np.ndarray, u: np.ndarray) -> np.ndarray:  # noqa: D102
        if state.ndim > 1 and not self.is_vectorized:
            columns = [self._checked(x, v) for x, v in zip(state.T.copy(), u.T.copy(), strict=True)]
            return np.array(columns).T
        return self._checked(state.copy(), u.copy())

    def _checked(self, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns what the function returns.

        Raises:
            ValueError: If it is not finite or of another shape than the state.
        """
        value = self._function(state, u)
        moved = as_setting(value)
        if moved is None or moved.shape != state.shape or not np.isfinite(moved).all():
            raise ValueError(f"the process must return a finite next state of shape {state.shape}, got {shown(value)}")
        return moved
