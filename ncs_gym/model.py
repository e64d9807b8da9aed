"""The model of a plant: its equations, those in continuous time that they come from, and the point they are about."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from ncs_gym import exact
from ncs_gym.validation import (
    SMALLEST_NUMBER,
    ReadOnlyArrays,
    as_given,
    as_matrix,
    as_number,
    as_numbers,
    as_setting,
    as_vector,
    shown,
)

LONGEST_DELAY = 100
# Durations of steps that differ by less than this are the same.
SAME_STEP = 1e-9
# The constant of x+ = A x + B u + c may differ by this from what an equilibrium needs, relative to its terms.
EQUILIBRIUM_PRECISION = 1e-12


def zero_order_hold(A: np.ndarray, B: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns A and B of a step for x' = A x + B u with u held over it, shapes (n, n) and (n, m), rounded once.

    Raises:
        ValueError: If an entry is too large for a float64.
    """
    n, m = B.shape
    try:
        sampled = exact.exponential(np.block([[A, B], [np.zeros((m, n + m))]]), dt)
    except OverflowError as error:
        raise ValueError(f"the model grows beyond all numbers within a step of {dt:g} s: give a smaller dt") from error
    return sampled[:n, :n], sampled[:n, n:]


def as_point(value: Any, size: int, name: str) -> np.ndarray:
    """Returns a finite vector, shape (size,), or raises ValueError; a number stands for a vector of one entry."""
    numbers = as_numbers(value)
    return as_vector([value] if size == 1 and numbers is not None and numbers.ndim == 0 else value, size, name)


@dataclass(frozen=True, eq=False)
class Model(ReadOnlyArrays):
    """x+ = A x + B u (+ offset), y = H x.

    Attributes:
        A: Shape (n, n).
        B: Shape (n, m).
        H: Output matrix, shape (p, n); None for the identity.
        dt: Duration of a step [s].
        at: State and input that deviations, which A and B are a model of, are counted from, shapes (n,) and (m,); None
            for zero.
        offset: c of a model in absolute coordinates, x+ = A x + B u + c, shape (n,), with an equilibrium `at`.
        continuous: [Ac, Bc] of x' = Ac x + Bc u that A and B were sampled from, shape (n, n + m); None if unknown.
        delays: Steps after which each input acts on each state, shape (n, m) (`with_delays`).
        state, input: `at`, zero where it is None.
        lacking: What `at` lacks of an equilibrium beside an offset, which is rounding, shape (n,).

    Raises:
        ValueError: If a matrix has a wrong shape or is not finite, `at` is no equilibrium beside an offset, or A and B
            are not those of `continuous`.
    """

    A: Any
    B: Any
    H: Any
    dt: float
    at: Any = None
    offset: Any = None
    continuous: Any = None
    delays: Any = 0
    state: np.ndarray = field(init=False, repr=False)
    input: np.ndarray = field(init=False, repr=False)
    lacking: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        A = _square(self.A)
        n = len(A)
        B = as_matrix(self.B, (n, None), "B")
        H = np.eye(n) if self.H is None else as_matrix(self.H, (None, n), "H, with a row per output,")
        if (np.abs(H).max(axis=1) < SMALLEST_NUMBER).any():
            raise ValueError(f"every row of H must measure something, got {shown(H.tolist())}")
        at = (None, None) if self.at is None else self.at
        if not isinstance(at, tuple | list) or len(at) != 2:
            raise ValueError(f"at must be a pair of a state and an input, got {shown(at)}")
        for name, of, size in zip(("state", "input"), at, B.shape, strict=True):
            point = np.zeros(size) if of is None else as_point(of, size, f"the {name} in at=(state, input)")
            self._set(**{name: point})
        dt, delays = as_number(self.dt, "dt", low=0.0, low_open=True), _steps(self.delays, B.shape, "delays")
        self._set(at=as_given(self.at), A=A, B=B, H=H, dt=dt, delays=delays)
        lacking = np.zeros(n)
        if self.offset is not None:
            self._set(offset=as_vector(self.offset, n, "offset"))
            lacking, rests = residual(A, B, np.eye(n), self.state, self.input, self.offset)
            if not rests:
                text = f"A x0 + B u0 + c - x0 = {shown(lacking.tolist())}; a model of deviations has no offset"
                raise ValueError(f"the operating point is no equilibrium: {text}")
        self._set(lacking=lacking)
        if self.continuous is not None:
            continuous = as_matrix(self.continuous, (n, n + B.shape[1]), "continuous")
            sampled = zero_order_hold(continuous[:, :n], continuous[:, n:], dt)
            if not (np.array_equal(sampled[0], A) and np.array_equal(sampled[1], B)):
                raise ValueError("continuous must be what A and B were sampled from, as by Model.sampled, or None")
            self._set(continuous=continuous)

    @classmethod
    def sampled(cls, A: Any, B: Any, C: Any, dt: float, at: Any = None) -> Self:
        """Returns the exact zero-order hold of x' = A x + B u, y = C x; C is the identity if None."""
        A = _square(A)
        B, dt = as_matrix(B, (len(A), None), "B"), as_number(dt, "dt", low=0.0, low_open=True)
        return cls(*zero_order_hold(A, B, dt), C, dt, at, continuous=np.concatenate([A, B], axis=1))

    @classmethod
    def of(cls, system: Any, dt: float | None = None, at: Any = None) -> Self:
        """Returns that of a state-space model, whose C becomes H; one in continuous time is sampled exactly.

        Args:
            system: Of python-control or scipy.signal, or a tuple (A, B, C, D) in continuous or (A, B, C, D, dt) in
                discrete time.
            dt: Duration of a step [s], needed unless the model has one.
            at: As of `Model`.

        Raises:
            ValueError: If it is no such model, D is not zero, or dt is missing or another than the model's.
        """
        of = system if isinstance(system, tuple | list) else [getattr(system, name, None) for name in (*"ABCD", "dt")]
        A, B, C, D, own = (*of, 0)[:5] if len(of) in (4, 5) else 5 * (None,)
        if own is None and type(system).__module__.startswith("scipy."):
            own = 0  # of its models in continuous time
        feedthrough = as_numbers(0.0 if D is None else D)
        missing = any(each is None for each in (A, B, C, own, feedthrough))
        if missing or np.any(feedthrough):
            raise ValueError(
                "the system must be a state-space model of python-control or scipy.signal, or a tuple (A, B, C, D) or "
                "(A, B, C, D, dt): D = 0, since sensors here measure H x + v (subtract D u), and dt is 0 in continuous "
                f"time or the sampling time in seconds, not None, got {shown(system)}"
            )
        if own is True or own == 0:  # without a sampling time
            dt = as_number(dt, "dt, the step of a model that has none,", low=0.0, low_open=True)
            return cls(A, B, C, dt, at) if own is True else cls.sampled(A, B, C, dt, at)
        own = as_number(own, "dt of the model", low=0.0, low_open=True)
        if dt is not None and abs(as_number(dt, "dt") - own) > SAME_STEP * own:
            raise ValueError(f"dt must be that of the model in discrete time, {own:g}, or be left out, got {dt}")
        return cls(A, B, C, own if dt is None else dt, at)

    def held(self, E: Any) -> np.ndarray:
        """Returns what w' = E w held constant over a step does to the state, shape (n, q), for E of shape (n, q).

        Raises:
            ValueError: If the model was not sampled from one in continuous time.
        """
        if self.continuous is None:
            raise ValueError("what is held over a step is known of a model that Model.sampled made")
        n = len(self.A)
        return zero_order_hold(self.continuous[:, :n], as_matrix(E, (n, None), "E"), self.dt)[1]

    def with_delays(self, inputs: Any = None, outputs: Any = 0) -> Self:
        """Returns the model of x_i+ = (A x)_i + sum_j B_ij u_j(k - d_ij), y_l = H_l x(k - e_l) + v_l(k).

        Inputs under way become further states of a `LinearPlant`, of which limits and bounds do not speak. Past
        outputs, each H_l x, the newest first, become the last of the model's own states: with no limit, no disturbance,
        and the error of a first estimate.

        Args:
            inputs: d, whole steps: a number, shape (m,), or for each state and input, shape (n, m); None keeps them.
            outputs: e, whole steps: a number, or shape (p,).

        Raises:
            ValueError: If they are no such steps.
        """
        n, m = self.B.shape
        d = self.delays if inputs is None else _steps(inputs, (n, m), "delays")
        e = _steps(outputs, (len(self.H),), "delays of outputs")
        if not (held := int(e.sum())):
            return replace(self, delays=d)
        A, H, first = np.pad(self.A, (0, held)), np.pad(self.H, ((0, 0), (0, held))), n
        for row, steps in zip(H, e.tolist(), strict=True):
            if steps:
                A[first : first + steps, first - 1 : first + steps - 1] = np.eye(steps)
                A[first], row[:] = row, np.eye(n + held)[first + steps - 1]
                first += steps
        state = np.concatenate([self.state, np.repeat(self.H @ self.state, e)])
        c = None if self.offset is None else np.pad(self.offset, (0, held))
        at = None if self.at is None else (state, self.input)
        B, d = np.pad(self.B, ((0, held), (0, 0))), np.pad(d, ((0, held), (0, 0)), mode="maximum")
        return replace(self, A=A, B=B, H=H, at=at, offset=c, continuous=None, delays=d)


def _square(A: Any) -> np.ndarray:
    A = as_matrix(A, (None, None), "A")
    return as_matrix(A, (len(A), len(A)), "A")


def _steps(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    steps, shapes = as_setting(value), [*dict.fromkeys((shape[-1:], shape))]
    if steps is None or steps.shape not in ((), *shapes) or not np.isin(steps, np.arange(LONGEST_DELAY + 1)).all():
        one = f"{name} must be a whole number of steps from 0 to {LONGEST_DELAY}"
        raise ValueError(f"{one}, or such numbers of shape {' or '.join(map(str, shapes))}, got {shown(value)}")
    return np.broadcast_to(steps, shape).astype(int)


def residual(
    A: np.ndarray, B: np.ndarray, E: np.ndarray, x: np.ndarray, u: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Returns A x + B u + E w - x, rounded once, shape (n,), and whether that is rounding alone."""
    missing = exact.product(np.hstack([A, B, E, -np.eye(len(A))]), np.concatenate([x, u, w, x]))
    terms = np.abs(A) @ np.abs(x) + np.abs(B) @ np.abs(u) + np.abs(E) @ np.abs(w) + np.abs(x)
    return missing, bool((np.abs(missing) <= EQUILIBRIUM_PRECISION * terms).all())
