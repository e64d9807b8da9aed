"""The limits of a plant: what they are as given, and the rows that they are around the point of a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ncs_gym import exact
from ncs_gym.plants.between_samples import MOST_POINTS
from ncs_gym.plants.hard_bounds import FREE_REACH, reach_in_steps
from ncs_gym.validation import (
    LARGEST_NUMBER,
    SMALLEST_NUMBER,
    ReadOnlyArrays,
    as_count,
    as_given,
    as_numbers,
    as_setting,
    as_vector,
    shown,
    warn_caller,
)

if TYPE_CHECKING:
    from ncs_gym.model import Model

# Ends that differ from symmetric ones by less, relative to the nearer one, are symmetric: that is rounding.
NEARLY_SYMMETRIC = 1e-12


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


def sides(limits: Any, size: int, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the low and the high ends of limits, shape (size,) each; infinite where there is none.

    Args:
        limits: Pair (low, high), each a number or shape (size,), possibly infinite.
        size: Number of limited quantities.
        name: What the error message calls the limits.

    Raises:
        ValueError: If it is no such pair, or a low end is not below the high one.
    """
    ends = [as_setting(side) for side in limits] if isinstance(limits, (tuple, list, np.ndarray)) else []
    if len(ends) != 2 or any(side is None or side.shape not in ((), (size,)) or np.isnan(side).any() for side in ends):
        raise ValueError(f"{name} must be a pair (low, high), each a number or shape ({size},), got {shown(limits)}")
    low, high = (np.broadcast_to(np.asarray(side), (size,)).copy() for side in ends)
    if not (low < high).all():
        raise ValueError(
            f"{name} must be (low, high), each a number or a vector, with low < high everywhere: give all low "
            f"ends, then all high ones, got {shown(limits)}"
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
        at_end, remedy = np.flatnonzero((low == center) | (center == high)), ""
        if not is_given:
            remedy = ": limits are absolute, so give at=(state, input) of the Model, around which they are"
        elif len(at_end):
            remedy = (
                f": entry {at_end[0] + 1} rests at its end, from where nothing can move it both ways; give an "
                "equilibrium whose states and inputs are inside their limits"
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
    if not ((size > SMALLEST_NUMBER) & (size < LARGEST_NUMBER)).all():
        raise ValueError(f"{name} must be finite numbers of usual size, or infinite, got {shown(limits)}")
    return low, high


class ChosenLimitsWarning(UserWarning):
    """No state has a limit: half-widths of the safe box were chosen, far beyond what inputs reach in a few steps."""


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
    return Rows((1.0 / half)[:, None] * rows, low / half, high / half)


def joined(parts: Sequence[Rows]) -> Rows:
    """Returns all rows of several."""
    return Rows(*(np.concatenate(each) for each in zip(*parts, strict=True)))


class Within(NamedTuple):
    """Limits in deviations from the point of a model: rows of states, ends of inputs (2, m), rows of both together."""

    box: Rows
    inputs: np.ndarray
    mixed: Rows


@dataclass(frozen=True, eq=False)
class Limits(ReadOnlyArrays):
    """Limits of a model's own states and inputs, in its units; absolute, or half-widths where it is about zero.

    Attributes:
        state: Half-widths, a number or shape (n,), or a pair (low, high) of numbers or vectors, which of two states are
            vectors; infinite where there is no limit. None: no state has one of its own.
        input: Alike, all finite.
        rows: Limits of several entries, a list of (c_x, c_u, low, high) with low <= c_x x + c_u u <= high for the x at
            the beginning of a step and the u that is held then; c_u is None in a limit of states alone.
        rate: Largest change of each input from one step to the next, a positive number or shape (m,).
        between_samples: Number of times per step, 2 to 64, at which limits of states count; None for the end alone.
    """

    state: Any = None
    input: Any = None
    rows: Sequence[tuple[Any, Any, float, float]] = ()
    rate: Any = None
    between_samples: int | None = None

    def __post_init__(self) -> None:
        if self.input is None:
            raise ValueError("Limits need input=: actions from -1 to 1 stand for inputs from the low to the high end")
        if not isinstance(self.rows, list | tuple) or not all(
            isinstance(each, list | tuple) and len(each) == 4 for each in self.rows
        ):
            raise ValueError(f"rows of limits must be a list of (c_x, c_u, low, high), got {shown(self.rows)}")
        for name in ("state", "input", "rows", "rate"):
            object.__setattr__(self, name, as_given(getattr(self, name)))
        if self.between_samples is not None:
            points = as_count(self.between_samples, "between_samples", low=1, high=MOST_POINTS)
            object.__setattr__(self, "between_samples", points if points > 1 else None)

    def within(self, model: Model) -> Within:
        """Returns the limits in deviations from the point of a model.

        Raises:
            ValueError: If they are no limits of its states and inputs, or its point is not strictly within them.
        """
        if any(model.is_given):
            for name in ("state", "input"):
                if self._half_widths(name, model) is not None:
                    raise ValueError(
                        f"{name} limits are absolute beside at= of a Model: give a pair (low, high) in place of "
                        f"half-widths, got {shown(getattr(self, name))}"
                    )
        inputs = np.stack(self._ends("input", model))
        if not np.isfinite(inputs).all():
            raise ValueError(
                "input limits must be finite, since actions from -1 to 1 stand for inputs from the low to the high "
                f"end, got {shown(self.input)}"
            )
        point, n = np.concatenate([model.state, model.input]), len(model.A)
        of_states, mixed = [self._state_rows(model)], [Rows(np.empty((0, len(point))), np.empty(0), np.empty(0))]
        for of_state, of_input, low, high in self.rows:
            c = np.zeros(len(point))
            c[:n] = as_point(of_state, n, "c_x of a row of limits")
            if of_input is not None:
                c[n:] = as_point(of_input, len(point) - n, "c_u of a row of limits")
            if np.abs(c).max() < SMALLEST_NUMBER or (of_input is not None and np.abs(c[n:]).max() < SMALLEST_NUMBER):
                raise ValueError(f"every row of limits must limit something, with c_u None or not 0, got {shown(c)}")
            ends = _from_center((low, high), exact.product(c[None], point), "the ends of a row of limits")
            (of_states if of_input is None else mixed).append(
                in_units_of_range(c[None, :n] if of_input is None else c[None], *ends)
            )
        if self.state is None and len(of_states) == 1 and not len(of_states[0].rows):
            of_states.append(_chosen(model, inputs))
        box = joined(of_states)
        if not len(box.rows):
            raise ValueError("limits of states are all infinite: give at least one finite one")
        return Within(box, inputs, joined(mixed))

    def absolute(self, model: Model) -> Limits:
        """Returns the same limits of a model about zero as pairs, which stay where they are beside any point."""
        widths = {name: self._half_widths(name, model) for name in ("state", "input")}
        return replace(self, **{name: (-each, each) for name, each in widths.items() if each is not None})

    def change_within(self, half: np.ndarray) -> np.ndarray | None:
        """Returns the largest change of each input, shape (m,), given half their range; None if any is allowed.

        Raises:
            ValueError: If `rate` is no such change, or limits nothing.
        """
        if self.rate is None:
            return None
        change = as_setting(self.rate)
        if (
            change is None
            or change.shape not in ((), half.shape)
            or not ((change >= SMALLEST_NUMBER) & (change < LARGEST_NUMBER)).all()
        ):
            raise ValueError(f"rate must be a positive number or shape {half.shape}, got {shown(self.rate)}")
        if (change >= 2.0 * half).all():
            raise ValueError(f"rate = {shown(self.rate)} limits nothing: inputs change by no more than their range")
        return np.broadcast_to(change, half.shape).copy()

    def _half_widths(self, name: str, model: Model) -> np.ndarray | None:
        """Returns limits that are given as half-widths, shape (n,) or (m,); None for pairs and where there are none."""
        widths, size = as_setting(getattr(self, name)), len(getattr(model, name))
        if widths is None or widths.shape not in ((), (size,)):
            return None
        fits = (widths > SMALLEST_NUMBER) & (widths < LARGEST_NUMBER) | (widths == np.inf)
        if not fits.all() or not np.isfinite(widths).any():
            raise ValueError(
                f"{name} limits must be positive half-widths of shape ({size},), not all infinite, or a pair (low, "
                f"high) of vectors, got {shown(getattr(self, name))}"
            )
        return np.broadcast_to(widths, (size,))

    def _ends(self, name: str, model: Model) -> tuple[np.ndarray, np.ndarray]:
        if (widths := self._half_widths(name, model)) is not None:
            return -widths, widths
        is_given = model.is_given[name == "input"]
        return _from_center(getattr(self, name), getattr(model, name), f"{name} limits", is_given=is_given)

    def _state_rows(self, model: Model) -> Rows:
        n = len(model.A)
        ends = np.full((2, n), [[-np.inf], [np.inf]]) if self.state is None else self._ends("state", model)
        return in_units_of_range(np.eye(n), *ends)


def _chosen(model: Model, inputs: np.ndarray) -> Rows:
    """Returns half-widths for states without limits: many times what inputs within ends (2, m) reach in n steps.

    Raises:
        ValueError: If no input moves a state, so that nothing says how large it gets.
    """
    reach = reach_in_steps(model.A, model.B, np.abs(inputs).max(axis=0), np.zeros(len(model.A)))
    if not reach.all():
        raise ValueError(f"Limits need state=: no input moves state {reach.argmin() + 1}, which none of them limits")
    widths = np.array([float(exact.rounded(FREE_REACH * each, 1)) for each in reach])
    text = f"no state has a limit: half-widths {shown(widths.tolist())} were chosen, give Limits(state=...) for others"
    warn_caller(text, ChosenLimitsWarning)
    return in_units_of_range(np.eye(len(widths)), -widths, widths)
