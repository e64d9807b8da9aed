"""Gymnasium's `Pendulum-v1` near upright: the process, and its linear model with a proved remainder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from flint import arb

from ncs_gym import exact
from ncs_gym.bounds import Bounds, Through
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.plants.family import Remainder
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.processes.gym_process import GymProcess
from ncs_gym.processes.process import Process
from ncs_gym.validation import ReadOnlyArrays, as_number

# What `Pendulum-v1` has: gravity [m/s^2], mass [kg], length [m], step [s], largest torque [N m] and rate [rad/s].
GRAVITY, MASS, LENGTH, STEP, TORQUE, FASTEST = 10.0, 1.0, 1.0, 0.05, 2.0, 8.0
# Safe box around upright: angle [rad] and angular rate [rad/s].
ANGLE, RATE = 0.25, 1.5
# Relative room for the rounding of the environment's own arithmetic in float64, and for what it rounds to float32: the
# torque, 3 / (m l^2), and the product of both (a float32 scalar times a Python number is a float32).
ROUNDING, TORQUE_ROUNDING = 1e-9, 3.0 * 2.0**-24
# At least this much of the fastest rate: the sums of a step are rounded in float64.
STEP_ROUNDING = 1e-14


@dataclass(frozen=True, kw_only=True)
class PendulumProcess(ReadOnlyArrays, Process):
    """Gymnasium's `Pendulum-v1`, x = (angle from upright [rad], angular rate [rad/s]), u the torque [N m].

    Attributes:
        gravity: [m/s^2].
        mass: [kg].
        length: [m].

    Raises:
        ValueError: If one is not positive.
    """

    gravity: float = GRAVITY
    mass: float = MASS
    length: float = LENGTH

    def __post_init__(self) -> None:
        self._check(as_number, "gravity", "mass", "length", low=0.0, low_open=True)

    def opened(self, plant: LinearPlant, size: int | None) -> Process:
        """Returns the opened environments."""
        return GymProcess(self._make, read_state=_read, write_state=_write).opened(plant, size)

    def _make(self) -> gym.Env:
        env: Any = gym.make("Pendulum-v1", g=self.gravity, disable_env_checker=True).unwrapped
        env.m, env.l = self.mass, self.length
        return env


def _read(env: Any) -> np.ndarray:
    return env.state


def _write(env: Any, state: np.ndarray) -> None:
    env.state = state


def pendulum(gravity: float = GRAVITY, mass: float = MASS, length: float = LENGTH) -> LinearPlant:
    """Returns the linear model of `Pendulum-v1` for |angle| <= 0.25 rad and |rate| <= 1.5 rad/s, |u| <= 2 N m.

    The environment computes rate+ = rate + dt (a sin(angle) + b u) and angle+ = angle + dt rate+ with a = 3 g / (2 l)
    and b = 3 / (m l^2). For |angle| <= c the ratio sin(angle) / angle lies between s = sin(c) / c and 1; with its
    middle (1 + s) / 2 as the slope, what is left out of rate+ is at most dt a c (1 - s) / 2, and dt times that of
    angle+: a multiple of (dt, 1). That is proved; what the environment rounds to float32 is added.

    Args:
        gravity: [m/s^2].
        mass: [kg].
        length: [m].

    Raises:
        ValueError: If the environment would clip a rate.
    """
    pull, gain = 3.0 * gravity / (2.0 * length), 3.0 / (mass * (length * length))
    (sine,) = exact.nearest(lambda: [arb(ANGLE).sin()])
    ratio = sine / ANGLE
    fastest = RATE + STEP * (pull * sine + gain * TORQUE)
    if not fastest < FASTEST:
        raise ValueError(
            f"a step from the box reaches {fastest:.3g} rad/s, which Pendulum-v1 clips to {FASTEST:g}: no linear model "
            "with the proved remainder; use a larger mass or length, or ncs_gym.linear_model"
        )
    slope = STEP * pull * 0.5 * (1.0 + ratio)
    left_out = STEP * (pull * ANGLE * 0.5 * (1.0 - ratio) + gain * TORQUE * TORQUE_ROUNDING)
    left_out = max(left_out * (1.0 + ROUNDING), left_out + STEP_ROUNDING * fastest)
    direction = np.array([[STEP], [1.0]])
    basis = f"sin(angle) / angle lies between {ratio:.6f} and 1 for angles up to {ANGLE} rad"
    remainder = Remainder(Through(direction, left_out).ellipsoid(), True, basis)
    A = np.array([[1.0, STEP], [0.0, 1.0]]) + slope * np.outer(direction, [1.0, 0.0])
    return LinearPlant(
        Model(A, STEP * gain * direction, None, STEP),
        Limits(state=[ANGLE, RATE], input=TORQUE),
        Bounds(disturbance=remainder, sensor=[0.002, 0.01], first_error=[0.005, 0.03]),
        {"states": {"angle": "rad", "angular rate": "rad/s"}, "inputs": {"torque": "N m"}},
    )
