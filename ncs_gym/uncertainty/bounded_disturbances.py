"""Disturbances within the ball d'd <= gamma plus the declared bound: uniform in both or in boxes, and a sinusoid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.declared_bound import diagonal_inside, sample_box
from ncs_gym.uncertainty.disturbance import ROUNDING, Disturbance
from ncs_gym.uncertainty.ellipsoid import Ellipsoid, sum_gauge
from ncs_gym.validation import as_number, as_vector


@dataclass(frozen=True, eq=False)
class BallDisturbance(Disturbance):
    """Uniform in the ball of squared radius gamma, plus uniform in the plant's `disturbance_bound`."""

    vectorized: ClassVar[bool] = True
    memoryless: ClassVar[bool] = True

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        count = None if nominal_next.ndim == 1 else nominal_next.shape[1]
        d = np.zeros(nominal_next.shape)
        if plant.gamma > 0.0:
            d = np.sqrt(plant.gamma) * Ellipsoid(np.eye(plant.n)).sample(rng, count).T
        bound = _declared(plant)
        return d if bound is None else d + bound.sample(rng, count).T


@dataclass(frozen=True, eq=False)
class BoxDisturbance(Disturbance):
    """Uniform in a box (Liu et al. Section 5).

    Attributes:
        half_widths: Shape (n,); the box must lie in the ball d'd <= gamma plus the plant's `disturbance_bound`. None:
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
        object.__setattr__(self, "half_widths", widths)
        self._make_arrays_read_only()

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        d = (rng.uniform(-1.0, 1.0, nominal_next.shape).T * self._widths(plant)).T
        bound = _declared(plant)
        if self.half_widths is not None or bound is None:
            return d
        return d + sample_box(bound, rng, None if nominal_next.ndim == 1 else nominal_next.shape[1])

    def _widths(self, plant: LinearPlant) -> np.ndarray:
        """Returns the half-widths inside the ball, or those that are set, shape (n,)."""
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
        if self.half_widths is None:
            return ""
        bound, corner = _declared(plant), np.asarray(self.half_widths)
        if bound is None:
            length = float(np.sum(np.square(corner)))
            if length > plant.gamma * (1.0 + ROUNDING):
                return f"the corner of the box has squared length {length:g} > gamma = {plant.gamma:g}"
            return ""
        # Of sets with the coordinates as axes, all corners lie equally far out.
        size = sum_gauge(corner, plant.gamma * np.eye(plant.n), diagonal_inside(bound))
        if size > 1.0 + ROUNDING:
            return f"the box is {size:.6g} times as large as one in the ball of gamma plus disturbance_bound may be"
        return ""


@dataclass(frozen=True, eq=False)
class SinusoidDisturbance(Disturbance):
    """a sin(2 pi k / period + phase), with a random extreme disturbance a and phase each episode.

    a is a boundary point of the ball of squared radius gamma plus one of the plant's `disturbance_bound`.

    Attributes:
        period: In steps.

    Raises:
        ValueError: If the period is not positive.
    """

    period: float = 20.0

    vectorized: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", as_number(self.period, "period", low=0.0, low_open=True))

    def begin(self, rng, plant, size=None):  # noqa: D102
        axes = np.sqrt(plant.gamma) * Ellipsoid(np.eye(plant.n)).sample_boundary(rng, size)
        bound = _declared(plant)
        if bound is not None:
            axes = axes + bound.sample_boundary(rng, size)
        return np.concatenate([axes.T, rng.uniform(0.0, 2.0 * np.pi, (1,) if size is None else (1, size))])

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        axis, phase = memory[:-1], memory[-1]
        return axis * np.sin(2.0 * np.pi * step / self.period + phase)


def _declared(plant: LinearPlant) -> Ellipsoid | None:
    """Returns the plant's declared bound of disturbances; None if there is none or it is a point."""
    bound = plant.disturbance_bound
    return bound if bound is not None and np.any(bound.shape_matrix) else None
