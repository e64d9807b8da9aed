"""The actuator's side: a buffer that holds the committed inputs of the newest command."""

from __future__ import annotations

from collections.abc import Iterable
from operator import index
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.validation import as_count, as_numbers, shown


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
        """Starts an episode at step 0: commands of any other are discarded from now on.

        Raises:
            ValueError: If the number of the episode is no whole number from 0 on.
        """
        self._episode, self._newest = as_count(episode, "episode", low=0), None
        self.missing = False

    def receive(self, commands: Iterable[Command]) -> None:
        """Takes in what arrived, in any order; commands that are not newer than the newest are of no use.

        Raises:
            ValueError: If what is given are no commands for this actuator; nothing has changed then.
        """
        if isinstance(commands, Command) or not isinstance(commands, Iterable):
            raise ValueError(
                f"commands must be a list of Command(stamp, inputs), empty if nothing arrived, got {shown(commands)}"
            )
        for command in [_as_command(each, (self._lead + 1, len(self._nothing))) for each in commands]:
            if command.episode == self._episode and (self._newest is None or command.stamp > self._newest.stamp):
                self._newest = command

    def apply(self, step: int) -> np.ndarray:
        """Returns the input to apply at a step, shape (m,) [physical units], as a new array.

        Raises:
            ValueError: If the step is no whole number from 0 on.
        """
        step = as_count(step, "step", low=0)
        ahead = self._lead + 1 if self._newest is None else step - self._newest.stamp
        self.missing = not 0 <= ahead <= self._lead and step >= self._lead
        if self._newest is None or self.missing or step < self._lead:
            return self._nothing.copy()
        return self._newest.inputs[ahead].copy()


def _as_command(value: Any, shape: tuple[int, int]) -> Command:
    """Returns a command whose inputs have a shape, (c+1, m).

    Raises:
        ValueError: If stamp or episode is no whole number, or the inputs are not finite numbers of that shape.
    """
    stamp = episode = 0
    try:
        stamp, inputs, episode = value if isinstance(value, Command) else Command(*value)
        stamp, episode, numbers = index(stamp), index(episode), as_numbers(inputs)
    except (TypeError, ValueError):
        numbers = None
    if numbers is None or numbers.shape != shape or not np.isfinite(numbers).all():
        raise ValueError(
            "a command is Command(stamp, inputs) or Command(stamp, inputs, episode) with whole numbers and finite "
            f"inputs of shape {shape}, got {shown(value)}"
        )
    return Command(stamp, np.array(numbers), episode)
