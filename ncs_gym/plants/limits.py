"""The limits of a plant: rows of its safe box, its inputs, and limits around an operating point."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.validation import LARGEST_NUMBER, SMALLEST_NUMBER, as_matrix, as_numbers, as_setting, as_vector, shown

# The constant of x+ = A x + B u + c may differ by this from what an equilibrium needs, relative to its terms.
EQUILIBRIUM_PRECISION = 1e-12


def as_box_rows(value: Any, n: int) -> np.ndarray:
    """Returns the rows c_j of the safe box |c_j x| <= 1, shape (k, n).

    Args:
        value: Half-widths, a number or shape (n,), where infinity leaves an entry free; or the rows themselves, (k, n).
        n: Number of states.

    Raises:
        ValueError: If it is neither, limits nothing, or may as well be lower and upper limits.
    """
    numbers = as_setting(value)
    if numbers is None or numbers.ndim > 2:
        raise ValueError(f"box must be half-widths of shape ({n},) or rows of shape (any, {n}), got {shown(value)}")
    if numbers.ndim == 2 and _reads_as_two_sides(value, numbers, n):
        raise ValueError(
            "box looks like lower and upper limits, but must be half-widths, or rows c_j with |c_j x| <= 1: if these "
            "are limits, give their half-widths or, where they are not symmetric, LinearPlant.around(state_limits="
            "(low, high), ...); if these are rows, no two of them the same but for their signs, give them as an array, "
            f"got {shown(value)}"
        )
    rows = numbers
    if numbers.ndim < 2:
        limited = np.isfinite(numbers)
        fits = (numbers >= SMALLEST_NUMBER) & (numbers < LARGEST_NUMBER) | (numbers == np.inf)
        if numbers.shape not in ((), (n,)) or not fits.all() or not limited.any():
            raise ValueError(
                f"box must be positive half-widths of shape ({n},), infinite where a state has no limit but not "
                f"everywhere, or rows of shape (any, {n}), got {shown(value)}"
            )
        rows = np.diag(1.0 / np.broadcast_to(numbers, (n,)))[np.broadcast_to(limited, (n,))]
    rows = as_matrix(rows, (None, n), "box")
    if (np.abs(rows).max(axis=1) < SMALLEST_NUMBER).any():
        raise ValueError(f"every row of box must limit something, got {shown(rows.tolist())}")
    return rows


def _reads_as_two_sides(value: Any, rows: np.ndarray, n: int) -> bool:
    """Returns whether a box, as it was given and as rows (k, n), reads as (low, high), or as such a pair per state.

    Pairs of two states are told from rows by being tuples. Of an array, which is computed, only low = -high is refused,
    as rows the same limit twice.
    """
    is_computed = not isinstance(value, (tuple, list))
    if rows.shape == (n, 2) and (n != 2 or (not is_computed and all(isinstance(each, tuple) for each in value))):
        return True
    sides = [rows, rows.T] if rows.shape == (2, 2) else [rows] if len(rows) == 2 else []
    return any(bool((low < high).all()) and (not is_computed or np.array_equal(low, -high)) for low, high in sides)


def as_input_limits(value: Any, size: int) -> np.ndarray:
    """Returns input limits as a positive finite array of shape (size,).

    Raises:
        ValueError: If it is anything else.
    """
    limits = as_setting(value)
    if (
        limits is None
        or limits.shape not in ((), (size,))
        or not ((limits >= SMALLEST_NUMBER) & (limits < LARGEST_NUMBER)).all()
    ):
        raise ValueError(
            f"u_max must be a positive number or shape ({size},), got {shown(value)}; limits that are not symmetric "
            "are given by LinearPlant.around(input_limits=(low, high), ...)"
        )
    return np.broadcast_to(limits, (size,)).copy()


def as_operating_point(value: Any, size: int, name: str) -> np.ndarray:
    """Returns the state or the input that deviations are counted from, shape (size,); None stands for zero.

    Raises:
        ValueError: If it is no finite vector of this size.
    """
    return np.zeros(size) if value is None else as_point(value, size, name)


def as_point(value: Any, size: int, name: str) -> np.ndarray:
    """Returns a vector, shape (size,); a number stands for a vector of one entry.

    Raises:
        ValueError: If it is no finite vector of this size.
    """
    numbers = as_numbers(value)
    return as_vector([value] if size == 1 and numbers is not None and numbers.ndim == 0 else value, size, name)


def _symmetric_limits(limits: Any, center: np.ndarray, name: str) -> np.ndarray:
    """Returns the half-widths of the largest box around a point within limits, shape (size,); infinite where free.

    Args:
        limits: Pair (low, high), each a number or shape (size,), possibly infinite.
        center: Shape (size,).
        name: What the error message calls the limits.
    """
    sides = [as_setting(side) for side in limits] if isinstance(limits, (tuple, list)) and len(limits) == 2 else []
    for side in sides:
        if side is None or side.shape not in ((), center.shape) or np.isnan(side).any():
            sides = []
    if not sides:
        raise ValueError(
            f"{name} must be a pair (low, high), each a number or shape {center.shape}, got {shown(limits)}"
        )
    low, high = (np.broadcast_to(np.asarray(side), center.shape) for side in sides)
    if not ((low < center) & (center < high)).all():
        raise ValueError(
            f"{name} must have the operating point {shown(center.tolist())} strictly between them, got {shown(limits)}"
        )
    return np.minimum(high - center, center - low)


def _require_equilibrium(
    A: np.ndarray, B: np.ndarray, offset: np.ndarray, state: np.ndarray, applied: np.ndarray
) -> None:
    """Raises unless A x0 + B u0 + c = x0, but for rounding.

    Args:
        A: Shape (n, n).
        B: Shape (n, m).
        offset: c, shape (n,).
        state: x0, shape (n,).
        applied: u0, shape (m,).
    """
    missing = A @ state + B @ applied + offset - state
    terms = np.abs(A) @ np.abs(state) + np.abs(B) @ np.abs(applied) + np.abs(offset) + np.abs(state)
    if (np.abs(missing) <= EQUILIBRIUM_PRECISION * terms).all():
        return
    remedy = "leave out offset if the model is one of deviations from the operating point"
    rest = np.eye(len(A)) - A
    if np.linalg.cond(rest) < 1e9:
        equilibrium = np.linalg.solve(rest, B @ applied + offset).tolist()
        remedy = f"with this input the equilibrium is {shown(equilibrium)}, or {remedy}"
    raise ValueError(
        f"the operating point is no equilibrium: A x0 + B u0 + c - x0 = {shown(missing.tolist())}, not zero; {remedy}"
    )


def arguments_around(
    A: Any, B: Any, point: tuple[Any, Any], limits: tuple[Any, Any], settings: dict[str, Any]
) -> dict[str, Any]:
    """Returns the arguments of `LinearPlant` of `LinearPlant.around`.

    Raises:
        ValueError: If the point is not between the limits, or no equilibrium of a model with `offset`, or an argument
            does not fit.
    """
    twice = sorted({"box", "u_max"} & set(settings))
    if twice:
        raise ValueError(f"{' and '.join(twice)} follow from state_limits and input_limits: give these alone")
    A = as_matrix(A, (None, None), "A")
    A = as_matrix(A, (len(A), len(A)), "A")
    B = as_matrix(B, (len(A), None), "B")
    state = as_operating_point(point[0], len(A), "operating_state")
    applied = as_operating_point(point[1], B.shape[1], "operating_input")
    rest = {name: value for name, value in settings.items() if name != "offset"}
    if (offset := settings.get("offset")) is not None:
        _require_equilibrium(A, B, as_vector(offset, len(A), "offset"), state, applied)
    box = _symmetric_limits(limits[0], state, "state_limits")
    u_max = _symmetric_limits(limits[1], applied, "input_limits")
    return rest | {
        "A": A,
        "B": B,
        "box": box,
        "u_max": u_max,
        "operating_state": state,
        "operating_input": applied,
    }
