"""The arguments of `LinearPlant` by their old names, translated into a model, limits and bounds; to be deleted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

import numpy as np

from ncs_gym.bounds import Box
from ncs_gym.limits import Limits, Rows, Within, as_point, as_row_ends, joined, sides
from ncs_gym.model import Model
from ncs_gym.plants.resting_point import at_rest
from ncs_gym.uncertainty.declared_bound import declared_set
from ncs_gym.validation import LARGEST_NUMBER, SMALLEST_NUMBER, as_matrix, as_setting, shown

# Arguments of the constructor of `LinearPlant` that become fields of other names.
PUBLISHED = "state_limits", "input_limits", "output_limits", "mixed_limits", "u_max", "offset"


def fields_of(arguments: dict[str, Any]) -> dict[str, Any]:
    """Returns the fields of `LinearPlant` for the arguments of its constructor: limits become rows with two ends.

    Raises:
        TypeError: If no limits are given.
        ValueError: If one is wrong or given twice, or the operating point is no equilibrium of a model with `offset`.
    """
    given = {name: value for name, value in arguments.items() if not _is_no_limit(name, value)}
    _require_limits(given)
    matrices, point = ("A", "B", "H", "dt"), tuple(given.get(f"operating_{name}") for name in ("state", "input"))
    if missing := [name for name in ("A", "B", "dt") if name not in given]:
        raise TypeError(f"LinearPlant needs {', '.join(missing)}")
    described: Any = {name: given.get(name) for name in (*matrices, "offset")}
    model = Model(**described, at=point, continuous=given.get("continuous_model"))
    _require_operating_input(given, model.state)
    n, bound, step = len(model.A), given.get("disturbance_bound"), given.get("step_offset")
    step_offset = model.step_offset if step is None else as_operating_point(step, n, "step_offset")
    rest = at_rest(model, _within(given, model), None if bound is None else _disturbance(bound, n), step_offset)
    names = (*PUBLISHED, *matrices, "continuous_model", *rest)
    return {name: value for name, value in given.items() if name not in names} | fields_of_model(model) | rest


def fields_of_model(model: Model) -> dict[str, Any]:
    """Returns the fields of `LinearPlant` that a model is kept in, apart from its point."""
    return {name: getattr(model, name) for name in ("A", "B", "H", "dt")} | {"continuous_model": model.continuous}


def _disturbance(bound: Any, n: int) -> Any:
    """Returns the set of a bound of disturbances, which may be a triple (E, low, high), too."""
    first = as_setting(bound[0]) if isinstance(bound, tuple | list) and len(bound) == 3 else None
    if first is None or first.ndim != 2:
        return declared_set(bound, n, "disturbance_bound")
    E = as_matrix(bound[0], (n, None), "disturbance_bound: E of d = E w")
    ends = sides(bound[1:], E.shape[1], "disturbance_bound: (E, low, high)", may_meet=True)
    return declared_set((E, Box(*ends)), n, "disturbance_bound")


def _within(given: dict[str, Any], model: Model) -> Within:
    """Returns the limits in deviations from the point of a model."""
    n, m = model.B.shape
    for name, other in (("box", "state_limits"), ("u_max", "input_limits")):
        if given.get(name) is not None and given.get(other) is not None:
            raise ValueError(f"{name} follows from {other}: give these alone")
    state, inputs, u_max = (given.get(name) for name in ("state_limits", "input_limits", "u_max"))
    state = None if state is None else sides(state, n, "state_limits")
    inputs = None if inputs is None else sides(inputs, m, "input_limits")
    inputs = inputs if u_max is None else as_input_limits(u_max, m)
    rows = [(row, None, *ends) for row, *ends in _listed(given, "output_limits", 3)]
    rows += _listed(given, "mixed_limits", 4)
    within = _OldLimits(state, 1.0 if inputs is None else inputs, rows, old=given).within(model, are_absolute=False)
    if given.get("mixed_rows") is None:
        return within
    coupled = as_mixed_rows(given["mixed_rows"], n + m)
    ends = as_row_ends(given.get("mixed_ends"), len(coupled), "mixed_ends")
    return within._replace(mixed=joined([Rows(coupled, *ends), within.mixed]))


def _listed(given: dict[str, Any], name: str, size: int) -> Sequence[Any]:
    listed = given.get(name)
    if listed is None:
        return ()
    if not isinstance(listed, list | tuple) or not all(isinstance(x, list | tuple) and len(x) == size for x in listed):
        raise ValueError(
            f"{name} must be a list of entries of {size}, rows and their low and high ends, got {shown(listed)}"
        )
    return listed


@dataclass(frozen=True, eq=False)
class _OldLimits(Limits):
    """Limits of which some are given as rows in units and ends in deviations."""

    old: dict[str, Any] = field(kw_only=True)

    def _state_rows(self, model: Model) -> Rows:
        if self.old.get("box") is None:
            return super()._state_rows(model)
        rows = as_box_rows(self.old["box"], len(model.A))
        ends = as_setting(self.old.get("box_ends"))
        # Symmetric ones need not be told: another box may have another number of rows.
        told = ends is None or ends.ndim != 2 or len(ends) != 2 or (ends != [[-1.0], [1.0]]).any()
        return Rows(rows, *as_row_ends(self.old.get("box_ends") if told else None, len(rows)))

    def _ends(self, name: str, model: Model) -> Any:
        if name == "state" or self.old.get("u_max") is not None or self.old.get("input_limits") is not None:
            return super()._ends(name, model)
        return as_input_ends(self.old.get("input_ends"), len(model.input))


def require_given_once(arguments: dict[str, Any]) -> None:
    """Raises ValueError if a field is given beside a published argument that it follows from."""
    follows = {"box_ends": ("state_limits",), "input_ends": ("u_max", "input_limits"), "step_offset": ("offset",)}
    for ends, others in follows.items():
        if arguments.get(ends) is not None:
            for other in others:
                if arguments.get(other) is not None:
                    raise ValueError(f"give {ends} or {other}, not both")


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
