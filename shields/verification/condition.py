"""The outcome of checking one condition in exact arithmetic."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from shields.verification.rational_matrix import Matrix, is_positive_semidefinite, to_float

# Rounding an action in [-1, 1] to float32 changes it by at most this.
ACTION_ROUNDING = Fraction(1, 2**24)
# The margin of a violated condition is at most this, the largest negative float.
_LARGEST_NEGATIVE = -5e-324


@dataclass(frozen=True)
class Condition:
    """One checked condition.

    Attributes:
        name: Label of the condition in docs/shield_proof.md and what it says.
        margin: Signed margin as a float, for people: the smallest eigenvalue of a matrix inequality or the slack of a
            scalar one; at least 0 exactly if the condition holds.
        holds: Whether the condition holds, decided in exact arithmetic.
    """

    name: str
    margin: float
    holds: bool


def flag(name: str, holds: bool) -> Condition:
    """Returns a condition that is true or false and has no slack: its margin is 0 or -1."""
    return Condition(name, 0.0 if holds else -1.0, holds)


def scalar_condition(name: str, slack: Fraction) -> Condition:
    """Returns the condition slack >= 0."""
    try:
        margin = float(slack)
    except OverflowError:
        margin = np.inf if slack >= 0 else -np.inf
    # A negative slack may be too small for a float.
    return Condition(name, margin if slack >= 0 else min(margin, _LARGEST_NEGATIVE), slack >= 0)


def matrix_condition(name: str, matrix: Matrix, *, strict: bool = False) -> Condition:
    """Returns the condition that a symmetric matrix is positive semidefinite (definite if `strict`)."""
    holds = is_positive_semidefinite(matrix, strict=strict)
    try:
        smallest = float(np.linalg.eigvalsh(to_float(matrix))[0])
    except OverflowError:  # exact, but beyond any float
        smallest = np.inf if holds else -np.inf
    # Rounding may give the float the wrong sign; the exact verdict decides.
    margin = max(smallest, 0.0) if holds else min(smallest, _LARGEST_NEGATIVE)
    return Condition(name, margin, holds)
