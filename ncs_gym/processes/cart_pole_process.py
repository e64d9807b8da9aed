"""The nonlinear cart-pole, whose linearization is `ncs_gym.cart_pole`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np

from ncs_gym.bounds import Bounds
from ncs_gym.limits import Limits
from ncs_gym.plants.library import GRAVITY, cart_pole
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.linearization import linear_model
from ncs_gym.processes.process import Process
from ncs_gym.validation import ReadOnlyArrays, as_number, shown

# Steps of the integrator in one control step: at 0.01 s its error is far below the rounding of an action.
SUBSTEPS = 2
# Bounds on a disturbance beside the remainder, on sensor noise and on the first error, as fractions of the half-widths.
NOISE = 1e-4
SAMPLES = 8_000


@dataclass(frozen=True, kw_only=True)
class CartPoleProcess(ReadOnlyArrays, Process):
    """A cart with a pole, a point mass on a light rod, without friction.

    With position p, angle a from upright and force u, M the cart's mass, m the pole's and l its length:
    p'' = (u + m sin(a) (l a'^2 - g cos(a))) / (M + m sin(a)^2) and a'' = (g sin(a) - cos(a) p'') / l; integrated by the
    classical Runge-Kutta method. x = (p, p', a, a').

    Attributes:
        cart_mass: M [kg].
        pole_mass: m [kg].
        length: l [m].

    Raises:
        ValueError: If one is not positive.
    """

    cart_mass: float = 1.0
    pole_mass: float = 0.1
    length: float = 0.5
    vectorized: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self._check(as_number, "cart_mass", "pole_mass", "length", low=0.0, low_open=True)

    def opened(self, plant: LinearPlant, size: int | None) -> Process:
        """Returns the process itself; raises ValueError unless the plant has four states and one input."""
        if (plant.n, plant.m) != (4, 1):
            raise ValueError(f"the cart-pole has 4 states and 1 input, the plant {plant.n} and {plant.m}")
        return self

    def step(self, plant: LinearPlant, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns the state a step of the plant later, shape (4,) or (4, N); raises ValueError if it is not finite."""
        h = plant.dt / SUBSTEPS
        for _ in range(SUBSTEPS):
            first = self._rate(state, u)
            second = self._rate(state + 0.5 * h * first, u)
            third = self._rate(state + 0.5 * h * second, u)
            fourth = self._rate(state + h * third, u)
            state = state + h / 6.0 * (first + 2.0 * (second + third) + fourth)
        if not np.isfinite(state).all():
            raise ValueError(f"the process must return a finite next state, got {shown(state.tolist())}")
        return state

    def _rate(self, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        _, speed, angle, rate = state
        sine, cosine = np.sin(angle), np.cos(angle)
        push = u[0] + self.pole_mass * sine * (self.length * rate**2 - GRAVITY * cosine)
        acceleration = push / (self.cart_mass + self.pole_mass * sine**2)
        return np.array([speed, acceleration, rate, (GRAVITY * sine - cosine * acceleration) / self.length])


@lru_cache(maxsize=1)
def nonlinear_cart_pole() -> LinearPlant:
    """Returns the linear model of `CartPoleProcess()` within the limits of `ncs_gym.cart_pole`, of assumed remainder.

    The numbers are those that `sampled_cart_pole` found once, so that they are the same on every machine.
    """
    return LinearPlant.load(Path(__file__).with_name("cart_pole_nonlinear.json"))


def sampled_cart_pole() -> LinearPlant:
    """Returns the same model, found anew."""
    tangent = cart_pole()
    noise = NOISE * tangent.half_widths
    limits = Limits(state=np.round(tangent.half_widths, 9), input=tangent.largest_input)
    return linear_model(
        CartPoleProcess(), limits, Bounds(noise, noise, noise), tangent.dt, labels=tangent.labels, samples=SAMPLES
    )
