"""One row of the audit, and the distinct defects behind the rows that do not hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

# Agreement within the last printed digit of a four-digit number.
PRINTED_DIGITS = 5e-5


class Verdict(StrEnum):
    """What became of a claim."""

    HOLDS = "holds"
    # It holds but for the rounding of the printed numbers.
    ROUNDED = "holds, rounded"
    FAILS = "does not hold"
    # It depends on a choice that the paper leaves open.
    UNDECIDED = "undecided"
    NOT_PRINTED = "not printed"
    # It holds without what it is meant to demonstrate.
    VACUOUS = "vacuous"

    @classmethod
    def of(cls, holds: bool) -> Verdict:
        """Returns the verdict on a claim that can only hold or not."""
        return cls.HOLDS if holds else cls.FAILS


class Defect(StrEnum):
    """What is wrong with the paper; several rows can show the same."""

    INPUT_LIMIT = "the printed K is OP's optimum for |u| <= 6, not for the limit of 4"
    MARGIN = "(C2), the margin for disturbance and error, is not met and cannot be met at the printed bounds"
    EPSILON = "the printed epsilon is not the one that Theorems 2 and 3 give"
    NO_MARGIN_AT_ONE = "Definition 4 demands no margin at kappa = 1, against its own proof"
    ONLY_IF = "the condition of Theorem 5 is sufficient, but not necessary"
    BALL_OR_BOX = "Delta(gamma) is a ball in (3) and a box in Section 5"


@dataclass(frozen=True)
class Claim:
    """One claim of the paper and its verdict.

    Attributes:
        claim: What the paper says.
        printed: What the paper prints.
        computed: What follows from the paper's own numbers.
        verdict: A `Verdict`.
        charitable: Under which other reading it would hold, or how near it comes; empty if there is none.
        defect: The `Defect` that the row shows; empty unless it does not hold.
    """

    claim: str
    printed: str
    computed: str
    verdict: str
    charitable: str = ""
    defect: str = ""


def defects(claims: Sequence[Claim]) -> dict[str, list[int]]:
    """Returns the distinct defects in order of appearance, each with the numbers, from 1, of the rows that show it."""
    found: dict[str, list[int]] = {}
    for number, claim in enumerate(claims, 1):
        if claim.verdict == Verdict.FAILS:
            found.setdefault(claim.defect, []).append(number)
    return found
