"""A synthesis under way: what it tells, when its user's time is over, and the best certificate so far."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

from ncs_gym import LinearPlant
from shields.certificate import Certificate
from shields.certificate_text import size_of
from shields.errors import Infeasible, SynthesisInterrupted
from shields.verification import verify

# Called with a line of text: the stage, and the volume reached so far.
Progress = Callable[[str], object]


class Search:
    """Takes lines of progress, and raises `TimeoutError` at one of them once the time limit is over.

    Attributes:
        candidate: Makes the best certificate so far, not yet verified; None while there is none.
        refusal: Why there is no certificate, once that is known.
    """

    def __init__(self, progress: Progress | None = None, time_limit: float | None = None) -> None:
        """Begins a search.

        Args:
            progress: Called with every line.
            time_limit: Of the processor's time of this thread [s]; None for none.
        """
        self._progress, self._limit = progress, time_limit
        self._end = math.inf if time_limit is None else time.thread_time() + time_limit
        self._stage = "start"
        self.candidate: Callable[[], Certificate] | None = None
        self.refusal: Infeasible | None = None

    def __call__(self, line: str) -> None:
        """Takes a line of progress: the stage, a colon, and what is reached."""
        self._stage = line.partition(":")[0]
        if self._progress is not None:
            self._progress(line)
        if time.thread_time() >= self._end:
            raise TimeoutError

    def best_in_time(self, plant: LinearPlant) -> Certificate:
        """Returns the best certificate so far, verified, where the time is over.

        Raises:
            Infeasible: If there is none.
        """
        over = f"the time_limit of {self._limit:g} s was over"
        best = self._verified(plant, f"{self._stage}, when {over}")
        if best is not None:
            return best
        if self.refusal is not None:
            told = self.refusal
            raise Infeasible(f"{told} ({over} at {self._stage})", told.binding, told.shortfall, told.details)
        raise Infeasible(f"{over} at {self._stage}, before a certificate was found: give more, or None", "T", 0.0)

    def interrupted(self, plant: LinearPlant) -> SynthesisInterrupted:
        """Returns the exception for an interrupt, with the best certificate so far if it verifies."""
        message, best = f"interrupted: the synthesis was at {self._stage}", self._verified(plant, self._stage)
        if best is not None:
            return SynthesisInterrupted(f"{message}, its best certificate has {size_of(best)}", best)
        why = "" if self.refusal is None else f": {self.refusal}"
        return SynthesisInterrupted(f"{message} and had no certificate yet{why}")

    def _verified(self, plant: LinearPlant, stage: str) -> Certificate | None:
        best = None if self.candidate is None else self.candidate()
        if best is None or not verify(best, plant).valid:
            return None
        return replace(best, provenance=best.provenance | {"interrupted_at": stage})
