"""Linear controllers and other policies that nobody has to train, for vector environments."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from importlib import resources

import numpy as np

from agents.evaluation import Policy
from experiments.baselines.margins import MARGINS
from ncs_gym import LinearPlant, NCSEnv, SetpointTracking, SpeedTracking
from ncs_gym.plants.lqr import lqr_gain

# Steps that a reference governor looks ahead.
GOVERNED_STEPS = 100
# What keeps the equations of a regulator well-posed where an input itself costs nothing.
_LEAST_WEIGHT = 1e-6


@dataclass(frozen=True)
class RegulatorWeights:
    """What a linear-quadratic regulator weighs against an error of the task of one width.

    Attributes:
        effort: An input at its limit; where the task prices changes of the input, a change by its limit.
        state: A state at the edge of the box.
    """

    effort: float = 0.01
    state: float = 0.01


def tuned_weights(env_id: str, arm: str) -> RegulatorWeights:
    """Returns the weights tuned for an arm in an environment (benchmarks/tune_baselines.py); the defaults for others.

    Args:
        env_id: Id by which the environment is registered.
        arm: Name of the arm: the regulator's, and that of the filter that it acts behind.
    """
    return RegulatorWeights(**_tuned().get(env_id, {}).get(arm, {}))


@cache
def _tuned() -> dict[str, dict[str, dict[str, float]]]:
    """Returns the file of weights: by environment id and arm."""
    return json.loads(resources.files("experiments.baselines").joinpath("tuned.json").read_text("utf-8"))


def controller(
    name: str, env: NCSEnv, K: np.ndarray, seed: int, weights: RegulatorWeights = RegulatorWeights()
) -> Policy:
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


def _regulator(env: NCSEnv, weights: RegulatorWeights) -> _Inputs:
    """Returns the linear-quadratic regulator of the task's error, with set-points and what is known of them ahead.

    Its cost weighs the error in the task's width, states in units of the box and inputs in units of their limits. The
    speed error of `SpeedTracking`, e+ = e - dt u, is a state of its own; so are the targets of `SetpointTracking` that
    are known, of which the last is taken to stay, and the last input where its
    changes have a price.
    """
    plant, task = env.plant, env.task
    states = weights.state * plant.box_rows.T @ plant.box_rows
    effort = np.diag((weights.effort + _LEAST_WEIGHT) / plant.u_max**2)
    if isinstance(task, SpeedTracking):
        A = np.pad(plant.A, (0, 1))
        A[-1, -1] = 1.0
        B = np.vstack([plant.B, -plant.dt * np.eye(plant.m)[task.input_index]])
        Q = np.pad(states, (0, 1))
        Q[-1, -1] = 1.0 / 25.0  # the reward counts errors in units of 5 m/s
        gain = _optimal_gain(A, B, Q, effort)
        return lambda observations, estimates: np.hstack([estimates, observations[:, -1:]]) @ gain.T
    if isinstance(task, SetpointTracking):
        gain = _tracking_gain(plant, task, weights)
        return lambda observations, estimates: _with_targets(plant, observations, estimates) @ gain.T
    gain = _optimal_gain(plant.A, plant.B, states, effort)
    return lambda observations, estimates: estimates @ gain.T


def _tracking_gain(plant: LinearPlant, task: SetpointTracking, weights: RegulatorWeights) -> np.ndarray:
    """Returns the gain of the regulator for x, the targets of now and later, and the last input if it is observed.

    It minimizes the sum of (c x - r)^2 / width^2 + state |x - x_s r|^2 + effort |u - v|^2, where (x_s, u_s) is the
    equilibrium of target 1, norms are in units of box and limits, and v is the last input where the task prices
    changes, u_s r elsewhere.
    """
    n, m, targets = plant.n, plant.m, 1 + task.preview
    x_s, u_s = equilibrium(plant, task.output)
    size = n + targets + (m if task.change_price else 0)
    A, B = np.zeros((size, size)), np.zeros((size, m))
    A[:n, :n], B[:n] = plant.A, plant.B
    A[n : n + targets, n : n + targets] = np.eye(targets, k=1)
    A[n + targets - 1, n + targets - 1] = 1.0 - _LEAST_WEIGHT
    B[n + targets :] = np.eye(m) if task.change_price else 0.0

    def rows(of_state: np.ndarray, of_target: np.ndarray) -> np.ndarray:
        return np.hstack([of_state, -of_target[:, None], np.zeros((len(of_state), size - n - 1))])

    held = rows(np.zeros((m, n)), -u_s) / plant.u_max[:, None]  # u_s r
    last = np.eye(size)[n + targets :] / plant.u_max[:, None] if task.change_price else held
    error = rows(task.output[None], np.ones(1)) / task.width
    box = np.sqrt(weights.state) * rows(plant.box_rows, plant.box_rows @ x_s)
    wanted = np.concatenate([np.sqrt(weights.effort) * last, np.sqrt(_LEAST_WEIGHT) * held])
    given = np.vstack([np.sqrt(each) * np.diag(1.0 / plant.u_max) for each in (weights.effort, _LEAST_WEIGHT)])
    Q = error.T @ error + box.T @ box + wanted.T @ wanted
    return _optimal_gain(A, B, Q, given.T @ given, -wanted.T @ given)


def _with_targets(plant: LinearPlant, observations: np.ndarray, estimates: np.ndarray) -> np.ndarray:
    """Returns estimates and what the observations hold beyond them: targets and the last input, shape (N, entries)."""
    return np.hstack([estimates, observations[:, plant.n :].astype(np.float64)])


def _governed(env: NCSEnv, weights: RegulatorWeights, margin: float = 0.0) -> _Inputs:
    """Returns the regulator with its targets clipped by a reference governor.

    Targets are moved as little as possible so that the regulator's own loop, from the estimate taken for the state and
    without disturbance, with a constant target keeps the limits of box and inputs less a margin for the next
    `GOVERNED_STEPS` steps. Where no target does, the middle of what the limits ask for is used (Garone et al. 2017,
    docs/bibliography.md).

    Args:
        env: The environment; tasks other than `SetpointTracking` are not governed.
        weights: Weights of the regulator.
        margin: Fraction of the box that is kept free.
    """
    plant, task = env.plant, env.task
    if not isinstance(task, SetpointTracking):
        return _regulator(env, weights)
    n, known = plant.n, slice(plant.n, plant.n + 1 + task.preview)
    gain = _tracking_gain(plant, task, weights)
    own = np.delete(gain, np.arange(gain.shape[1])[known], axis=1)  # of x and the last input
    of_target = gain[:, known].sum(axis=1, keepdims=True)
    moved = np.eye(own.shape[1], own.shape[1])
    moved[n:] = 0.0
    moved[:n, :n] = plant.A
    pushed = np.vstack([plant.B, np.eye(plant.m)[: own.shape[1] - n]])
    loop, drive = moved + pushed @ own, pushed @ of_target
    limits = np.vstack([np.pad(plant.box_rows, ((0, 0), (0, own.shape[1] - n))), own / plant.u_max[:, None]])
    direct = np.concatenate([np.zeros((len(plant.box_rows), 1)), of_target / plant.u_max[:, None]])
    allowed = np.concatenate([np.full(len(plant.box_rows), 1.0 - margin), np.ones(plant.m)])
    rows, slopes = [limits[len(plant.box_rows) :]], [direct[len(plant.box_rows) :]]
    power, response = loop, drive
    for _ in range(GOVERNED_STEPS):
        rows.append(limits @ power)
        slopes.append(limits @ response + direct)
        power, response = loop @ power, loop @ response + drive
    free, slope = np.vstack(rows), np.vstack(slopes)[:, 0]
    bound = np.concatenate([np.ones(plant.m), np.tile(allowed, GOVERNED_STEPS)])
    felt = np.abs(slope) > _LEAST_WEIGHT * np.abs(slope).max()
    free, slope, bound = free[felt], slope[felt], bound[felt]

    def inputs(observations: np.ndarray, estimates: np.ndarray) -> np.ndarray:
        entries = _with_targets(plant, observations, estimates)
        middle = -np.delete(entries, np.arange(entries.shape[1])[known], axis=1) @ free.T / slope
        low, high = ((middle + side * bound / np.abs(slope)) for side in (-1.0, 1.0))
        low, high = low.max(axis=1, keepdims=True), high.min(axis=1, keepdims=True)
        center = 0.5 * (low + high)
        entries[:, known] = np.clip(entries[:, known], np.minimum(low, center), np.maximum(high, center))
        return entries @ gain.T

    return inputs


def _about_target(env: NCSEnv, gain: np.ndarray) -> _Inputs:
    """Returns u = u_s + gain (x_hat - x_s) with (x_s, u_s) the smallest equilibrium at the task's target."""
    task, first = env.task, env.plant.n
    if not isinstance(task, SetpointTracking):
        return lambda observations, estimates: estimates @ gain.T
    x_s, u_s = equilibrium(env.plant, task.output)

    def inputs(observations: np.ndarray, estimates: np.ndarray) -> np.ndarray:
        target = observations[:, first : first + 1].astype(np.float64)
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


def _optimal_gain(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, N: np.ndarray | None = None
) -> np.ndarray:
    """Returns the gain of `lqr_gain`.

    Raises:
        ValueError: If there is none.
    """
    if (gain := lqr_gain(A, B, Q, R, N)) is None:
        raise ValueError("there is no linear-quadratic regulator: the inputs cannot stabilize the plant")
    return gain


# Those whose weights are tuned, made from an environment and weights.
REGULATORS: dict[str, Callable[[NCSEnv, RegulatorWeights], _Inputs]] = {"lqr": _regulator, "governor": _governed}
REGULATORS |= {f"governor:{margin}": partial(_governed, margin=margin / 100.0) for margin in MARGINS}

CONTROLLERS: dict[str, Callable[[NCSEnv, np.ndarray, int], _Inputs]] = {
    "zero input": _zero,
    "K x_hat": _certified_gain,
    "random": _random,
    "proportional": _proportional,
}
"""The policies by name, made from an environment, the certified gain and a seed."""
