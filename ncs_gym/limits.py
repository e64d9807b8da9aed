"""The limits of a plant: what they are as given, and the rows that they are around the point of a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ncs_gym import exact
from ncs_gym.model import Model, as_point
from ncs_gym.validation import (
    LARGEST_NUMBER,
    SMALLEST_NUMBER,
    ReadOnlyArrays,
    as_count,
    as_given,
    as_setting,
    shown,
    warn_caller,
)

# Ends that differ from symmetric ones by less, relative to the nearer one, are symmetric: that is rounding.
NEARLY_SYMMETRIC = 1e-12
# A state that the box says nothing of is as large as this many times what it reaches from rest in n steps.
FREE_REACH = 100.0
# Times of a step at which limits of states may count.
MOST_POINTS = 64


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

    @classmethod
    def of(cls, rows: np.ndarray, low: np.ndarray, high: np.ndarray) -> Rows:
        """Returns those of rows, (k, n), with ends in their own units that have any finite end."""
        limited = np.isfinite(low) | np.isfinite(high)
        rows, low, high = rows[limited], low[limited], high[limited]
        half = np.where(np.isfinite(low) & np.isfinite(high), 0.5 * (high - low), np.minimum(-low, high))
        return cls((1.0 / half)[:, None] * rows, low / half, high / half)

    def around(self, point: np.ndarray) -> Rows:
        """Returns the same limits in deviations from a point, shape (n,) or (n + m,)."""
        at_point = exact.product(self.rows, point)
        return Rows(self.rows, self.low - at_point, self.high - at_point)

    @classmethod
    def joined(cls, parts: Sequence[Rows], size: int) -> Rows:
        """Returns all rows of several, each with this many entries."""
        none = Rows(np.empty((0, size)), np.empty(0), np.empty(0))
        return cls(*(np.concatenate(each) for each in zip(none, *parts, strict=True)))


class Deviations(NamedTuple):
    """The equations and the limits of a plant, counted from a point.

    Attributes:
        A, B, H: Of the states, of which past inputs are the last ones.
        box: Rows of states.
        inputs: The low and the high ends of the inputs, shape (2, m).
        mixed: Rows of states and inputs together.
        state, input: The point, shapes (n,) and (m,).
        step_offset: Sizes of the constant that it rests under, shape (n,).
        lacking: What it lacks of an equilibrium by rounding, in size, of the own states.
        past: Number of past inputs, the newest ones last.
    """

    A: np.ndarray
    B: np.ndarray
    H: np.ndarray
    box: Rows
    inputs: np.ndarray
    mixed: Rows
    state: np.ndarray
    input: np.ndarray
    step_offset: np.ndarray
    lacking: np.ndarray
    past: int = 0

    def around(self, x: np.ndarray, u: np.ndarray) -> Deviations:
        """Returns the same plant counted from another point, which is (x, u) from here: its ends move."""
        box, mixed = self.box.around(x), self.mixed.around(np.concatenate([x, u]))
        return self._replace(box=box, inputs=self.inputs - u, mixed=mixed, state=self.state + x, input=self.input + u)

    @property
    def is_within(self) -> bool:
        """Whether the point is strictly within the limits."""
        return all(((low < 0.0) & (high > 0.0)).all() for low, high in (self.box[1:], self.inputs, self.mixed[1:]))


def reach_in_steps(A: np.ndarray, B: np.ndarray, largest_input: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Returns a bound on every |x_j|, shape (n,), n steps after |x| <= reach, (n,), with |u| <= largest_input, (m,)."""
    for _ in range(len(A)):
        reach = exact.product(np.abs(np.hstack([A, B])), np.concatenate([reach, largest_input]))
    return reach


def sides(limits: Any, size: int, name: str) -> np.ndarray:
    """Returns the low and the high ends of limits, shape (2, size); infinite where there is none.

    Args:
        limits: Pair (low, high), each a number or shape (size,), possibly infinite.
        size: Number of limited quantities.
        name: What the error message calls the limits.

    Raises:
        ValueError: If it is no such pair, or a low end is not below the high one.
    """
    ends: list[Any] = [as_setting(side) for side in limits] if isinstance(limits, (tuple, list, np.ndarray)) else []
    if len(ends) != 2 or any(side is None or side.shape not in ((), (size,)) or np.isnan(side).any() for side in ends):
        raise ValueError(f"{name} must be a pair (low, high), each a number or shape ({size},), got {shown(limits)}")
    low, high = both = np.array([np.broadcast_to(side, (size,)) for side in ends])
    if not (low < high).all():
        raise ValueError(
            f"{name} must be (low, high), each a number or a vector, with low < high everywhere: give all low "
            f"ends, then all high ones, got {shown(limits)}"
        )
    return both


def _from_center(limits: Any, center: np.ndarray, name: str, *, is_given: bool = True) -> np.ndarray:
    """Returns the ends of limits as distances from a point between them, shape (2, size); infinite where free.

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
    ends = np.array([low - center, high - center])
    finite = np.isfinite(ends)
    sizes = np.where(finite, np.abs(ends), 1.0)
    if not ((sizes > SMALLEST_NUMBER) & (sizes < LARGEST_NUMBER)).all():
        raise ValueError(f"{name} must be finite numbers of usual size, or infinite, got {shown(limits)}")
    nearest = sizes.min(axis=0)
    nearly = finite.all(axis=0) & (np.abs(sizes[1] - sizes[0]) <= NEARLY_SYMMETRIC * nearest)
    return np.where(nearly, [-nearest, nearest], ends)


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
        points = self.between_samples
        if points is not None:
            points = as_count(points, "between_samples", low=1, high=MOST_POINTS)
        self._set(**{name: as_given(getattr(self, name)) for name in ("state", "input", "rows", "rate")})
        self._set(between_samples=None if points == 1 else points)

    def around(self, model: Model) -> Deviations:
        """Returns a model with these limits, counted from its point.

        Raises:
            ValueError: If they are no limits of its states and inputs, or its point is not strictly within them.
        """
        point, n = np.concatenate([model.state, model.input]), len(model.A)
        of_states, mixed = [], []
        if self.state is not None:
            of_states.append(Rows.of(np.eye(n), *self._ends("state", model)))
        inputs = self._ends("input", model)
        if not np.isfinite(inputs).all():
            raise ValueError(
                "input limits must be finite, since actions from -1 to 1 stand for inputs from the low to the high "
                f"end, got {shown(self.input)}"
            )
        for of_state, of_input, low, high in self.rows:
            c = np.zeros(len(point))
            c[:n] = as_point(of_state, n, "c_x of a row of limits")
            if of_input is not None:
                c[n:] = as_point(of_input, len(point) - n, "c_u of a row of limits")
            if np.abs(c).max() < SMALLEST_NUMBER or (of_input is not None and np.abs(c[n:]).max() < SMALLEST_NUMBER):
                raise ValueError(f"every row of limits must limit something, with c_u None or not 0, got {shown(c)}")
            ends = _from_center((low, high), exact.product(c[None], point), "the ends of a row of limits")
            if of_input is None:
                of_states.append(Rows.of(c[None, :n], *ends))
            else:
                mixed.append(Rows.of(c[None], *ends))
        box = Rows.joined(of_states or [_chosen(model, inputs)], n)
        if not len(box.rows):
            raise ValueError("limits of states are all infinite: give at least one finite one")
        equations = model.A, model.B, model.H, box, inputs, Rows.joined(mixed, len(point))
        return Deviations(*equations, model.state, model.input, model.step_offset, np.abs(model.lacking))

    def absolute(self, model: Model) -> Limits:
        """Returns the same limits of a model about zero as pairs, which stay where they are beside any point."""
        state = None if self.state is None else self._pair("state", model)
        return replace(self, state=state, input=self._pair("input", model))

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

    def _pair(self, name: str, model: Model) -> Any:
        """Returns limits of states or inputs as a pair (low, high), also where half-widths are given."""
        given, size = getattr(self, name), len(getattr(model, name))
        widths = as_setting(given)
        if widths is None or widths.shape not in ((), (size,)):
            return given
        if any(model.is_given):
            raise ValueError(
                f"{name} limits are absolute beside at= of a Model: give a pair (low, high) of vectors in place of "
                f"half-widths, got {shown(given)}"
            )
        fits = (widths > SMALLEST_NUMBER) & (widths < LARGEST_NUMBER) | (widths == np.inf)
        if not fits.all() or not np.isfinite(widths).any():
            raise ValueError(
                f"{name} limits must be positive half-widths of shape ({size},), not all infinite, or a pair (low, "
                f"high) of vectors, got {shown(given)}"
            )
        return -widths, widths

    def _ends(self, name: str, model: Model) -> np.ndarray:
        is_given = model.is_given[name == "input"]
        return _from_center(self._pair(name, model), getattr(model, name), f"{name} limits", is_given=is_given)


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
    return Rows.of(np.eye(len(widths)), -widths, widths)
