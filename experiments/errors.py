"""What experiments raise."""

from __future__ import annotations


class ResultsError(ValueError):
    """A results file is missing, damaged or of another experiment."""


class SafetyBroken(RuntimeError):
    """A shielded loop left its safe set or its box, or its proof did not hold, although every assumption held."""
