"""The actuator's side: a buffer that holds the committed inputs of the newest command."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ncs_gym.validation import as_count


class Command(NamedTuple):
    """What is sent to the actuator at one step.

    Attributes:
        stamp: Step k at which it was sent, counted from the start of its episode.
        inputs: The committed inputs of steps k .. k + c, shape (c+1, m) [physical units].
        episode: Number of that episode.
    """

    stamp: int
    inputs: np.ndarray
    episode: int = 0


class Actuator:
    """Applies at each step the input that was committed for it, or zero if no command with it has arrived.

    Commands may be lost, late, duplicated or overtake each other: what is committed for a step is the same in each
    command that holds it, so that the newest is enough. The first c inputs of an episode are zero by agreement.

    Args:
        lead: c, the number of steps from a decision to its effect.
        inputs: m, the number of inputs.

    Attributes:
        missing: Whether the input applied last was zero because the committed one had not arrived.

    Raises:
        ValueError: If an argument is no whole number of its range.
    """

    def __init__(self, lead: int, inputs: int) -> None:
        self._lead = as_count(lead, "lead", low=0)
        self._nothing = np.zeros(as_count(inputs, "inputs", low=1))
        self.start()

    def start(self, episode: int = 0) -> None:
        """Starts an episode at step 0: commands of any other are discarded from now on."""
        self._episode, self._newest = episode, None
        self.missing = False

    def receive(self, commands: Iterable[Command]) -> None:
        """Takes in what arrived, in any order; commands that are not newer than the newest are of no use."""
        for command in commands:
            if command.episode == self._episode and (self._newest is None or command.stamp > self._newest.stamp):
                self._newest = command

    def apply(self, step: int) -> np.ndarray:
        """Returns the input to apply at a step, shape (m,) [physical units], as a new array."""
        index = self._lead + 1 if self._newest is None else step - self._newest.stamp
        self.missing = not 0 <= index <= self._lead and step >= self._lead
        if self._newest is None or self.missing or step < self._lead:
            return self._nothing.copy()
        return self._newest.inputs[index].copy()
