"""A synthesis under way: what it tells, when its user's time is over, and the best certificate so far."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

from ncs_gym import LinearPlant
from shields.certificate import Certificate
from shields.errors import Infeasible
from shields.verification import verify

# Called with a line of text: the stage, and the volume reached so far.
Progress = Callable[[str], object]


class Search:
    """Takes lines of progress, and raises `TimeoutError` once the limit of the processor's time [s] is over.

    Attributes:
        candidate: Makes the best certificate so far, not yet verified; None while there is none.
    """

    def __init__(self, progress: Progress | None = None, time_limit: float | None = None) -> None:
        self._progress, self._limit = progress, time_limit
        self._end = math.inf if time_limit is None else time.thread_time() + time_limit
        self._stage = "start"
        self.candidate: Callable[[], Certificate] | None = None

    def __call__(self, line: str) -> None:
        """Takes a line of progress: the stage, a colon, and what is reached."""
        self._stage = line.partition(":")[0]
        if self._progress is not None:
            self._progress(line)
        if time.thread_time() >= self._end:
            raise TimeoutError

    def best_in_time(self, plant: LinearPlant) -> Certificate:
        """Returns the best certificate so far, verified, where the time is over; raises Infeasible if there is none."""
        over = f"the time_limit of {self._limit:g} s was over"
        best = None if self.candidate is None else self.candidate()
        if best is None or not verify(best, plant).valid:
            raise Infeasible(f"{over} at {self._stage}, before a certificate was found: give more, or None", "T", 0.0)
        stopped = {"interrupted_at": f"{self._stage}, when {over}"}
        return replace(best, provenance=best.provenance | stopped)
