"""The controller's side: the inputs that are decided and not yet applied."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from ncs_gym.downlink.actuator import Command


class CommittedInputs:
    """A queue of the inputs of the next c steps; once an input is in it, it is never changed.

    Args:
        lead: c, the number of steps from a decision to its effect.
        inputs: m, the number of inputs.
    """

    def __init__(self, lead: int, inputs: int) -> None:
        self._lead, self._inputs = lead, inputs
        self.start()

    def start(self) -> None:
        """Starts an episode: the inputs of its first c steps are zero."""
        self._queue: deque[np.ndarray] = deque(np.zeros(self._inputs) for _ in range(self._lead))

    def saved(self) -> dict[str, Any]:
        """Returns all that changes, as attributes to be put back."""
        return {"_queue": self._queue.copy()}

    def commit(self, u: np.ndarray) -> None:
        """Adds the input decided now, shape (m,), behind those committed."""
        self._queue.append(np.array(u, dtype=np.float64))

    def command(self, step: int, episode: int) -> Command:
        """Returns the command to send at a step, after the commitment of that step."""
        return Command(step, np.array(self._queue), episode)

    def pop(self) -> np.ndarray:
        """Removes and returns the input whose step has come, shape (m,)."""
        return self._queue.popleft()

    @property
    def pending(self) -> list[np.ndarray]:
        """The committed inputs in the order of their steps; after `pop` those of the next c steps."""
        return list(self._queue)
