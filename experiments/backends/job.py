"""A job, the unit that every executor takes: worker processes of this machine, or a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, eq=False)
class Job:
    """A training run or a part of an attack, to be executed in another process.

    Attributes:
        name: Name in progress lines and messages.
        steps: Number of simulated steps.
        work: Returns the result, given a function to call with the number of steps taken since its last call. It is
            pickled on its way to the process, and so is the result on its way back.
    """

    name: str
    steps: int
    work: Callable[[Callable[[int], None]], Any]


# Called with each job and its result when it is finished.
OnResult = Callable[[Job, Any], None]
