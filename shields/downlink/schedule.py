"""The inputs a shield decided that are not applied yet: what the actuator applies is compared with them."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from ncs_gym.validation import as_numbers


class Schedule:
    """The inputs decided for the next c steps of one control loop.

    Args:
        lead: c, the number of steps from a decision to its effect.
        inputs: m, the number of inputs.
    """

    def __init__(self, lead: int, inputs: int) -> None:
        self._lead, self._nothing = lead, [0.0] * inputs
        self.start()

    def start(self) -> None:
        """Starts an episode: the inputs of its first c steps are zero."""
        self._decided = deque([self._nothing] * self._lead)

    def __copy__(self) -> Schedule:
        twin = Schedule(self._lead, len(self._nothing))
        twin._decided = self._decided.copy()
        return twin

    def due(self, decided: list[float]) -> list[float]:
        """Adds the input decided at this step, and removes and returns the one that is to be applied at it."""
        self._decided.append(decided)
        return self._decided.popleft()


class VectorSchedule:
    """What `Schedule` does for N environments, the last axis of every array.

    Args:
        lead: c.
        inputs: m.
        size: N.
    """

    def __init__(self, lead: int, inputs: int, size: int) -> None:
        self._decided = [np.zeros((inputs, size)) for _ in range(lead)]

    def start(self, chosen: np.ndarray) -> None:
        """Starts episodes in some environments, given by a mask of shape (N,)."""
        for u in self._decided:
            u[:, chosen] = 0.0

    def due(self, decided: np.ndarray) -> np.ndarray:
        """Adds the inputs decided at this step, (m, N), and removes and returns those that are to be applied at it."""
        due, *self._decided = *self._decided, decided.copy()  # at once: never one too many, whatever interrupts a step
        return due


def as_decided(info: dict[str, Any], decided: np.ndarray, due: np.ndarray | None) -> tuple[np.ndarray, Any]:
    """Returns where the input taken is the one decided and, behind a downlink, the one applied the one that was due.

    Args:
        info: Says so.
        decided: Inputs decided in this step, shape (m, N).
        due: Inputs decided for this step, shape (m, N); None without a downlink, where True stands for the second.
    """
    taken = columns(info.get("input" if due is None else "input_committed"), decided.T.shape)
    same_input = (taken == decided).all(axis=0)
    if due is None:
        return same_input, True
    return same_input, (columns(info.get("input"), decided.T.shape) == due).all(axis=0)


def columns(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Returns rows as columns, the transpose of `shape`; NaN for what has another shape or is no numbers."""
    numbers = as_numbers(value)
    return np.full(shape[::-1], np.nan) if numbers is None or numbers.shape != shape else numbers.T
