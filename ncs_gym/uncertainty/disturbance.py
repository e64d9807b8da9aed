"""What nature does to the plant, inside the bound the certificates assume.

`begin` draws what stays fixed for an episode, `draw` the disturbance of one step; neither stores
anything in the settings, so one object serves any number of environments.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.validation import (
    LARGEST,
    FrozenArrays,
    as_covariance,
    as_number,
    as_setting,
    as_vector,
    forget_batches,
    shown,
)

# Extreme points are pulled in, and points out by rounding pushed in, by this much.
ROUNDING = 1e-12
# A disturbance outside E(D) by no more than this is taken for rounding and scaled back onto it.
TOLERANCE = 1e-9


class Disturbance(FrozenArrays, ABC):
    """A disturbance in {d : d'd <= gamma}; truncated process noise is added to it.

    `begin_many` and `draw_many` serve vector environments. A subclass that overrides `begin` or `draw` without both of
    them gets the ones below, which go through the environments one by one.

    Subclasses with `replaces_process_noise` use the whole of E(D), process noise included. The environment checks what
    does not come from a class of this module at every step.
    """

    replaces_process_noise: ClassVar[bool] = False

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Keeps batch methods of a parent from hiding what a subclass changes."""
        super().__init_subclass__(**keywords)
        forget_batches(cls, Disturbance, {"begin": "begin_many", "draw": "draw_many"})

    def begin(self, rng: np.random.Generator, plant: LinearPlant) -> Any:
        """Returns what stays fixed for one episode (None unless overridden)."""
        return None

    @abstractmethod
    def draw(
        self, rng: np.random.Generator, plant: LinearPlant, nominal_next: np.ndarray, step: int, memory: Any
    ) -> np.ndarray:
        """Returns d, shape (n,).

        Args:
            rng: Source of randomness.
            plant: The plant.
            nominal_next: A x + B u, shape (n,).
            step: Number of steps taken before this one.
            memory: What `begin` returned.
        """

    def begin_many(self, rng: np.random.Generator, plant: LinearPlant, count: int) -> np.ndarray:
        """Returns the memories of `count` episodes along the first axis."""
        memories = np.full(count, None, dtype=object)
        if type(self).begin is not Disturbance.begin:
            memories[:] = [self.begin(rng, plant) for _ in range(count)]
        return memories

    def draw_many(
        self, rng: np.random.Generator, plant: LinearPlant, nominal_next: np.ndarray, steps: np.ndarray, memory: Any
    ) -> np.ndarray:
        """Returns d for many environments, shape (N, n); one by one unless overridden.

        Args:
            rng: Source of randomness.
            plant: The plant.
            nominal_next: A x + B u, shape (N, n).
            steps: Number of steps taken before this one, shape (N,).
            memory: What `begin_many` returned, first axis N.
        """
        several = zip(nominal_next, steps.tolist(), memory, strict=True)
        return np.array([self.draw(rng, plant, each, step, remembered) for each, step, remembered in several])

    def check(self, plant: LinearPlant) -> str:
        """Returns why this disturbance does not fit the plant, or an empty string."""
        return ""

    def excess(self, plant: LinearPlant) -> str:
        """Returns why it may go beyond the plant's bound (which can be allowed), or an empty string."""
        return ""


@dataclass(frozen=True, eq=False)
class BallDisturbance(Disturbance):
    """Uniform in the ball of squared radius gamma."""

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        direction = rng.standard_normal(plant.n)
        radius = np.sqrt(plant.gamma) * rng.random() ** (1.0 / plant.n)
        return direction * (radius / np.linalg.norm(direction))

    def draw_many(self, rng, plant, nominal_next, steps, memory):  # noqa: D102
        if plant.gamma == 0.0:
            return np.zeros_like(nominal_next)
        return Ellipsoid(plant.gamma * np.eye(plant.n)).sample_many(rng, len(nominal_next))


@dataclass(frozen=True, eq=False)
class BoxDisturbance(Disturbance):
    """Uniform in a box (Liu et al. Section 5).

    Attributes:
        half_widths: Shape (n,); the box must lie in {d'd <= gamma}. None: sqrt(gamma / n) each.

    Raises:
        ValueError: If a half-width is negative or not finite.
    """

    half_widths: Sequence[float] | np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.half_widths is None:
            return
        widths = as_vector(self.half_widths, None, "half_widths")
        if (widths < 0.0).any():
            raise ValueError(f"half_widths must be >= 0, got {widths.tolist()}")
        object.__setattr__(self, "half_widths", widths)
        self._freeze_arrays()

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        return rng.uniform(-1.0, 1.0, plant.n) * self.widths(plant)

    def draw_many(self, rng, plant, nominal_next, steps, memory):  # noqa: D102
        return rng.uniform(-1.0, 1.0, nominal_next.shape) * self.widths(plant)

    def widths(self, plant: LinearPlant) -> np.ndarray:
        """Returns the half-widths for a plant, shape (n,)."""
        widths = np.sqrt(plant.gamma / plant.n) if self.half_widths is None else self.half_widths
        return np.broadcast_to(np.asarray(widths, dtype=np.float64), (plant.n,))

    def check(self, plant):  # noqa: D102
        if self.half_widths is None:
            return ""
        widths = np.asarray(self.half_widths)
        if widths.shape != (plant.n,):
            return f"half_widths must have {plant.n} entries, got {widths.size}"
        return ""

    def excess(self, plant):  # noqa: D102
        corner = float(np.sum(np.square(self.half_widths))) if self.half_widths is not None else 0.0
        if corner > plant.gamma * (1.0 + ROUNDING):
            return f"the corner of the box has squared length {corner:g} > gamma = {plant.gamma:g}"
        return ""


@dataclass(frozen=True, eq=False)
class SinusoidDisturbance(Disturbance):
    """sqrt(gamma) a sin(2 pi k / period + phase), with a random axis a and phase each episode.

    Attributes:
        period: In steps.

    Raises:
        ValueError: If the period is not positive.
    """

    period: float = 20.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", as_number(self.period, "period", low=0.0, low_open=True))

    def begin(self, rng, plant):  # noqa: D102
        axis = rng.standard_normal(plant.n)
        return axis / np.linalg.norm(axis), rng.uniform(0.0, 2.0 * np.pi)

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        axis, phase = memory
        return np.sqrt(plant.gamma) * axis * np.sin(2.0 * np.pi * step / self.period + phase)

    def begin_many(self, rng, plant, count):  # noqa: D102
        axes = Ellipsoid(np.eye(plant.n)).sample_boundary_many(rng, count)
        return np.column_stack([axes, rng.uniform(0.0, 2.0 * np.pi, count)])

    def draw_many(self, rng, plant, nominal_next, steps, memory):  # noqa: D102
        swing = np.sin(2.0 * np.pi * steps / self.period + memory[:, -1])
        return np.sqrt(plant.gamma) * memory[:, :-1] * swing[:, None]


@dataclass(frozen=True, eq=False)
class SphereDisturbance(Disturbance):
    """A random boundary point of E(D): always as large as allowed."""

    replaces_process_noise: ClassVar[bool] = True

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        return (1.0 - ROUNDING) * plant.nominal_disturbance.sample_boundary(rng)

    def draw_many(self, rng, plant, nominal_next, steps, memory):  # noqa: D102
        return (1.0 - ROUNDING) * plant.nominal_disturbance.sample_boundary_many(rng, len(nominal_next))


@dataclass(frozen=True, eq=False)
class AdversarialDisturbance(Disturbance):
    """The point of E(D) that does the most harm to the next state.

    Attributes:
        M: Shape (n, n): maximize (x+)' M (x+). None: maximize the largest |c_j x+|.

    Raises:
        ValueError: If M is not symmetric positive semidefinite.
    """

    M: np.ndarray | None = None
    replaces_process_noise: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.M is not None:
            object.__setattr__(self, "M", as_covariance(self.M, None, "M"))
        self._freeze_arrays()

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        if self.M is not None:
            return (1.0 - ROUNDING) * plant.nominal_disturbance.farthest_point(nominal_next, self.M)
        values = plant.C @ nominal_next
        worst = int(np.argmax(np.abs(values) + plant.nominal_disturbance.support(plant.C)))
        direction = plant.C[worst] * (1.0 if values[worst] >= 0.0 else -1.0)
        return (1.0 - ROUNDING) * plant.nominal_disturbance.extreme_point(direction)

    def draw_many(self, rng, plant, nominal_next, steps, memory):  # noqa: D102
        bound = plant.nominal_disturbance
        if self.M is not None:
            return (1.0 - ROUNDING) * bound.farthest_points(nominal_next, self.M)
        values = nominal_next @ plant.C.T
        worst = np.argmax(np.abs(values) + bound.support(plant.C), axis=1)
        signs = np.where(np.take_along_axis(values, worst[:, None], axis=1) >= 0.0, 1.0, -1.0)
        return (1.0 - ROUNDING) * signs * np.stack([bound.extreme_point(row) for row in plant.C])[worst]

    def check(self, plant):  # noqa: D102
        if self.M is not None and self.M.shape != (plant.n, plant.n):
            return f"M must have shape ({plant.n}, {plant.n}), got {self.M.shape}"
        return ""


@dataclass(frozen=True, eq=False)
class CallableDisturbance(Disturbance):
    """A user's function (rng, plant, nominal_next) -> d, shape (n,).

    Attributes:
        function: Called once a step.
    """

    function: Callable[[np.random.Generator, LinearPlant, np.ndarray], np.ndarray]
    replaces_process_noise: ClassVar[bool] = True

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        return self.function(rng, plant, nominal_next.copy())


def checked(plant: LinearPlant, d: Any, *, allow_assumption_violation: bool) -> np.ndarray:
    """Returns a disturbance as an array of shape (n,) inside E(D), scaled back to leave room for rounding.

    Raises:
        ValueError: If it is not finite, wrongly shaped, or further outside than TOLERANCE and that is not allowed.
    """
    d = as_vector(d, plant.n, "the disturbance")
    if allow_assumption_violation:
        return d
    if (size := plant.disturbance.gauge(d)) > 1.0 + TOLERANCE:
        raise ValueError(
            f"the disturbance {d.tolist()} lies outside its bound E(D): sqrt(d' D^-1 d) = {size:.6g} > 1 "
            "(allow_assumption_violation=True lets it pass)"
        )
    size = plant.allowed_disturbance.gauge(d)
    return d if size <= 1.0 - ROUNDING else d * ((1.0 - ROUNDING) / size)


def checked_many(plant: LinearPlant, d: Any, count: int, *, allow_assumption_violation: bool) -> np.ndarray:
    """Returns disturbances of many environments as `checked` does, shape (count, n).

    Raises:
        ValueError: If one is not finite, wrongly shaped, or further outside than TOLERANCE and that is not allowed.
    """
    given, d = d, as_setting(d)
    if d is None or d.shape != (count, plant.n) or not (np.abs(d) < LARGEST).all():
        raise ValueError(f"the disturbances must be finite with shape ({count}, {plant.n}), got {shown(given)}")
    if allow_assumption_violation:
        return d
    outside = np.flatnonzero(plant.allowed_disturbance.gauges(d) > 1.0 - ROUNDING)
    for row in outside:
        d[row] = checked(plant, d[row], allow_assumption_violation=False)
    return d


BY_NAME: dict[str, type[Disturbance]] = {
    "ball": BallDisturbance,
    "box": BoxDisturbance,
    "sinusoid": SinusoidDisturbance,
    "sphere": SphereDisturbance,
    "adversarial": AdversarialDisturbance,
}


def stays_inside(source: Disturbance) -> bool:
    """Returns whether a disturbance lies in E(D) by construction: that of this module's own classes does."""
    return type(source) in BY_NAME.values()


def as_disturbance(value: Any, plant: LinearPlant, allow_assumption_violation: bool) -> Disturbance:
    """Returns the settings for a name, a `Disturbance` or a callable (rng, plant, nominal_next) -> d.

    Raises:
        ValueError: If the name is unknown, the value is none of these, or it does not suit the plant.
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
    problem = value.check(plant)
    if not problem and not allow_assumption_violation:
        problem = value.excess(plant)
    if problem:
        raise ValueError(f"{type(value).__name__}: {problem}")
    return value
