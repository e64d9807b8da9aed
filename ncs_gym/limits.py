"""The limits of a plant: what they are as given, and the rows that they are around a point."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import pushes_of
from ncs_gym.model import Model, as_point, residual
from ncs_gym.validation import (
    LARGEST_NUMBER,
    SMALLEST_NUMBER,
    ReadOnlyArrays,
    as_count,
    as_given,
    as_setting,
    read_only,
    shown,
    warn_caller,
)

# Ends that differ from symmetric ones by less, relative to the nearer one, are symmetric: that is rounding.
NEARLY_SYMMETRIC = 1e-12
# A state that the box says nothing of is as large as this many times what it reaches from rest in n steps.
FREE_REACH = 100.0
# Times of a step at which limits of states may count.
MOST_POINTS = 64
# Rows of the box keep inputs under way within this many times their limits, which they never leave: the rows only bound
# the safe set. Closer ones would forbid inputs near their limit, farther ones enlarge the set by little.
STORED_INPUT_REACH = 4.0
# Decimals of a resting point in units of the limits: what LAPACK finds differs between processors beyond them, and a
# point is part of what identifies a plant.
POINT_DECIMALS = 11


class ChosenLimitsWarning(UserWarning):
    """No state has a limit: half-widths of the safe box were chosen, far beyond what inputs reach in a few steps."""


class MovedOperatingPointWarning(UserWarning):
    """A disturbance with two different ends moves the point that deviations are counted from."""


class Rows(NamedTuple):
    """Limits low <= c_j x <= high, or low <= c_j (x, u) <= high: c, shape (k, n) or (k, n + m), and ends, (2, k).

    They are in units of half the range, or of the other end where one is infinite.
    """

    rows: np.ndarray
    ends: np.ndarray

    @classmethod
    def of(cls, rows: np.ndarray, ends: np.ndarray) -> Rows:
        """Returns those, given in any units, that have a finite end."""
        limited = np.isfinite(ends).any(axis=0)
        rows, (low, high) = rows[limited], ends[:, limited]
        half = np.where(np.isfinite(low) & np.isfinite(high), 0.5 * (high - low), np.minimum(-low, high))
        return cls((1.0 / half)[:, None] * rows, np.array([low, high]) / half)

    @classmethod
    def joined(cls, parts: Sequence[Rows], size: int) -> Rows:
        """Returns all rows of several, each with this many entries."""
        rows, ends = zip((np.empty((0, size)), np.empty((2, 0))), *parts, strict=True)
        return cls(np.concatenate(rows), np.concatenate(ends, axis=1))


class LimitValues(ReadOnlyArrays):
    """The equations and the limits of a plant, counted from a point; past inputs are the last states.

    Attributes:
        A: State matrix, shape (n, n), past inputs included.
        B: Input matrix, shape (n, m).
        H: Output matrix, shape (p, n).
        past: How many of the last states are past inputs, the newest ones last.
        box: Rows c_j of the safe box, shape (k, n), in units of half the range, or of the other end where one is open.
        box_ends: Low and high ends of c_j x, shape (2, k); -1 and 1 where symmetric, infinite where there is none.
        is_past_row: Which rows limit past inputs, which nothing ever takes there, shape (k,).
        mixed_rows, mixed_ends: Alike, of (x, u) at the beginning of a step, shapes (q, n + m) and (2, q).
        input_ends: Low and high ends of the inputs, shape (2, m).
        operating_state, operating_input: What deviations are counted from, shapes (n,) and (m,).
        step_offset: Sizes of what the operating point rests under in every step beside A and B, shape (n,): |offset|,
            and |E| |middle| of a disturbance with two ends.
        lacking: What the point lacks of an equilibrium by rounding, in size, of the model's own states.
    """

    A: np.ndarray
    B: np.ndarray
    H: np.ndarray
    past: int
    box: np.ndarray
    box_ends: np.ndarray
    is_past_row: np.ndarray
    mixed_rows: np.ndarray
    mixed_ends: np.ndarray
    input_ends: np.ndarray
    operating_state: np.ndarray
    operating_input: np.ndarray
    step_offset: np.ndarray
    lacking: np.ndarray

    def _replaced(self, **changes: Any) -> LimitValues:
        made = LimitValues()
        made._set(**{name: getattr(self, name) for name in LimitValues.__annotations__} | changes)
        return made

    def at_rest(self, disturbance: Any) -> LimitValues:
        """Returns the same counted from where it rests under E w, the middle of a disturbance: x = A x + B u + E w.

        That is the point of its model if E w = 0, else the nearest such point in units of the limits.

        Raises:
            ValueError: If no such point lies within the limits.
        """
        if not (pushes := pushes_of(disturbance)):
            return self
        E, middle = np.hstack([each for each, _ in pushes]), np.concatenate([each for _, each in pushes])
        x, u, missing = self._resting(E, middle)
        rest = self._replaced(
            box_ends=self.box_ends - exact.product(self.box, x),
            mixed_ends=self.mixed_ends - exact.product(self.mixed_rows, np.concatenate([x, u])),
            input_ends=self.input_ends - u,
            operating_state=self.operating_state + x,
            operating_input=self.operating_input + u,
            step_offset=self.step_offset + exact.product(np.abs(E), np.abs(middle)),
            lacking=np.abs(missing) + self.lacking,
        )
        points = rest.operating_state, rest.operating_input
        place = ", ".join(shown([float(f"{each:.6g}") for each in point]) for point in points)
        low, high = np.concatenate([rest.box_ends, rest.input_ends, rest.mixed_ends], axis=1)
        if not ((low < 0.0) & (high > 0.0)).all():
            raise ValueError(f"a disturbance rests at {place}, not strictly within the limits")
        text = f"deviations are counted from where the middle of the disturbance rests: {place}"
        warn_caller(text, MovedOperatingPointWarning)
        return rest

    def _resting(self, E: np.ndarray, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns x, u, in deviations from the model's point, and A x + B u + E w - x there, which is rounding."""
        from scipy.linalg import null_space  # takes long to import

        (n, m), A, B, rows = self.B.shape, self.A, self.B, self.box
        reach = 0.5 * np.ptp(self.input_ends, axis=0)
        pushed = reach_in_steps(A, B, self.largest_input, np.abs(E @ middle))
        widths = np.sqrt(1.0 / np.diag(weight_of(rows, pushed)))
        balance = np.hstack([(np.eye(n) - A) * widths, -B * reach]) / widths[:, None]
        found = np.linalg.lstsq(balance, E @ middle / widths)[0]
        directions = null_space(balance)
        sizes = np.vstack([np.hstack([rows * widths, np.zeros((len(rows), m))]), np.eye(m, n + m, n)])
        found = found - directions @ np.linalg.lstsq(sizes @ directions, sizes @ found)[0]
        if not residual(A, B, E, widths * found[:n], reach * found[n:], middle)[1]:
            each = shown((E @ middle).tolist())
            raise ValueError(f"no state stays where it is under the middle of a disturbance, {each} per step")
        found = np.round(found, POINT_DECIMALS)
        x, u = widths * found[:n], reach * found[n:]
        return x, u, residual(A, B, E, x, u, middle)[0]

    def with_past_inputs(self, delays: np.ndarray, change: np.ndarray | None) -> LimitValues:
        """Returns the plant of the states x, u_{k-d}, .., u_{k-1}, with as many past inputs as it has to remember.

        Args:
            delays: As of its model, shape (n, m); d is the largest.
            change: Largest change of each input from one step to the next, shape (m,); None for any.

        Raises:
            ValueError: If a limit of states and inputs together does not say which past input it means.
        """
        (n, m), half, d = self.B.shape, self.input_half, int(delays.max())
        stored = m * (d or int(change is not None))
        if not stored:
            return self
        A, B = np.zeros((n + stored, n + stored)), np.zeros((n + stored, m))
        A[:n, :n], A[n:-m, n + m :], B[-m:] = self.A, np.eye(stored - m), np.eye(m)
        B[:n] = np.where(delays == 0, self.B, 0.0)
        for steps in range(1, d + 1):
            A[:n, n + stored - m * steps :][:, :m] = np.where(delays == steps, self.B, 0.0)
        past = np.hstack([np.zeros((stored, n)), np.diag(np.tile(1.0 / (STORED_INPUT_REACH * half), stored // m))])
        box = [Rows(np.pad(self.box, ((0, 0), (0, stored))), self.box_ends)]
        box += [Rows(past, np.tile(self.input_ends / half, stored // m))]
        # An input that takes effect later is in the limits of states and inputs when it does, and a state by then.
        of_state, of_input = self.mixed_rows[:, :n], self.mixed_rows[:, n:]
        others = np.zeros((len(of_state), stored + m))
        if len(others):
            others[:, acting(delays, stored)] = of_input
        is_now, coupled = others[:, stored:].any(axis=1), np.hstack([of_state, others])
        box.append(Rows(coupled[~is_now, : n + stored], self.mixed_ends[:, ~is_now]))
        mixed = [Rows(coupled[is_now], self.mixed_ends[:, is_now])]
        if change is not None:
            rates = np.hstack([np.zeros((m, n + stored - m)), -np.eye(m), np.eye(m)]) / change[:, None]
            mixed.append(Rows(rates, np.outer([-1.0, 1.0], np.ones(m))))
        limited, together = Rows.joined(box, n + stored), Rows.joined(mixed, n + stored + m)
        number = np.arange(len(limited.rows)) - len(self.box)
        return self._replaced(
            A=A,
            B=B,
            H=np.pad(self.H, ((0, 0), (0, stored))),
            box=limited.rows,
            box_ends=limited.ends,
            is_past_row=(number >= 0) & (number < stored),
            mixed_rows=together.rows,
            mixed_ends=together.ends,
            operating_state=np.concatenate([self.operating_state, np.tile(self.operating_input, stored // m)]),
            step_offset=np.pad(self.step_offset, (0, stored)),
            past=stored,
        )

    @cached_property
    def spectral_radius(self) -> float:
        """Largest absolute eigenvalue of A; below 1 exactly when the plant is Schur stable."""
        return float(np.abs(np.linalg.eigvals(self.A)).max())

    @cached_property
    def input_middle(self) -> np.ndarray:
        """The input that action 0 stands for, shape (m,): the middle of the limits."""
        return read_only(0.5 * self.input_ends.sum(axis=0))

    @cached_property
    def input_half(self) -> np.ndarray:
        """Half the range of each input, shape (m,): input_middle +- this is within the limits, as floats add."""
        (low, high), middle = self.input_ends, self.input_middle
        half = 0.5 * (high - low)
        while (beyond := (middle + half > high) | (middle - half < low)).any():
            half = np.where(beyond, np.nextafter(half, 0.0), half)
        return read_only(half)

    @cached_property
    def largest_input(self) -> np.ndarray:
        """The largest |u_i| within the limits, shape (m,)."""
        return read_only(np.abs(self.input_ends).max(axis=0))

    @cached_property
    def own_limits(self) -> np.ndarray:
        """The closest low and high ends of each state alone, shape (2, n); infinite where one is open."""
        low, high = np.full((2, len(self.A)), [[-np.inf], [np.inf]])
        for row, ends in zip(self.box, self.box_ends.T, strict=True):
            if np.count_nonzero(row) == 1:
                j = int(np.flatnonzero(row)[0])
                least, most = sorted(ends / row[j])
                low[j], high[j] = max(low[j], least), min(high[j], most)
        return read_only(np.array([low, high]))

    @cached_property
    def reach(self) -> np.ndarray:
        """The largest |x_j| in the safe box and |u_i| within the limits, shape (n + m,); infinite for a free state."""
        n, m = self.B.shape
        two_ends = np.isfinite(self.box_ends).all(axis=0)
        limited, reach = self.box[two_ends].any(axis=0), np.full(n, np.inf)
        with suppress(ZeroDivisionError):  # rows C with two ends, x = (C'C)^-1 C' (C x), that limit a sum alone
            sizes = np.abs(self.box_ends[:, two_ends]).max(axis=0)
            reach[limited] = (np.abs(exact.pseudoinverse(self.box[two_ends][:, limited])) * sizes).sum(axis=1)
        reach = np.minimum(reach, np.abs(self.own_limits).max(axis=0))
        reach[n - self.past :] = np.tile(self.largest_input, self.past // m)
        return read_only(np.concatenate([reach, self.largest_input]))

    def constraint_values(self, state: np.ndarray) -> np.ndarray:
        """Returns how far c_j x is beyond the nearer end, in units of half the range, shape (k,) or (k, N).

        Positive is violated. With symmetric limits that is |c_j x| - 1.
        """
        return _beyond(self.box.dot(state), self.box_ends)

    def mixed_values(self, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns the same of `mixed_rows`, shape (q,) or (q, N)."""
        rows, n = self.mixed_rows, len(self.A)
        return _beyond(rows[:, :n].dot(state) + rows[:, n:].dot(u), self.mixed_ends)

    def values_at_start(self, state: np.ndarray) -> np.ndarray:
        """Returns `worst_constraint_values` before a step: those of a state at which the operating input acts."""
        rest = np.zeros((self.B.shape[1], *state.shape[1:]))
        return np.concatenate([self.constraint_values(state), self.mixed_values(state, rest)])


def reach_in_steps(A: np.ndarray, B: np.ndarray, largest_input: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Returns a bound on every |x_j|, shape (n,), n steps after |x| <= reach, with |u| <= largest_input."""
    for _ in range(len(A)):
        reach = exact.product(np.abs(np.hstack([A, B])), np.concatenate([reach, largest_input]))
    return reach


def weight_of(rows: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Returns positive definite W, shape (n, n): C'C of rows c_j, (k, n), regularized by the reach of states in no row.

    That is `LinearPlant.reach_from_rest`, shape (n,), in which 0 stands for 1.
    """
    gram = exact.product(rows.T, rows)
    squares, sizes = np.diag(gram), FREE_REACH * np.where(reach > 0.0, reach, 1.0)
    return gram + np.diag(np.where(squares > 0.0, 1e-6 * squares, 1.0 / np.square(sizes)))


def acting(delays: np.ndarray, past: int) -> np.ndarray:
    """Returns which of past and then present inputs act now, shape (m,), by delays of shape (n, m).

    Raises:
        ValueError: If an input acts on several states with several delays.
    """
    if np.ptp(delays, axis=0).any():
        raise ValueError("another process, or a limit of states and inputs together, needs one delay per input")
    return past - delays.shape[1] * delays[0] + np.arange(delays.shape[1])


def _beyond(values: np.ndarray, ends: np.ndarray) -> np.ndarray:
    low, high = ends if values.ndim == 1 else ends[:, :, None]
    return np.maximum(values - high, low - values)


def sides(limits: Any, size: int, name: str) -> np.ndarray:
    """Returns the low and the high ends of a pair of numbers or vectors, shape (2, size), some of them infinite.

    Raises:
        ValueError: If it is no such pair, or a low end is not below the high one.
    """
    ends: list[Any] = [as_setting(side) for side in limits] if isinstance(limits, (tuple, list, np.ndarray)) else []
    fits = len(ends) == 2 and all(side is not None and side.shape in ((), (size,)) for side in ends)
    both = np.array([np.broadcast_to(side, (size,)) for side in ends]) if fits else np.zeros((2, 1))
    if not (both[0] < both[1]).all():
        form = f"(low, high), each a number or of shape ({size},), with low < high"
        raise ValueError(f"{name} must be {form}, got {shown(limits)}")
    return both


def _from_center(limits: Any, center: np.ndarray, name: str, *, at_end: bool = False) -> np.ndarray:
    """Returns the ends of a pair, shape (2, size), as distances from a point, which with `at_end` may be one of them.

    Raises:
        ValueError: If it is no pair, or the point is not between them, by more than rounding.
    """
    ends = sides(limits, len(center), name) - center
    finite = np.isfinite(ends)
    sizes = np.where(finite, np.array([[-1.0], [1.0]]) * ends, 1.0)
    if not (((sizes > SMALLEST_NUMBER) | (at_end & (sizes == 0.0))) & (sizes < LARGEST_NUMBER)).all():
        between = "at an end or between them" if at_end else "strictly between them"
        form = f"absolute, of usual size, the operating point, at=(state, input) of the Model, {between}"
        raise ValueError(f"{name} must be {form}: it is {shown(center.tolist())}, got {shown(limits)}")
    nearest = sizes.min(axis=0)
    nearly = finite.all(axis=0) & (np.abs(sizes[1] - sizes[0]) <= NEARLY_SYMMETRIC * nearest)
    return np.where(nearly, [-nearest, nearest], ends)


@dataclass(frozen=True, eq=False)
class Limits(ReadOnlyArrays):
    """Limits of a model's own states and inputs, in its units; absolute, or half-widths where it is about zero.

    Attributes:
        state: Half-widths, a number or shape (n,), or a pair (low, high) of numbers or vectors, which of two states are
            vectors; infinite where there is no limit. None: no state has one of its own.
        input: Alike, all finite; an operating input that is given may be at an end, as of a heater that is off.
        rows: Limits of several entries, a list of (c_x, c_u, low, high) with low <= c_x x + c_u u <= high for the x at
            the beginning of a step and the u that is held then; c_u is None in a limit of states alone.
        rate: Largest change of each input from one step to the next, a positive number or shape (m,).
        between_samples: Number of times per step, 1 to 64, at which limits of states count; None for the end alone.
    """

    state: Any = None
    input: Any = None
    rows: Sequence[tuple[Any, Any, float, float]] = ()
    rate: Any = None
    between_samples: int | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.rows, list | tuple) or not all(
            isinstance(each, list | tuple) and len(each) == 4 for each in self.rows
        ):
            raise ValueError(f"rows of limits must be a list of (c_x, c_u, low, high), got {shown(self.rows)}")
        points = self.between_samples
        if points is not None:
            points = as_count(points, "between_samples", low=1, high=MOST_POINTS)
        self._set(**{name: as_given(getattr(self, name)) for name in ("state", "input", "rows", "rate")})
        self._set(between_samples=None if points == 1 else points)

    def around(self, model: Model) -> LimitValues:
        """Returns a model with these limits, counted from its point.

        Raises:
            ValueError: If they are no limits of its states and inputs, or its point is not within them.
        """
        point, (n, m) = np.concatenate([model.state, model.input]), model.B.shape
        of_states, mixed = [], []
        if self.state is not None:
            of_states.append(Rows.of(np.eye(n), _from_center(self._pair("state", model), model.state, "state limits")))
        inputs = _from_center(self._pair("input", model), model.input, "input limits", at_end=model.at is not None)
        if not np.isfinite(inputs).all():
            raise ValueError(f"input limits must be finite, since actions span them, got {shown(self.input)}")
        for of_state, of_input, low, high in self.rows:
            c_x = as_point(of_state, n, "c_x of a row of limits")
            c_u = np.zeros(m) if of_input is None else as_point(of_input, m, "c_u of a row of limits")
            if np.abs(c_x if of_input is None else c_u).max() < SMALLEST_NUMBER:
                raise ValueError(f"every row of limits must limit something, with c_u None or not 0, got {shown(c_x)}")
            c = np.concatenate([c_x, c_u])[None]
            ends = _from_center((low, high), exact.product(c, point), "the ends of a row of limits")
            (of_states if of_input is None else mixed).append(Rows.of(c[:, :n] if of_input is None else c, ends))
        box, together = Rows.joined(of_states, n), Rows.joined(mixed, n + m)
        if not len(box.rows):
            box = _chosen(model, inputs)
        values, offset = LimitValues(), np.zeros(n) if model.offset is None else np.abs(model.offset)
        values._set(A=model.A, B=model.B, H=model.H, past=0, is_past_row=np.zeros(len(box.rows), np.bool_))
        values._set(box=box.rows, box_ends=box.ends, mixed_rows=together.rows, mixed_ends=together.ends)
        values._set(input_ends=inputs, operating_state=model.state, operating_input=model.input)
        values._set(step_offset=offset, lacking=np.abs(model.lacking))
        return values

    def absolute(self, model: Model) -> Limits:
        """Returns the same limits of a model about zero as pairs, which stay where they are beside any point."""
        return replace(self, state=self._pair("state", model), input=self._pair("input", model))

    def change_within(self, half: np.ndarray) -> np.ndarray | None:
        """Returns the largest change of each input, shape (m,), given half their range; None if any is allowed.

        Raises:
            ValueError: If `rate` is no such change, or limits nothing.
        """
        if self.rate is None:
            return None
        change = as_setting(self.rate)
        fits = change is not None and change.shape in ((), half.shape) and (change >= SMALLEST_NUMBER).all()
        if change is None or not fits or not (change < 2.0 * half).any() or not np.isfinite(change).all():
            form = f"a positive number or shape {half.shape}, smaller than the range of some input"
            raise ValueError(f"rate must be {form}, got {shown(self.rate)}")
        return np.broadcast_to(change, half.shape).copy()

    def _pair(self, name: str, model: Model) -> Any:
        """Returns limits of states or inputs as a pair (low, high), also where half-widths are given."""
        given = getattr(self, name)
        widths = as_setting(given)
        if widths is None or widths.shape not in ((), getattr(model, name).shape):
            return given
        if model.at is not None or not (widths > 0.0).all() or np.isinf(widths).all():
            form = "positive half-widths, not all infinite, or" if model.at is None else "absolute, beside at=(...):"
            raise ValueError(f"{name} limits must be {form} (low, high) of vectors, got {shown(given)}")
        return -widths, widths


def _chosen(model: Model, inputs: np.ndarray) -> Rows:
    """Returns half-widths for states without limits: FREE_REACH times what inputs within ends (2, m) reach in n steps.

    Raises:
        ValueError: If no input moves a state.
    """
    reach = reach_in_steps(model.A, model.B, np.abs(inputs).max(axis=0), np.zeros(len(model.A)))
    if not reach.all():
        raise ValueError(f"Limits need state=: no input moves state {reach.argmin() + 1}, which none of them limits")
    widths = np.array([float(exact.rounded(FREE_REACH * each, 1)) for each in reach])
    text = f"no state has a limit: half-widths {shown(widths.tolist())} were chosen, give Limits(state=...) for others"
    warn_caller(text, ChosenLimitsWarning)
    return Rows.of(np.eye(len(widths)), np.array([-widths, widths]))
