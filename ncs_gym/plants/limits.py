"""The limits of a plant: rows of its safe box, its inputs, and limits around an operating point."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any, NamedTuple

import numpy as np

from ncs_gym import exact
from ncs_gym.plants.hard_bounds import FREE_REACH, reach_in_steps, weight_of
from ncs_gym.uncertainty.declared_bound import as_bound
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.uncertainty.shape_matrices import outer_sum
from ncs_gym.validation import (
    LARGEST_NUMBER,
    SMALLEST_NUMBER,
    as_matrix,
    as_numbers,
    as_setting,
    as_vector,
    shown,
    warn_caller,
)

# Arguments of the constructor of `LinearPlant` that become fields of other names.
PUBLISHED = "state_limits", "input_limits", "output_limits", "mixed_limits", "u_max", "offset"
# What to give where an operating point that was not given is outside absolute limits.
_POINT_TO_GIVE = {
    f"{name}_limits": f": limits are absolute, so give operating_{name}=, around which the model was linearized"
    for name in ("state", "input")
}
# Ends that differ from symmetric ones by less, relative to the nearer one, are symmetric: that is rounding.
NEARLY_SYMMETRIC = 1e-12
# The constant of x+ = A x + B u + c may differ by this from what an equilibrium needs, relative to its terms.
EQUILIBRIUM_PRECISION = 1e-12
# What is found of such a point is rounded to this, in units of the limits.
POINT_PRECISION = 1e-11


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
            "are limits, give their half-widths or, where they are not symmetric, LinearPlant(state_limits="
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
    and of either the same in the other order: as rows that is one limit twice.
    """
    is_computed = not isinstance(value, (tuple, list))
    if rows.shape == (n, 2) and (n != 2 or (not is_computed and all(isinstance(each, tuple) for each in value))):
        return True
    sides = [rows, rows.T] if rows.shape == (2, 2) else [rows] if len(rows) == 2 else []
    return any(np.array_equal(low, -high) or (not is_computed and bool((low < high).all())) for low, high in sides)


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


def as_points(value: Any, size: int, name: str) -> np.ndarray:
    """Returns what `as_point` does, or many of these, shape (N, size).

    Raises:
        ValueError: If a row is no finite vector of this size.
    """
    numbers = as_numbers(value)
    if numbers is None or numbers.ndim != 2:
        return as_point(value, size, name)
    return np.array([as_point(row, size, name) for row in numbers]).reshape(len(numbers), size)


def sides(limits: Any, size: int, name: str, *, may_meet: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Returns the low and the high ends of limits, shape (size,) each; infinite where there is none.

    Args:
        limits: Pair (low, high), each a number or shape (size,), possibly infinite.
        size: Number of limited quantities.
        name: What the error message calls the limits.
        may_meet: Whether a low end may be the high one.

    Raises:
        ValueError: If it is no such pair, or a low end is not below the high one.
    """
    ends = [as_setting(side) for side in limits] if isinstance(limits, (tuple, list, np.ndarray)) else []
    if len(ends) != 2 or any(side is None or side.shape not in ((), (size,)) or np.isnan(side).any() for side in ends):
        raise ValueError(f"{name} must be a pair (low, high), each a number or shape ({size},), got {shown(limits)}")
    low, high = (np.broadcast_to(np.asarray(side), (size,)).copy() for side in ends)
    if not (low <= high if may_meet else low < high).all():
        order = "low <= high" if may_meet else "low < high"
        raise ValueError(
            f"{name} must be (low, high), each a number or a vector, with {order} everywhere, got {shown(limits)}"
        )
    return low, high


def _from_center(limits: Any, center: np.ndarray, name: str, *, is_given: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ends of limits as distances from a point between them, shape (size,) each; infinite where free.

    `is_given` tells whether somebody gave that point.

    Raises:
        ValueError: If they are no limits, or the point is not strictly between them, by more than rounding.
    """
    low, high = sides(limits, len(center), name)
    if not ((low < center) & (center < high)).all():
        at_end, remedy = np.flatnonzero((low == center) | (center == high)), _POINT_TO_GIVE.get(name, "")
        if is_given or not remedy:
            remedy = (
                ""
                if not len(at_end)
                else (
                    f": entry {at_end[0] + 1} rests at its end, from where nothing can move it both ways; give an "
                    "equilibrium whose states and inputs are inside their limits"
                )
            )
        raise ValueError(
            f"{name} must have the operating point {shown(center.tolist())} strictly between them, got {shown(limits)}"
            f"{remedy}"
        )
    low, high = low - center, high - center
    nearest, finite = np.minimum(-low, high), np.isfinite(low) & np.isfinite(high)
    nearly = finite & (np.abs(low + high) <= NEARLY_SYMMETRIC * nearest)
    low, high = np.where(nearly, -nearest, low), np.where(nearly, nearest, high)
    size = np.where(np.isfinite([low, high]), np.abs([low, high]), 1.0)
    if not ((size >= SMALLEST_NUMBER) & (size < LARGEST_NUMBER)).all():
        raise ValueError(f"{name} must be finite numbers of usual size, or infinite, got {shown(limits)}")
    return low, high


class ChosenLimitsWarning(UserWarning):
    """No state has a limit: half-widths of the safe box were chosen, far beyond what inputs reach in a few steps."""


class MovedOperatingPointWarning(UserWarning):
    """A disturbance with two different ends moves the point that deviations are counted from."""


class Rows(NamedTuple):
    """Limits low <= c_j x <= high, or of states and inputs low <= c_j (x, u) <= high, in units of half their range.

    Attributes:
        rows: c, shape (k, n) or (k, n + m): half the range of a row is 1; where an end is infinite, the other one is -1
            or 1.
        low, high: Their ends, shape (k,); infinite where there is none.
    """

    rows: np.ndarray
    low: np.ndarray
    high: np.ndarray


def in_units_of_range(rows: np.ndarray, low: np.ndarray, high: np.ndarray) -> Rows:
    """Returns those of rows, (k, n), with ends in their own units that have any finite end."""
    limited = np.isfinite(low) | np.isfinite(high)
    rows, low, high = rows[limited], low[limited], high[limited]
    half = np.where(np.isfinite(low) & np.isfinite(high), 0.5 * (high - low), np.minimum(-low, high))
    symmetric = -low == high
    low, high = np.where(symmetric, -1.0, low / half), np.where(symmetric, 1.0, high / half)
    return Rows(
        (1.0 / half)[:, None] * rows, np.where(low < -1e300, -np.inf, low), np.where(high > 1e300, np.inf, high)
    )


def _state_rows(limits: Any, center: np.ndarray, *, is_given: bool) -> Rows:
    return in_units_of_range(np.eye(len(center)), *_from_center(limits, center, "state_limits", is_given=is_given))


def _output_rows(outputs: Any, center: np.ndarray) -> Rows:
    """Returns the rows of output_limits, a list of (row, low, high) with absolute ends."""
    form = f"output_limits must be a list of (row, low, high), each row of shape ({len(center)},)"
    if not isinstance(outputs, (list, tuple)) or not all(
        isinstance(each, (list, tuple)) and len(each) == 3 for each in outputs
    ):
        raise ValueError(f"{form}, got {shown(outputs)}")
    found = []
    for row, low, high in outputs:
        row = as_vector(row, len(center), "a row of output_limits")
        if np.abs(row).max() < SMALLEST_NUMBER:
            raise ValueError(f"every row of output_limits must limit something, got {shown(row.tolist())}")
        ends = _from_center((low, high), exact.product(row[None], center), "the ends in output_limits")
        found.append(in_units_of_range(row[None], *ends))
    return _joined(found)


def _mixed_rows(given: Any, state: np.ndarray, applied: np.ndarray) -> Rows:
    """Returns the rows on (x, u) of mixed_limits, a list of (state row, input row, low, high) with absolute ends."""
    n, m = len(state), len(applied)
    form = f"mixed_limits must be a list of (state row of shape ({n},), input row of shape ({m},), low, high)"
    if not isinstance(given, (list, tuple)) or not all(
        isinstance(each, (list, tuple)) and len(each) == 4 for each in given
    ):
        raise ValueError(f"{form}, got {shown(given)}")
    found = [Rows(np.empty((0, n + m)), np.empty(0), np.empty(0))]
    for of_state, of_input, low, high in given:
        row = np.concatenate(
            [
                as_point(of_state, n, "the state row of a limit in mixed_limits"),
                as_point(of_input, m, "the input row of a limit in mixed_limits"),
            ]
        )
        if np.abs(row[n:]).max() < SMALLEST_NUMBER:
            raise ValueError(
                f"every limit in mixed_limits must be about an input, got {shown(row.tolist())}: output_limits are "
                "those of states alone"
            )
        ends = _from_center(
            (low, high), exact.product(row[None], np.concatenate([state, applied])), "the ends in mixed_limits"
        )
        found.append(in_units_of_range(row[None], *ends))
    return _joined(found)


def _joined(parts: Sequence[Rows]) -> Rows:
    return Rows(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def as_row_ends(value: Any, rows: int, name: str = "box_ends", *, around_zero: bool = True) -> np.ndarray:
    """Returns the low and the high ends of rows, shape (2, rows); -1 and 1 for None.

    Args:
        value: A pair, in lists of which None stands for an infinite end, as in files; or None.
        rows: Their number.
        name: What the error message calls them.
        around_zero: Whether zero has to be between them.

    Raises:
        ValueError: If they are no such ends, or a row has none.
    """
    if value is None:
        return np.array([[-1.0], [1.0]]) * np.ones(rows)
    if isinstance(value, list) and len(value) == 2:
        value = [_with_infinity(side, sign) for side, sign in zip(value, (-np.inf, np.inf), strict=True)]
    low, high = sides(value, rows, name)
    if around_zero and not ((low < 0.0) & (high > 0.0)).all():
        raise ValueError(f"{name} must have 0 between them, got {shown(value)}")
    if not (np.isfinite(low) | np.isfinite(high)).all():
        raise ValueError(f"one of {name} must be finite for each row, got {shown(value)}")
    return np.stack([low, high])


def as_mixed_rows(value: Any, size: int) -> np.ndarray:
    """Returns the rows of limits of states and inputs together, shape (q, size); of shape (0, size) for None or [].

    Raises:
        ValueError: If they are no such rows.
    """
    numbers = np.empty(0) if value is None else as_setting(value)
    return (
        np.empty((0, size))
        if numbers is not None and not numbers.size
        else as_matrix(value, (None, size), "mixed_rows")
    )


def listed_ends(ends: np.ndarray) -> list[Any]:
    """Returns ends of any shape as nested lists for a file, in which None stands for an infinite one."""
    if ends.ndim > 1:
        return [listed_ends(each) for each in ends]
    return [each if np.isfinite(each) else None for each in ends.tolist()]


def _with_infinity(ends: Any, infinity: float) -> Any:
    """Returns ends that may be a file's, in which None stands for an infinite one."""
    return [infinity if each is None else each for each in ends] if isinstance(ends, list) else ends


def as_input_limits(value: Any, size: int, name: str = "u_max") -> np.ndarray:
    """Returns u_max, or what else limits inputs alike, as a positive finite array of shape (size,).

    Raises:
        ValueError: If it is anything else.
    """
    limits = as_setting(value)
    if (
        limits is None
        or limits.shape not in ((), (size,))
        or not ((limits >= SMALLEST_NUMBER) & (limits < LARGEST_NUMBER)).all()
    ):
        hint = "; limits that are not symmetric are given by LinearPlant(input_limits=(low, high), ...)"
        raise ValueError(
            f"{name} must be a positive number or shape ({size},), got {shown(value)}{hint * (name == 'u_max')}"
        )
    return np.broadcast_to(limits, (size,)).copy()


def as_input_ends(value: Any, size: int) -> np.ndarray:
    """Returns the limits of inputs in deviations, shape (2, size): low ones below 0, high ones above, all finite.

    Raises:
        ValueError: If they are no such pair.
    """
    low, high = sides(value, size, "input_ends")
    sizes = np.abs([low, high])
    if not ((low < 0.0) & (high > 0.0) & (sizes >= SMALLEST_NUMBER) & (sizes < LARGEST_NUMBER)).all():
        raise ValueError(f"input_ends must be finite, below and above 0, got {shown(value)}")
    return np.stack([low, high])


def _with_residual(bound: Ellipsoid, missing: np.ndarray, rows: np.ndarray) -> Ellipsoid:
    """Returns a bound of d with what a point lacks of an equilibrium, doubled; rows, (k, n), give the units."""
    n = len(missing)
    if not missing.any():
        return bound
    gram = exact.product(rows.T, rows)
    lacking = np.diag(n * np.square(2.0 * np.abs(missing)))
    return Ellipsoid(outer_sum(bound.shape_matrix, lacking, gram + np.eye(n) * np.trace(gram) / n))


def _residual_of_equilibrium(
    A: np.ndarray, B: np.ndarray, offset: np.ndarray, state: np.ndarray, applied: np.ndarray
) -> np.ndarray:
    """Returns A x0 + B u0 + c - x0, rounded once, shape (n,).

    Raises:
        ValueError: If that is more than rounding.

    Args:
        A: Shape (n, n).
        B: Shape (n, m).
        offset: c, shape (n,).
        state: x0, shape (n,).
        applied: u0, shape (m,).
    """
    missing = exact.product(
        np.hstack([A, B, np.eye(len(A)), -np.eye(len(A))]), np.concatenate([state, applied, offset, state])
    )
    terms = np.abs(A) @ np.abs(state) + np.abs(B) @ np.abs(applied) + np.abs(offset) + np.abs(state)
    if (np.abs(missing) <= EQUILIBRIUM_PRECISION * terms).all():
        return missing
    remedy = "leave out offset, which is c of a step, if the model is one of deviations from the operating point"
    rest = np.eye(len(A)) - A
    if exact.rank(rest) == len(A):
        equilibrium = exact.product(exact.inverse(rest), B @ applied + offset).tolist()
        remedy = f"with this input the equilibrium is {shown(equilibrium)}, or {remedy}"
    raise ValueError(
        f"the operating point is no equilibrium: A x0 + B u0 + c - x0 = {shown(missing.tolist())}, not zero; {remedy}"
    )


def _sizes(value: Any, n: int) -> np.ndarray:
    """Returns the sizes of a constant disturbance, shape (n,); None stands for zero."""
    return np.abs(as_operating_point(value, n, "step_offset"))


def require_given_once(arguments: dict[str, Any]) -> None:
    """Raises ValueError if a field is given beside a published argument that it follows from."""
    follows = {"box_ends": ("state_limits",), "input_ends": ("u_max", "input_limits"), "step_offset": ("offset",)}
    for ends, others in follows.items():
        if arguments.get(ends) is not None:
            for other in others:
                if arguments.get(other) is not None:
                    raise ValueError(f"give {ends} or {other}, not both")


def fields_of(arguments: dict[str, Any]) -> dict[str, Any]:
    """Returns the fields of `LinearPlant` for the arguments of its constructor: limits become rows with two ends.

    What is wrong with other arguments is left to the plant, which says it first.

    Raises:
        TypeError: If no limits are given.
        ValueError: If limits are wrong or given twice, or the operating point is no equilibrium of a model with
            `offset`.
    """
    arguments = {name: value for name, value in arguments.items() if not _is_no_limit(name, value)}
    _require_limits(arguments)
    given = {name: arguments.get(name) for name in (*PUBLISHED, "operating_state", "operating_input")}
    fields = {name: value for name, value in arguments.items() if name not in PUBLISHED}
    A, B = as_setting(fields.get("A")), as_setting(fields.get("B"))
    if A is None or B is None or A.ndim != 2 or B.ndim != 2 or len(A) != A.shape[1] or len(B) != len(A) or not B.size:
        return fields | {"box": 1.0, "input_ends": (-1.0, 1.0)}  # A or B is wrong
    n, m = B.shape
    state = as_operating_point(fields.get("operating_state"), n, "operating_state")
    applied = as_operating_point(fields.get("operating_input"), m, "operating_input")
    _require_operating_input(arguments, state)
    lacking = np.zeros(n)
    if given["offset"] is not None:
        offset = as_vector(given["offset"], n, "offset")
        fields["step_offset"] = np.abs(offset)
        lacking = _residual_of_equilibrium(A, B, offset, state, applied)
    fields |= _input_fields(given, applied)
    if all(arguments.get(name) is None for name in ("box", "state_limits", "output_limits")):
        fields["box"] = _chosen_half_widths(A, B, fields["input_ends"])
    fields = _row_fields(fields, given, state)
    fields = _mixed_fields(fields, given["mixed_limits"], state, applied)
    bound = fields.get("disturbance_bound")
    if _is_between_ends(bound):
        return fields | _around_middle_of_disturbance(A, B, bound, fields, (state, applied), lacking)
    if lacking.any():
        declared = as_bound(np.zeros(n) if bound is None else bound, n, "disturbance_bound")
        fields["disturbance_bound"] = _with_residual(declared, lacking, as_box_rows(fields["box"], n))
    return fields


def _chosen_half_widths(A: np.ndarray, B: np.ndarray, input_ends: Any) -> np.ndarray:
    """Returns half-widths for states without limits, shape (n,): many times what inputs reach in n steps.

    Raises:
        TypeError: If no input moves a state, so that nothing says how large it gets.
    """
    n, m = B.shape
    reach = reach_in_steps(A, B, np.abs(as_input_ends(input_ends, m)).max(axis=0), np.zeros(n))
    if not reach.all():
        raise TypeError(f"LinearPlant needs limits: no input moves state {reach.argmin() + 1}, so give state_limits")
    widths = np.array([float(exact.rounded(FREE_REACH * each, 1)) for each in reach])
    text = (
        f"no state has a limit: half-widths {shown(widths.tolist())} were chosen, give box or state_limits for others"
    )
    warn_caller(text, ChosenLimitsWarning)
    return widths


def _is_no_limit(name: str, value: Any) -> bool:
    """Returns whether an argument is limits without any: an empty list, or ends that are all infinite."""
    if name in ("output_limits", "mixed_limits"):
        return isinstance(value, list | tuple) and not len(value)
    ends = [as_setting(end) for end in value] if name == "state_limits" and isinstance(value, list | tuple) else []
    return len(ends) == 2 and all(
        end is not None and (end == infinity).all() for end, infinity in zip(ends, (-np.inf, np.inf), strict=True)
    )


def _require_limits(arguments: dict[str, Any]) -> None:
    """Raises TypeError unless there are limits of inputs, or if those of states seem to be given by another name."""
    of_states, of_inputs = ("box", "state_limits", "output_limits"), ("u_max", "input_limits", "input_ends")
    missing = [names[:2] for names in (of_states, of_inputs) if all(arguments.get(name) is None for name in names)]
    others = [name for name in arguments if name not in PUBLISHED]
    near = [name for name in others if any(get_close_matches(name, names, 1, 0.8) for names in missing)]
    if of_inputs[:2] in missing or (missing and (near or arguments.get("box_ends") is not None)):
        wanted = ", and ".join(" or ".join(names) for names in missing)
        given = f" (it has no argument {', '.join(near)})" if near else ""
        raise TypeError(f"LinearPlant needs limits: give {wanted}{given}")


def _require_operating_input(arguments: dict[str, Any], state: np.ndarray) -> None:
    """Raises ValueError if limits of inputs with two ends are around an operating input that nobody gave or checks.

    It would be zero, which seldom keeps a plant at an operating state other than zero; with `offset` that is checked.
    """
    absolute = [each for each in ("input_limits", "mixed_limits") if arguments.get(each) is not None]
    is_known = any(arguments.get(each) is not None for each in ("operating_input", "offset"))
    if absolute and state.any() and not is_known:
        raise ValueError(f"{absolute[0]} are absolute: beside operating_state give operating_input, too (0 if it is)")


def _input_fields(given: dict[str, Any], center: np.ndarray) -> dict[str, Any]:
    """Returns the ends of inputs in deviations from their operating point, shape (m,); nothing if they are a field."""
    if given["u_max"] is not None:
        if given["input_limits"] is not None:
            raise ValueError("u_max follows from input_limits: give these alone")
        u_max = as_input_limits(given["u_max"], len(center))
        return {"input_ends": np.stack([-u_max, u_max])}
    if given["input_limits"] is None:
        return {}
    is_given = given["operating_input"] is not None
    ends = _from_center(given["input_limits"], center, "input_limits", is_given=is_given)
    if not np.isfinite(ends).all():
        raise ValueError(
            "input_limits must be finite, since actions from -1 to 1 stand for inputs from the low to the high end, "
            f"got {shown(given['input_limits'])}"
        )
    return {"input_ends": np.stack(ends)}


def _row_fields(fields: dict[str, Any], given: dict[str, Any], center: np.ndarray) -> dict[str, Any]:
    """Returns the fields with the rows of all limits of states, in deviations from the operating point, shape (n,)."""
    ends = as_setting(fields.get("box_ends"))
    if ends is not None and ends.ndim == 2 and len(ends) == 2 and (ends == [[-1.0], [1.0]]).all():
        # Symmetric ones need not be told: another box may have another number of rows.
        fields = {name: value for name, value in fields.items() if name != "box_ends"}
    if given["state_limits"] is None and given["output_limits"] is None:
        return fields
    parts = []
    if given["state_limits"] is not None:
        if fields.get("box") is not None:
            raise ValueError("box follows from state_limits: give these alone")
        is_given = given["operating_state"] is not None
        parts.append(_state_rows(given["state_limits"], center, is_given=is_given))
    elif fields.get("box") is not None:
        rows = as_box_rows(fields["box"], len(center))
        parts.append(Rows(rows, *as_row_ends(fields.get("box_ends"), len(rows))))
    if given["output_limits"] is not None:
        parts.append(_output_rows(given["output_limits"], center))
    rows = _joined(parts)
    if not len(rows.rows):
        raise ValueError("state_limits and output_limits are all infinite: give at least one finite limit of a state")
    return fields | {"box": rows.rows, "box_ends": np.stack([rows.low, rows.high])}


def _mixed_fields(fields: dict[str, Any], given: Any, state: np.ndarray, applied: np.ndarray) -> dict[str, Any]:
    """Returns the fields with the rows on (x, u) of mixed_limits beside those that they have."""
    if given is None:
        return fields
    added = _mixed_rows(given, state, applied)
    if fields.get("mixed_rows") is not None:
        rows = as_mixed_rows(fields["mixed_rows"], len(state) + len(applied))
        added = _joined([Rows(rows, *as_row_ends(fields.get("mixed_ends"), len(rows), "mixed_ends")), added])
    return fields | {"mixed_rows": added.rows, "mixed_ends": np.stack([added.low, added.high])}


def _is_between_ends(bound: Any) -> bool:
    """Returns whether a bound of disturbances is a triple (E, low, high)."""
    first = as_setting(bound[0]) if isinstance(bound, (tuple, list)) and len(bound) == 3 else None
    return first is not None and first.ndim == 2


def _in_steps(values: np.ndarray, per_limit: np.ndarray) -> np.ndarray:
    """Returns values, shape (k,), rounded to about `POINT_PRECISION` of limits; `per_limit`, (k,), is 1 over these.

    What LAPACK finds differs between processors in the last bits, and a point is part of what identifies a plant. Steps
    are powers of two, so that rounding itself is exact.
    """
    sizes = np.where(per_limit > 0.0, 1.0 / np.where(per_limit > 0.0, per_limit, 1.0), np.maximum(np.abs(values), 1e-9))
    steps = np.exp2(np.round(np.log2(POINT_PRECISION * sizes)))
    return np.rint(values / steps) * steps


def _around_middle_of_disturbance(
    A: np.ndarray,
    B: np.ndarray,
    bound: Any,
    fields: dict[str, Any],
    point: tuple[np.ndarray, np.ndarray],
    lacking: np.ndarray,
) -> dict[str, Any]:
    """Returns the fields that change where a disturbance d = E w has two different ends, low <= w <= high.

    Deviations are counted from (x, u) then with x = A x + B u + E (low + high) / 2, of such points that nearest to the
    operating point in units of the limits; around it the disturbance is symmetric. What the point lacks of an
    equilibrium by rounding is added to the bound.

    Raises:
        ValueError: If the bound is none, or no such point lies within the limits.
    """
    from scipy.linalg import null_space  # takes long to import

    (n, m), name = B.shape, "disturbance_bound"
    E = as_matrix(bound[0], (n, None), f"{name}: E of d = E w")
    low, high = sides(bound[1:], E.shape[1], f"{name}: (E, low, high)", may_meet=True)
    half, middle = 0.5 * (high - low), 0.5 * (low + high)
    declared = as_bound((E, half), n, name)
    if not middle.any():
        return {name: _with_residual(declared, lacking, as_box_rows(fields["box"], n))}
    rows = as_box_rows(fields["box"], n)
    ends = as_row_ends(fields.get("box_ends"), len(rows))
    inputs = as_input_ends(fields["input_ends"], m)
    reach = 0.5 * (inputs[1] - inputs[0])
    widths = np.sqrt(1.0 / np.diag(weight_of(rows, np.abs(E @ middle))))
    balance = np.hstack([(np.eye(n) - A) * widths, -B * reach]) / widths[:, None]
    found = np.linalg.lstsq(balance, E @ middle / widths)[0]
    directions = null_space(balance)
    sizes = np.vstack([np.hstack([rows * widths, np.zeros((len(rows), m))]), np.hstack([np.zeros((m, n)), np.eye(m)])])
    found = found - directions @ np.linalg.lstsq(sizes @ directions, sizes @ found)[0]
    x, u = widths * found[:n], reach * found[n:]

    def missing_at(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return exact.product(np.hstack([A, B, E, -np.eye(n)]), np.concatenate([x, u, middle, x]))

    terms = np.abs(A) @ np.abs(x) + np.abs(B) @ np.abs(u) + np.abs(E) @ np.abs(middle) + np.abs(x)
    if not (np.abs(missing_at(x, u)) <= EQUILIBRIUM_PRECISION * terms).all():
        raise ValueError(
            f"{name}: no state stays where it is under the middle of this disturbance, {shown((E @ middle).tolist())} "
            "per step, whatever the input: give symmetric ends around zero"
        )
    x, u = _in_steps(x, np.abs(rows).max(axis=0)), _in_steps(u, 1.0 / reach)
    missing = missing_at(x, u)
    ends, inputs = ends - exact.product(rows, x), inputs - u[None]
    mixed = {}
    if fields.get("mixed_rows") is not None:
        coupled = as_mixed_rows(fields["mixed_rows"], n + m)
        mixed = {"mixed_ends": as_row_ends(fields.get("mixed_ends"), len(coupled), "mixed_ends")}
        mixed["mixed_ends"] = mixed["mixed_ends"] - exact.product(coupled, np.concatenate([x, u]))
    if not all(((each[0] < 0.0) & (each[1] > 0.0)).all() for each in (ends, inputs, *mixed.values())):
        raise ValueError(
            f"{name}: the middle of this disturbance moves the operating point to {shown((point[0] + x).tolist())} "
            f"with input {shown((point[1] + u).tolist())}, which is not strictly within the limits"
        )
    state, inputs_there = ([float(f"{each:.6g}") for each in around] for around in (point[0] + x, point[1] + u))
    warn_caller(
        f"deviations are counted from the state {shown(state)} and the input {shown(inputs_there)}, where the middle "
        "of the disturbance rests (plant.operating_state)",
        MovedOperatingPointWarning,
    )
    return {
        name: _with_residual(declared, np.abs(missing) + np.abs(lacking), rows),
        "box": rows,
        "box_ends": ends,
        "input_ends": inputs,
        "operating_state": point[0] + x,
        "operating_input": point[1] + u,
        "step_offset": _sizes(fields.get("step_offset"), n) + exact.product(np.abs(E), np.abs(middle)),
    } | mixed
