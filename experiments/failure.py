"""Units that end with an error."""

from __future__ import annotations

from experiments.unit import Unit


class UnitError(RuntimeError):
    """A unit failed; the message names it, the cause is its own error."""


def unit_error(unit: Unit, error: BaseException) -> UnitError:
    """Returns what to raise for a unit's error; only the unexpected ones show their type."""
    if isinstance(error, (ValueError, OSError, ImportError)):
        return UnitError(f"run {unit.name}: {error}")
    return UnitError(f"run {unit.name}: {type(error).__name__}: {error} (NCS_DEBUG=1 shows the traceback)")
