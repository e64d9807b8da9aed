"""Disturbances within {d : d'd <= gamma}: uniform in the ball or in a box, and a sinusoid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.disturbance import ROUNDING, Disturbance
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.validation import as_number, as_vector


@dataclass(frozen=True, eq=False)
class BallDisturbance(Disturbance):
    """Uniform in the ball of squared radius gamma."""

    vectorized: ClassVar[bool] = True
    memoryless: ClassVar[bool] = True

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        if plant.gamma == 0.0:
            return np.zeros(nominal_next.shape)
        count = None if nominal_next.ndim == 1 else nominal_next.shape[1]
        return np.sqrt(plant.gamma) * Ellipsoid(np.eye(plant.n)).sample(rng, count).T


@dataclass(frozen=True, eq=False)
class BoxDisturbance(Disturbance):
    """Uniform in a box (Liu et al. Section 5).

    Attributes:
        half_widths: Shape (n,); the box must lie in {d'd <= gamma}. None: sqrt(gamma / n) each.

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
        return (rng.uniform(-1.0, 1.0, nominal_next.shape).T * self.widths(plant)).T

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

    vectorized: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", as_number(self.period, "period", low=0.0, low_open=True))

    def begin(self, rng, plant, size=None):  # noqa: D102
        axes = Ellipsoid(np.eye(plant.n)).sample_boundary(rng, size)
        return np.concatenate([axes.T, rng.uniform(0.0, 2.0 * np.pi, (1,) if size is None else (1, size))])

    def draw(self, rng, plant, nominal_next, step, memory):  # noqa: D102
        axis, phase = memory[:-1], memory[-1]
        return np.sqrt(plant.gamma) * axis * np.sin(2.0 * np.pi * step / self.period + phase)
