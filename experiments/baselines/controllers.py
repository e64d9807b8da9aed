"""Linear controllers and other policies that nobody has to train, for vector environments."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from agents.evaluation import Policy
from ncs_gym import LinearPlant, NCSEnv, SetpointTracking, SpeedTracking
from ncs_gym.plants.lqr import lqr_gain

# Weights of the regulator: an input at its limit, and a state at the edge of the box, against an error of one width.
INPUT_WEIGHT, BOX_WEIGHT = 0.01, 0.01


def controller(name: str, env: NCSEnv, K: np.ndarray, seed: int) -> Policy:
    """Returns a policy for vector environments of a kind.

    Args:
        name: A name in `CONTROLLERS`.
        env: A single environment with the plant and the task.
        K: Certified gain, shape (m, n), of u = K x_hat.
        seed: Seed of the random policy.
    """
    inputs = CONTROLLERS[name](env, K, seed)
    limits = env.plant.u_max
    return lambda observations, infos: np.clip(inputs(observations, infos["estimate"]) / limits, -1.0, 1.0)


# Maps observations (N, entries) and estimates (N, n) to inputs (N, m) [physical units], not yet clipped.
_Inputs = Callable[[np.ndarray, np.ndarray], np.ndarray]


def _zero(env: NCSEnv, K: np.ndarray, seed: int) -> _Inputs:
    """Returns no input at all."""
    return lambda observations, estimates: np.zeros((len(estimates), env.plant.m))


def _random(env: NCSEnv, K: np.ndarray, seed: int) -> _Inputs:
    """Returns uniformly random inputs within the limits."""
    rng, limits = np.random.default_rng(seed), env.plant.u_max
    return lambda observations, estimates: rng.uniform(-limits, limits, (len(estimates), len(limits)))


def _certified_gain(env: NCSEnv, K: np.ndarray, seed: int) -> _Inputs:
    """Returns u = K x_hat, which ignores the task."""
    return lambda observations, estimates: estimates @ K.T


def _proportional(env: NCSEnv, K: np.ndarray, seed: int) -> _Inputs:
    """Returns inputs in proportion to the error of the task.

    For `SpeedTracking` u = (target - speed) / dt, which within the limits removes the error in a step; for
    `SetpointTracking` the certified gain about the equilibrium at the target, u = u_s + K (x_hat - x_s); for other
    tasks, whose target is rest, u = K x_hat.
    """
    if isinstance(env.task, SpeedTracking):
        direction = np.eye(env.plant.m)[env.task.input_index] / env.plant.dt
        return lambda observations, estimates: observations[:, -1:] * direction
    return _about_target(env, K)


def _regulator(env: NCSEnv, K: np.ndarray, seed: int) -> _Inputs:
    """Returns the linear-quadratic regulator of the task's error, with set-point.

    Its cost weighs the error in the task's width, states in units of the box and inputs in units of their limits. The
    speed error of `SpeedTracking`, e+ = e - dt u, is a state of its own.
    """
    plant, task = env.plant, env.task
    states, effort = BOX_WEIGHT * plant.box_rows.T @ plant.box_rows, np.diag(INPUT_WEIGHT / plant.u_max**2)
    if isinstance(task, SpeedTracking):
        A = np.pad(plant.A, (0, 1))
        A[-1, -1] = 1.0
        B = np.vstack([plant.B, -plant.dt * np.eye(plant.m)[task.input_index]])
        Q = np.pad(states, (0, 1))
        Q[-1, -1] = 1.0 / 25.0  # the reward counts errors in units of 5 m/s
        gain = _optimal_gain(A, B, Q, effort)
        return lambda observations, estimates: np.hstack([estimates, observations[:, -1:]]) @ gain.T
    if isinstance(task, SetpointTracking):
        states = states + np.outer(task.output, task.output) / task.width**2
    return _about_target(env, _optimal_gain(plant.A, plant.B, states, effort))


def _about_target(env: NCSEnv, gain: np.ndarray) -> _Inputs:
    """Returns u = u_s + gain (x_hat - x_s) with (x_s, u_s) the smallest equilibrium at the task's target."""
    task = env.task
    if not isinstance(task, SetpointTracking):
        return lambda observations, estimates: estimates @ gain.T
    x_s, u_s = equilibrium(env.plant, task.output)

    def inputs(observations: np.ndarray, estimates: np.ndarray) -> np.ndarray:
        target = observations[:, -1:].astype(np.float64)
        return target * u_s + (estimates - target * x_s) @ gain.T

    return inputs


def equilibrium(plant: LinearPlant, output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns state (n,) and input (m,) with x = A x + B u and c x = 1, the smallest in units of box and limits.

    Where there is none, the least-squares solution.

    Args:
        plant: The plant.
        output: c, shape (n,).
    """
    n, scale = plant.n, np.concatenate([plant.half_widths, plant.u_max])
    rest = np.hstack([np.eye(n) - plant.A, -plant.B]) / plant.half_widths[:, None]
    equations = np.vstack([rest, np.concatenate([output, np.zeros(plant.m)])])
    both = scale * np.linalg.lstsq(equations * scale, np.eye(n + 1)[-1])[0]
    return both[:n], both[n:]


def _optimal_gain(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Returns the gain of `lqr_gain`.

    Raises:
        ValueError: If there is none.
    """
    if (gain := lqr_gain(A, B, Q, R)) is None:
        raise ValueError("there is no linear-quadratic regulator: the inputs cannot stabilize the plant")
    return gain


CONTROLLERS: dict[str, Callable[[NCSEnv, np.ndarray, int], _Inputs]] = {
    "zero input": _zero,
    "K x_hat": _certified_gain,
    "random": _random,
    "proportional": _proportional,
    "lqr": _regulator,
}
"""The policies by name, made from an environment, the certified gain and a seed."""
