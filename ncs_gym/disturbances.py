"""What acts on the plant inside the bound that certificates assume.

Ball, box and sinusoid stay within the ball and the other sets that a plant declares, and truncated process noise is
added. Sphere and adversary use the whole of E(D), process noise included.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np

from ncs_gym.ellipsoid import Ellipsoid
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import (
    LARGEST_NUMBER,
    Shared,
    as_covariance,
    as_matrix,
    as_number,
    as_setting,
    as_vector,
    shown,
    storing_nothing,
)

# Extreme points are pulled in, and points out by rounding pushed in, by this much.
ROUNDING = 1e-12
# A disturbance outside E(D) by no more than this is taken for rounding and scaled back onto it.
TOLERANCE = 1e-9
# How noise may be drawn: inside its truncation, without a bound, or with sensor noise and first errors on their bounds.
NOISES = ("truncated", "gaussian", "extreme")


class Disturbance(Shared, ABC):
    """A disturbance in the ball d'd <= `gamma` of a plant plus `of_disturbance.bound`; process noise is added to it.

    `begin` draws what stays fixed for an episode, `draw` the disturbance of one step; neither stores anything in the
    object, which any number of environments share. A subclass does not inherit the class attributes below.

    Attributes:
        replaces_process_noise: Whether the whole of E(D) is used, process noise included.
        memoryless: Whether d depends on chance alone; `draw` is then called ahead, with an array of the right shape in
            place of A x + B u, and None for step and memory.
    """

    replaces_process_noise: ClassVar[bool] = False
    memoryless: ClassVar[bool] = False
    _promises = "vectorized", "memoryless", "replaces_process_noise"

    @abstractmethod
    def draw(
        self, rng: np.random.Generator, plant: LinearPlant, nominal_next: np.ndarray, step: Any, memory: Any
    ) -> np.ndarray:
        """Returns d, shape (n,), or (n, N) if vectorized.

        Args:
            rng: Source of randomness.
            plant: The plant.
            nominal_next: A x + B u, shape (n,) or (n, N).
            step: Number of steps taken before this one, an int or shape (N,).
            memory: What `begin` returned.
        """

    def draw_many(
        self, rng: np.random.Generator, plant: LinearPlant, nominal_next: np.ndarray, steps: np.ndarray, memory: Any
    ) -> np.ndarray:
        """Returns d for N environments, shape (n, N), given A x + B u, shape (n, N), and steps, shape (N,)."""
        if self.vectorized:
            return self.draw(rng, plant, nominal_next, steps, memory)
        each = zip(nominal_next.T, steps.tolist(), memory, strict=True)
        with storing_nothing(self):
            return np.array([self.draw(rng, plant, nominal, step, own) for nominal, step, own in each]).T

    def check(self, plant: LinearPlant, *, may_leave: bool = False) -> str:
        """Returns why this disturbance does not fit the plant, or may leave its bound, or an empty string."""
        return ""


@dataclass(frozen=True, eq=False)
class BallDisturbance(Disturbance):
    """Uniform in the ball of squared radius gamma, plus uniform in its `of_disturbance.bound`."""

    vectorized: ClassVar[bool] = True
    memoryless: ClassVar[bool] = True

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        count = None if nominal_next.ndim == 1 else nominal_next.shape[1]
        d = np.zeros(nominal_next.shape)
        if plant.gamma > 0.0:
            d = np.sqrt(plant.gamma) * _unit_ball(plant.n).sample(rng, count).T
        bound = _declared(plant)
        return d if bound is None else d + bound.sample(rng, count).T


@dataclass(frozen=True, eq=False)
class BoxDisturbance(Disturbance):
    """Uniform in a box (Liu et al. Section 5).

    Attributes:
        half_widths: Shape (n,), of a box in the ball d'd <= gamma plus its `of_disturbance.bound`. None:
            sqrt(gamma / n) each, plus uniform in the box inside that bound: where it was given by half-widths, these.

    Raises:
        ValueError: If a half-width is negative or not finite.
    """

    half_widths: Sequence[float] | np.ndarray | None = None

    vectorized: ClassVar[bool] = True
    memoryless: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.half_widths is None:
            return
        widths = as_vector(self.half_widths, None, "half_widths")
        if (widths < 0.0).any():
            raise ValueError(f"half_widths must be >= 0, got {widths.tolist()}")
        self._set(half_widths=widths)

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        widths = np.sqrt(plant.gamma / plant.n) if self.half_widths is None else np.asarray(self.half_widths)
        d = (rng.uniform(-1.0, 1.0, nominal_next.shape).T * widths).T
        bound = _declared(plant)
        if self.half_widths is not None or bound is None:
            return d
        return d + sample_box(bound, rng, None if nominal_next.ndim == 1 else nominal_next.shape[1])

    def check(self, plant, *, may_leave=False):  # noqa: D102
        if self.half_widths is None:
            return ""
        widths, bound = np.asarray(self.half_widths), _declared(plant)
        if widths.shape != (plant.n,):
            return f"half_widths must have {plant.n} entries, got {widths.size}"
        # Of a set with the coordinates as axes, all corners lie equally far out; E(P1 + P2) is inside of E(P1) + E(P2).
        inside = plant.gamma * np.eye(plant.n) + (0.0 if bound is None else diagonal_inside(bound))
        size = Ellipsoid(inside).gauge(widths)
        if may_leave or size <= 1.0 + ROUNDING:
            return ""
        return f"the corner of the box is {size:.6g} times as far out as the plant's Bounds(disturbance=...) allow"


@dataclass(frozen=True, eq=False)
class SinusoidDisturbance(Disturbance):
    """a sin(2 pi k / period + phase), with a random extreme disturbance a and phase each episode.

    a is a boundary point of the ball of squared radius gamma plus one of its `of_disturbance.bound`.

    Attributes:
        period: In steps.

    Raises:
        ValueError: If the period is not positive.
    """

    period: float = 20.0

    vectorized: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self._set(period=as_number(self.period, "period", low=0.0, low_open=True))

    def begin(self, rng, plant, size=None):  # noqa: D102
        axes = np.sqrt(plant.gamma) * _unit_ball(plant.n).sample_boundary(rng, size)
        bound = _declared(plant)
        if bound is not None:
            axes = axes + bound.sample_boundary(rng, size)
        return np.concatenate([axes.T, rng.uniform(0.0, 2.0 * np.pi, (1,) if size is None else (1, size))])

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        axis, phase = memory[:-1], memory[-1]
        return axis * np.sin(2.0 * np.pi * step / self.period + phase)


def sample_box(bound: Ellipsoid, rng: np.random.Generator, count: int | None = None) -> np.ndarray:
    """Returns points, shape (n,) or (n, count), uniform in the box inside an ellipsoid along its principal axes."""
    axes = bound.factor * bound.drawn_axes / np.sqrt(np.count_nonzero(bound.drawn_axes))
    return axes @ rng.uniform(-1.0, 1.0, bound.dim if count is None else (bound.dim, count))


def diagonal_inside(bound: Ellipsoid) -> np.ndarray:
    """Returns the diagonal shape of an ellipsoid inside one, shape (n, n): P if it is diagonal, else j diag(P).

    j is the smallest eigenvalue of P in units in which its diagonal is 1.
    """
    variances = np.diag(bound.shape_matrix)
    kept = variances > 0.0
    if not kept.any() or np.array_equal(bound.shape_matrix, np.diag(variances)):
        return bound.shape_matrix
    scale = np.sqrt(variances[kept])
    smallest = np.linalg.eigvalsh(bound.shape_matrix[np.ix_(kept, kept)] / np.outer(scale, scale))[0]
    return max(float(smallest), 0.0) * np.diag(variances)


@cache
def _unit_ball(dim: int) -> Ellipsoid:
    return Ellipsoid(np.eye(dim))


def _declared(plant: LinearPlant) -> Ellipsoid | None:
    """Returns the plant's declared bound of disturbances; None if there is none or it is a point."""
    bound = plant.of_disturbance.bound
    return bound if bound is not None and np.any(bound.shape_matrix) else None


@dataclass(frozen=True, eq=False)
class SphereDisturbance(Disturbance):
    """A random boundary point of E(D): always as large as allowed."""

    replaces_process_noise: ClassVar[bool] = True
    vectorized: ClassVar[bool] = True
    memoryless: ClassVar[bool] = True

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        count = None if nominal_next.ndim == 1 else nominal_next.shape[1]
        return (1.0 - ROUNDING) * plant.nominal_disturbance.sample_boundary(rng, count).T


@dataclass(frozen=True, eq=False)
class AdversarialDisturbance(Disturbance):
    """The point of E(D) that does the most harm to the next state.

    Attributes:
        M: Shape (n, n): maximize (x+)' M (x+). None: maximize how far a c_j x+, of those it can move, is beyond an end.
        rows: Shape (r, n), in place of the safe box where M is None, with ends -1 and 1.

    Raises:
        ValueError: If M is not symmetric positive semidefinite, or rows are no matrix.
    """

    M: np.ndarray | None = None
    rows: np.ndarray | None = None
    replaces_process_noise: ClassVar[bool] = True
    vectorized: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.M is not None:
            self._set(M=as_covariance(self.M, None, "M"))
        if self.rows is not None:
            self._set(rows=as_matrix(self.rows, (None, None), "rows"))

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        bound = plant.nominal_disturbance
        if self.M is not None:
            return (1.0 - ROUNDING) * bound.farthest_point(nominal_next.T, self.M).T
        rows, (low, high) = plant.box, plant.box_ends
        if self.rows is not None:
            rows, low, high = self.rows, -np.ones(len(self.rows)), np.ones(len(self.rows))
        values = (rows @ nominal_next).T
        above, below = values - high, low - values
        reach = np.asarray(bound.support(rows))
        movable = reach > 0.0 if np.any(reach > 0.0) else np.ones(len(reach), np.bool_)
        worst = np.argmax(np.where(movable, np.maximum(above, below) + reach, -np.inf), axis=-1)
        needed, places = np.unique(worst, return_inverse=True)
        extremes = np.stack([bound.extreme_point(row) for row in rows[needed]], axis=1)
        signs = np.where(np.take_along_axis(above >= below, worst[..., None], axis=-1)[..., 0], 1.0, -1.0)
        return (1.0 - ROUNDING) * signs * extremes[:, places.reshape(worst.shape)]

    def check(self, plant, *, may_leave=False):  # noqa: D102
        if self.M is not None and self.M.shape != (plant.n, plant.n):
            return f"M must have shape ({plant.n}, {plant.n}), got {self.M.shape}"
        if self.rows is not None and self.rows.shape[1] != plant.n:
            return f"rows must have {plant.n} columns, got {self.rows.shape[1]}"
        return ""


@dataclass(frozen=True, eq=False)
class CallableDisturbance(Disturbance):
    """A user's function (rng, plant, nominal_next) -> d, shape (n,)."""

    function: Callable[[np.random.Generator, LinearPlant, np.ndarray], np.ndarray]
    replaces_process_noise: ClassVar[bool] = True

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        return self.function(rng, plant, nominal_next.copy())


BY_NAME: dict[str, type[Disturbance]] = {
    "ball": BallDisturbance,
    "box": BoxDisturbance,
    "sinusoid": SinusoidDisturbance,
    "sphere": SphereDisturbance,
    "adversarial": AdversarialDisturbance,
}


def as_disturbance(value: Any, plant: LinearPlant, allow_assumption_violation: bool) -> Disturbance:
    """Returns the disturbance of a name, a `Disturbance` or a callable (rng, plant, nominal_next) -> d.

    Raises:
        ValueError: If it is none of these, or does not suit the plant.
    """
    if isinstance(value, str) and value in BY_NAME:
        value = BY_NAME[value]()
    elif not isinstance(value, Disturbance | type) and callable(value):
        function: Any = value
        value = CallableDisturbance(function)
    if not isinstance(value, Disturbance):
        raise ValueError(
            f"disturbance must be one of {sorted(BY_NAME)}, a Disturbance or a callable, got {shown(value)}"
        )
    if problem := value.check(plant, may_leave=allow_assumption_violation):
        raise ValueError(f"{type(value).__name__}: {problem}")
    return value


def as_noise(value: Any, plant: LinearPlant) -> str:
    """Returns one of `NOISES`.

    "gaussian" draws from the Gaussian itself; what other sets bound stays inside. "extreme" draws sensor noise and
    first errors in random directions on the boundary of what is assumed of them.

    Raises:
        ValueError: If it is another value, or "gaussian" for a plant without any covariance.
    """
    if not (isinstance(value, str) and value in NOISES):
        raise ValueError(f"noise must be one of {list(NOISES)}, got {shown(value)}")
    covariances = plant.process_noise.covariance, plant.sensor_noise.covariance, plant.initial_noise.covariance
    if value == "gaussian" and not any(np.any(each) for each in covariances):
        raise ValueError('noise="gaussian" needs a Gaussian among the bounds of the plant')
    return value


def checked(plant: LinearPlant, d: Any, count: int | None = None, *, allow_assumption_violation: bool) -> np.ndarray:
    """Returns disturbances, shape (n,) or (n, count), inside E(D), scaled back to leave room for rounding.

    Raises:
        ValueError: If one is not finite, wrongly shaped, or further outside than TOLERANCE and that is not allowed.
    """
    given, d, shape = d, as_setting(d), (plant.n,) if count is None else (plant.n, count)
    if d is None or d.shape != shape or not (np.abs(d) < LARGEST_NUMBER).all():
        raise ValueError(f"a disturbance must be finite with shape {shape}, got {shown(given)}")
    if allow_assumption_violation:
        return d
    for each in np.flatnonzero(plant.allowed_disturbance.gauge(d.T) > 1.0 - ROUNDING):
        one = d if count is None else d[:, each]
        if (size := plant.disturbance.gauge(one)) > 1.0 + TOLERANCE:
            raise ValueError(
                f"the disturbance {one.tolist()} lies outside its bound E(D): sqrt(d' D^-1 d) = {size:.6g} > 1 "
                "(allow_assumption_violation=True lets it pass)"
            )
        one *= (1.0 - ROUNDING) / max(plant.allowed_disturbance.gauge(one), 1.0 - ROUNDING)
    return d
