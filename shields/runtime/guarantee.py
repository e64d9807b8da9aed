"""Why a state is not proved safe, and how that is said."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.validation import shown, warn_caller
from shields.errors import GuaranteeLostError, GuaranteeLostWarning

ALARM = "a measurement contradicts the assumed bounds"
OUTSIDE_BOUND = "the simulation saw a step outside the bound on disturbances of the model"
NOT_FINITE = "a sample held NaN or infinity: where a sensor has no reading, no packet may be sent"
OTHER_INPUT = "the input applied is not the one decided"
OTHER_STEPS = "the environment did not move exactly one step"
LARGE_ERROR = "the error ellipsoid is not inside a certified one to stay"
OLD_SAMPLE = "the newest sample used is older than the contract allows"
FAR_OUT = "the estimate is so far out of the safe box that rounding counts"
UNUSABLE = "there is no usable estimate or error shape"
NOT_KNOWN_INSIDE = "the state is not known to be in the safe set"
LEFT_MODEL = "the state is not known to have stayed where the bound of the linear model's remainder holds"
LATE_INPUT = "the downlink broke its contract: an input decided earlier was not applied"
NO_DOWNLINK_CONTRACT = "the downlink has no contract: nothing says that inputs arrive in time"
# Of loops that learn from echoes what was applied; no monitor says so.
NOT_CONFIRMED = "the actuator has not confirmed for too long that it applies what is decided"
OTHER_EPISODE = "the actuator echoes inputs of another episode: tell it the episode of the loop"
# Codes of `GuaranteeMonitor.reasons` (`guard`); 0 while the proof holds.
EXPLANATIONS = (
    "", ALARM, OTHER_INPUT, OTHER_STEPS, LARGE_ERROR, FAR_OUT, UNUSABLE, NOT_KNOWN_INSIDE,
    LEFT_MODEL, LATE_INPUT, NO_DOWNLINK_CONTRACT, OLD_SAMPLE, NOT_CONFIRMED, NOT_FINITE,
    OTHER_EPISODE, OUTSIDE_BOUND,
)  # fmt: skip
CODES = {explanation: code for code, explanation in enumerate(EXPLANATIONS)}
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
            text = f"the state is not proved safe now: {EXPLANATIONS[code]}"
            if self.on_unproved == "raise":
                raise GuaranteeLostError(text)
            warn_caller(text, GuaranteeLostWarning)

    def tell_of(self, reason: str) -> None:
        """Says why a single loop is not proved safe, unless the reason is empty or was given in this episode."""
        self.note(CODES[reason])
        self.tell()
