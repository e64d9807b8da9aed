"""What the actuator applies is compared with what a shield decided for that step."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.validation import as_numbers


def as_decided(info: dict[str, Any], decided: np.ndarray, due: np.ndarray | None) -> tuple[np.ndarray, Any]:
    """Returns where the input taken is the one decided and, behind a downlink, the one applied the one that was due.

    Args:
        info: Says so.
        decided: Inputs decided in this step, shape (m, N).
        due: Inputs decided for this step, shape (m, N); None without a downlink, where True stands for the second.
    """
    taken = columns(info.get("input" if due is None else "input_committed"), decided.T.shape)
    same_input = (taken == decided).all(axis=0)
    if due is None:
        return same_input, True
    return same_input, (columns(info.get("input"), decided.T.shape) == due).all(axis=0)


def columns(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Returns rows as columns, the transpose of `shape`; NaN for what has another shape or is no numbers."""
    numbers = as_numbers(value)
    return np.full(shape[::-1], np.nan) if numbers is None or numbers.shape != shape else numbers.T
