"""The check of a horizon that commands share."""

from __future__ import annotations

from shields.runtime.safety_filter import LONGEST_HORIZON


def require_horizon(horizon: int | None, *modes: str | None) -> None:
    """Returns if a horizon may be given with these modes or arms; None may always.

    Raises:
        ValueError: If it is out of range, or none of them is or names "lookahead".
    """
    if horizon is None:
        return
    if not 1 <= horizon <= LONGEST_HORIZON:
        raise ValueError(f"--horizon must be at least 1 and at most {LONGEST_HORIZON}, got {horizon}")
    if not any("lookahead" in (mode or "") for mode in modes):
        raise ValueError(f"--horizon {horizon} is for mode lookahead, which is not asked for")
