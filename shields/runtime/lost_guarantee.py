"""Says that a guarantee is lost, where nobody may be looking at the infos."""

from __future__ import annotations

import sys
import warnings
from typing import Any

import numpy as np

from ncs_gym.validation import shown
from shields.errors import GuaranteeLostError, GuaranteeLostWarning
from shields.runtime.guarantee import CODES, EXPLANATIONS

ON_UNPROVED = ("ignore", "warn", "raise")


class LostGuarantee:
    """Says once per episode and reason that the state is not proved safe.

    What is noted is said by `tell`, which comes after everything else in a step: when it raises, the step has happened.

    Args:
        on_unproved: "ignore" says nothing; "warn" warns the first caller outside this package; "raise" raises.
        count: Number of control loops side by side.

    Raises:
        ValueError: If it is none of these.
    """

    def __init__(self, on_unproved: str, count: int = 1) -> None:
        if not (isinstance(on_unproved, str) and on_unproved in ON_UNPROVED):
            raise ValueError(f"on_unproved must be one of {list(ON_UNPROVED)}, got {shown(on_unproved)}")
        self.on_unproved = on_unproved
        self._said = np.zeros((count, len(EXPLANATIONS)), np.bool_)
        self._news: frozenset[int] = frozenset()

    def saved(self) -> dict[str, Any]:
        """Returns all that changes, as attributes to be put back."""
        return {"_said": self._said.copy(), "_news": self._news}

    def begin(self, restarted: Any = slice(None)) -> None:
        """Begins episodes, in which nothing has been said, in the loops chosen by a mask or index."""
        self._said[restarted] = False

    def note(self, codes: Any, loops: Any = 0) -> None:
        """Takes in why some loops are not proved safe, as indices of `EXPLANATIONS`: 0 for those that are."""
        if self.on_unproved == "ignore":
            return
        codes = np.asarray(codes)
        fresh = (codes > 0) & ~self._said[loops, codes]
        if np.count_nonzero(fresh):
            self._said[loops, codes] = True
            self._news |= set(codes[fresh].tolist())

    def tell(self) -> None:
        """Says what was noted since the last call and is new.

        Raises:
            GuaranteeLostError: If there is something new and that is to be raised.
        """
        news, self._news = sorted(self._news), frozenset()
        for code in news:
            text = f"the state is not proved safe now: {EXPLANATIONS[code]} (docs/shield.md says what the reasons mean)"
            if self.on_unproved == "raise":
                raise GuaranteeLostError(text)
            warnings.warn(text, GuaranteeLostWarning, stacklevel=_levels_to_the_caller())

    def tell_of(self, reason: str) -> None:
        """Says why a single loop is not proved safe, unless the reason is empty or was given in this episode."""
        if reason:
            self.note(CODES[reason])
            self.tell()


def _levels_to_the_caller() -> int:
    """Returns the stack level, as `warnings.warn` in `tell` counts it, of the first caller outside this package."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("shields."):
        level, frame = level + 1, frame.f_back
    return level
