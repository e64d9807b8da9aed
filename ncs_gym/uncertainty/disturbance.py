"""What acts on the plant inside the bound that the certificates assume: the base class, and the checks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import LARGEST_NUMBER, ReadOnlyArrays, as_setting, as_vector, shown

# Extreme points are pulled in, and points out by rounding pushed in, by this much.
ROUNDING = 1e-12
# A disturbance outside E(D) by no more than this is taken for rounding and scaled back onto it.
TOLERANCE = 1e-9


class Disturbance(ReadOnlyArrays, ABC):
    """A disturbance in the ball d'd <= gamma plus `disturbance_bound`; truncated process noise is added to it.

    `begin` draws what stays fixed for an episode, `draw` the disturbance of one step; neither stores anything in the
    settings, so that one object serves any number of environments. The class attributes below are never inherited: a
    subclass that overrides a method without declaring them anew is called for one environment at a time.

    Attributes:
        replaces_process_noise: Whether the whole of E(D) is used, process noise included. The environment checks what
            does not come from this package at every step.
        vectorized: Whether the methods also take arrays whose last axis is the environment.
        memoryless: Whether d depends on nothing but chance, so that many steps can be drawn at once; `draw` is then
            called with an array of the right shape, without state, step and memory.
    """

    replaces_process_noise: ClassVar[bool] = False
    vectorized: ClassVar[bool] = False
    memoryless: ClassVar[bool] = False

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Keeps a subclass from inheriting a promise about methods that it may override."""
        super().__init_subclass__(**keywords)
        for name in ("vectorized", "memoryless"):
            setattr(cls, name, vars(cls).get(name, False))

    def begin(self, rng: np.random.Generator, plant: LinearPlant, size: int | None = None) -> Any:
        """Returns what stays fixed for one episode (nothing unless overridden); last axis `size` if vectorized."""
        return np.zeros((0,) if size is None else (0, size))

    @abstractmethod
    def draw(
        self, rng: np.random.Generator, plant: LinearPlant, nominal_next: np.ndarray, step: Any, memory: Any
    ) -> np.ndarray:
        """Returns d, shape (n,); shape (n, N) if vectorized and called for N environments.

        Args:
            rng: Source of randomness.
            plant: The plant.
            nominal_next: A x + B u, shape (n,) or (n, N).
            step: Number of steps taken before this one, an int or shape (N,).
            memory: What `begin` returned.
        """

    def begin_many(self, rng: np.random.Generator, plant: LinearPlant, count: int) -> np.ndarray:
        """Returns the memories of `count` episodes along the last axis."""
        if self.vectorized:
            return self.begin(rng, plant, count)
        memories = np.empty(count, dtype=object)
        for episode in range(count):
            memories[episode] = self.begin(rng, plant)
        return memories

    def draw_many(
        self, rng: np.random.Generator, plant: LinearPlant, nominal_next: np.ndarray, steps: np.ndarray, memory: Any
    ) -> np.ndarray:
        """Returns d for N environments, shape (n, N), given A x + B u, shape (n, N), and steps, shape (N,)."""
        if self.vectorized:
            return self.draw(rng, plant, nominal_next, steps, memory)
        each = zip(nominal_next.T, steps.tolist(), memory, strict=True)
        drawn = np.array([self.draw(rng, plant, nominal, step, own) for nominal, step, own in each])
        return drawn.T

    def check(self, plant: LinearPlant) -> str:
        """Returns why this disturbance does not fit the plant, or an empty string."""
        return ""

    def excess(self, plant: LinearPlant) -> str:
        """Returns why it may go beyond the plant's bound (which can be allowed), or an empty string."""
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
    """Returns disturbances of many environments as `checked` does, shape (n, count).

    Raises:
        ValueError: If one is not finite, wrongly shaped, or further outside than TOLERANCE and that is not allowed.
    """
    given, d = d, as_setting(d)
    if d is None or d.shape != (plant.n, count) or not (np.abs(d) < LARGEST_NUMBER).all():
        raise ValueError(f"the disturbances must be finite with shape ({plant.n}, {count}), got {shown(given)}")
    if allow_assumption_violation:
        return d
    for each in np.flatnonzero(plant.allowed_disturbance.gauge(d.T) > 1.0 - ROUNDING):
        d[:, each] = checked(plant, d[:, each], allow_assumption_violation=False)
    return d
