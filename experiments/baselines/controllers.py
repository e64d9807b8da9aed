"""Linear controllers and other policies that nobody has to train, for vector environments."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from agents.evaluation import Policy
from experiments.baselines.margins import MARGINS
from experiments.baselines.regulators import (
    DEFAULT_WEIGHTS,
    Inputs,
    RegulatorWeights,
    equilibrium,
    governor,
    model_predictive,
    regulator,
)
from ncs_gym import NCSEnv, SetpointTracking, SpeedTracking


def controller(name: str, env: NCSEnv, K: np.ndarray, seed: int, weights: RegulatorWeights = DEFAULT_WEIGHTS) -> Policy:
    """Returns a policy for vector environments of a kind.

    Args:
        name: A name in `CONTROLLERS` or `REGULATORS`.
        env: A single environment with the plant and the task.
        K: Certified gain, shape (m, n), of u = K x_hat.
        seed: Seed of the random policy.
        weights: Weights of the regulators.
    """
    make = REGULATORS.get(name)
    inputs = CONTROLLERS[name](env, K, seed) if make is None else make(env, weights)
    limits = env.plant.u_max
    return lambda observations, infos: np.clip(inputs(observations, infos["estimate"]) / limits, -1.0, 1.0)


def _zero(env: NCSEnv, K: np.ndarray, seed: int) -> Inputs:
    """Returns no input at all."""
    return lambda observations, estimates: np.zeros((len(estimates), env.plant.m))


def _random(env: NCSEnv, K: np.ndarray, seed: int) -> Inputs:
    """Returns uniformly random inputs within the limits."""
    rng, limits = np.random.default_rng(seed), env.plant.u_max
    return lambda observations, estimates: rng.uniform(-limits, limits, (len(estimates), len(limits)))


def _certified_gain(env: NCSEnv, K: np.ndarray, seed: int) -> Inputs:
    """Returns u = K x_hat, which ignores the task."""
    return lambda observations, estimates: estimates @ K.T


def _greedy(env: NCSEnv, K: np.ndarray, seed: int) -> Inputs:
    """Returns inputs that come closest to the task's goal in one step, and ignore the safe box.

    For `SpeedTracking` they remove the error of the speed, for `SetpointTracking` that of the output, with as little
    input as possible or with the largest input; for other tasks they are the least-squares solution of C x+ = 0.
    """
    plant, task, first = env.plant, env.task, env.plant.n
    moved = np.zeros(first)
    if isinstance(task, SpeedTracking):
        effect = plant.dt * np.eye(plant.m)[task.input_index]
    elif isinstance(task, SetpointTracking):
        effect, moved = task.output @ plant.B, task.output @ plant.A
    else:
        gain = np.linalg.lstsq(plant.box_rows @ plant.B, -plant.box_rows @ plant.A)[0]
        return lambda observations, estimates: estimates @ gain.T
    largest = float(np.abs(effect) @ plant.u_max)

    def inputs(observations: np.ndarray, estimates: np.ndarray) -> np.ndarray:
        missing = observations[:, first].astype(np.float64) - estimates @ moved
        fractions = np.minimum(1.0, np.abs(missing) / largest) if largest > 0.0 else np.zeros(len(missing))
        return fractions[:, None] * np.sign(missing[:, None] * effect) * plant.u_max

    return inputs


def _proportional(env: NCSEnv, K: np.ndarray, seed: int) -> Inputs:
    """Returns inputs in proportion to the error of the task.

    For `SpeedTracking` u = (target - speed) / dt, which within the limits removes the error in a step; for
    `SetpointTracking` the certified gain about the equilibrium at the target, u = u_s + K (x_hat - x_s); for other
    tasks, whose target is rest, u = K x_hat.
    """
    if isinstance(env.task, SpeedTracking):
        direction = np.eye(env.plant.m)[env.task.input_index] / env.plant.dt
        return lambda observations, estimates: observations[:, -1:] * direction
    return _about_target(env, K)


def _about_target(env: NCSEnv, gain: np.ndarray) -> Inputs:
    """Returns u = u_s + gain (x_hat - x_s) with (x_s, u_s) the smallest equilibrium at the task's target."""
    task, first = env.task, env.plant.n
    if not isinstance(task, SetpointTracking):
        return lambda observations, estimates: estimates @ gain.T
    x_s, u_s = equilibrium(env.plant, task.output)

    def inputs(observations: np.ndarray, estimates: np.ndarray) -> np.ndarray:
        target = observations[:, first : first + 1].astype(np.float64)
        return target * u_s + (estimates - target * x_s) @ gain.T

    return inputs


# Those whose weights are tuned, made from an environment and weights.
REGULATORS: dict[str, Callable[[NCSEnv, RegulatorWeights], Inputs]] = {"lqr": regulator}
for _name, _make in {"governor": governor, "mpc": model_predictive}.items():
    REGULATORS |= {_name: _make} | {f"{_name}:{each}": partial(_make, margin=each / 100.0) for each in MARGINS}

CONTROLLERS: dict[str, Callable[[NCSEnv, np.ndarray, int], Inputs]] = {
    "zero input": _zero,
    "K x_hat": _certified_gain,
    "random": _random,
    "greedy": _greedy,
    "proportional": _proportional,
}
"""The policies by name, made from an environment, the certified gain and a seed."""
