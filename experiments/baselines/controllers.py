"""Controllers that nobody has to train, for vector environments: linear ones, regulators, and no or random inputs.

The regulators are linear-quadratic and model predictive. Both minimize the same cost of the task's error, whose
weights are tuned for each by itself; those with an observer are free of offset under a disturbance that stays. Where
the box counts between samples, it does for predictions, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import clarabel
import numpy as np
from scipy.linalg import block_diag, solve_discrete_are, sqrtm
from scipy.sparse import csc_matrix

from agents.evaluation import Policy
from experiments.baselines.filters import MARGINS
from experiments.baselines.observer import DisturbanceObserver
from ncs_gym import LinearPlant, NCSEnv, Regulation, SetpointTracking, SpeedTracking, Task
from ncs_gym.plants.lqr import lqr_gain
from shields.certificate import Fallback
from shields.runtime.set_test import closed

# Its types are not declared.
_clarabel: Any = clarabel
# Steps that a model predictive controller looks ahead.
PREDICTED_STEPS = 20
# What keeps the equations of a regulator well-posed where an input itself costs nothing.
_LEAST_WEIGHT = 1e-6
# Price of leaving the limits of the box by their half-widths: a program without any solution serves nobody.
_PRICE_OF_LEAVING = 1e4

# Maps observations (N, entries), estimates (N, n) and estimated disturbances (N, n) to inputs (N, m) [physical units],
# not yet clipped.
Inputs = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class RegulatorWeights:
    """What a regulator weighs against an error of the task of one width."""

    effort: float = 0.01  # an input at its limit; where the task prices changes of the input, a change by its limit
    state: float = 0.01  # a state at the edge of the box
    disturbance: float = 0.2  # alpha of `DisturbanceObserver`


DEFAULT_WEIGHTS = RegulatorWeights()


@dataclass(frozen=True)
class RegulatorProblem:
    """The sum of |E z + D u|^2 along z+ = A z + B u, where z is the state and what else of the observation counts.

    Under a disturbance d that stays, z and u count from (z_s, u_s) = rest d, where the tracked output is 0.
    """

    A: np.ndarray  # (entries, entries)
    B: np.ndarray  # (entries, m)
    E: np.ndarray  # (costs, entries)
    D: np.ndarray  # (costs, m)
    rest: np.ndarray  # (entries + m, n)

    def shifted(
        self, observations: np.ndarray, estimates: np.ndarray, disturbances: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns z less its rest, the rest, (N, entries) both, and that of u, (N, m)."""
        beyond = observations[:, estimates.shape[1] : len(self.A)]
        z_s, u_s = np.split(disturbances @ self.rest.T, [len(self.A)], axis=1)
        return np.hstack([estimates, beyond.astype(np.float64)]) - z_s, z_s, u_s

    def gain(self) -> np.ndarray:
        """Returns the gain of the optimal u = gain z, shape (m, entries); raises ValueError if there is none."""
        if (gain := lqr_gain(self.A, self.B, self.E.T @ self.E, self.D.T @ self.D, self.E.T @ self.D)) is None:
            raise ValueError("there is no linear-quadratic regulator: the inputs cannot stabilize the plant")
        return gain


def regulator_problem(env: NCSEnv, weights: RegulatorWeights) -> RegulatorProblem:
    """Returns what a regulator of an environment's task minimizes.

    The error is in units of the task's width, states of the box and inputs of their limits. The speed error of
    `SpeedTracking`, e+ = e - dt u, is a state of its own. For `Regulation` it is what the reward counts.
    """
    plant, task = env.plant, env.task
    if isinstance(task, SetpointTracking):
        return _tracking_problem(plant, task, weights)
    if isinstance(task, Regulation):
        return _regulation_problem(plant, task)
    states, effort = np.sqrt(weights.state) * plant.box, np.sqrt(weights.effort + _LEAST_WEIGHT)
    A, B, E = plant.A, plant.B, states
    if isinstance(task, SpeedTracking):
        A = np.pad(A, (0, 1))
        A[-1, -1] = 1.0
        B = np.vstack([B, -plant.dt * np.eye(plant.m)[task.input_index]])
        E = np.pad(E, (0, 1))
        E[-1, -1] = 1.0 / 5.0  # the reward counts errors in units of 5 m/s
    D = np.vstack([np.zeros((len(E), plant.m)), effort * np.diag(1.0 / plant.input_half)])
    E = np.vstack([E, np.zeros((plant.m, len(A)))])
    return RegulatorProblem(A, B, E, D, _rests(plant, np.zeros(plant.n), A, B)[:, :-1])


def _regulation_problem(plant: LinearPlant, task: Regulation) -> RegulatorProblem:
    """Returns the problem of x'Q x + u'R u of the task, with as little more as keeps it well-posed."""
    costs, units = task.costs(plant), (plant.half_widths, plant.input_half)
    least = _LEAST_WEIGHT * max((np.diag(cost) * unit**2).max() for cost, unit in zip(costs, units, strict=True))
    states, inputs = (
        np.linalg.cholesky(cost + np.diag(least / unit**2)).T for cost, unit in zip(costs, units, strict=True)
    )
    E = np.vstack([states, np.zeros((plant.m, plant.n))])
    D = np.vstack([np.zeros((plant.n, plant.m)), inputs])
    return RegulatorProblem(plant.A, plant.B, E, D, _rests(plant, np.zeros(plant.n), plant.A, plant.B)[:, :-1])


def _tracking_problem(plant: LinearPlant, task: SetpointTracking, weights: RegulatorWeights) -> RegulatorProblem:
    """Returns the problem of x, the targets of now and later, and the last input if it is observed.

    It counts (c x - r)^2 / width^2 + state |x - x_s r|^2 + effort |u - v|^2, where (x_s, u_s) is the equilibrium of
    target 1, norms are in units of box and limits, and v is the last input where the task prices changes, u_s r
    elsewhere. Of the targets that are known, the last is taken to stay.
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

    held = rows(np.zeros((m, n)), -u_s) / plant.input_half[:, None]  # u_s r
    last = np.eye(size)[n + targets :] / plant.input_half[:, None] if task.change_price else held
    error = rows(task.output[None], np.ones(1)) / task.width
    box = np.sqrt(weights.state) * rows(plant.box, plant.box @ x_s)
    wanted = np.vstack([np.sqrt(weights.effort) * last, np.sqrt(_LEAST_WEIGHT) * held])
    given = np.vstack([np.sqrt(each) * np.diag(1.0 / plant.input_half) for each in (weights.effort, _LEAST_WEIGHT)])
    free = np.zeros((1 + len(box), m))
    rest = _rests(plant, task.output, A, B)[:, :-1]
    return RegulatorProblem(A, B, np.vstack([error, box, -wanted]), np.vstack([free, given]), rest)


def regulator(env: NCSEnv, weights: RegulatorWeights) -> Inputs:
    """Returns the linear-quadratic regulator of the task's error."""
    problem = regulator_problem(env, weights)
    gain = problem.gain()

    def inputs(observations: np.ndarray, estimates: np.ndarray, disturbances: np.ndarray) -> np.ndarray:
        entries, _, u_s = problem.shifted(observations, estimates, disturbances)
        return entries @ gain.T + u_s

    return inputs


def model_predictive(env: NCSEnv, weights: RegulatorWeights, margin: float = 0.0) -> Inputs:
    """Returns model predictive control from the estimate, taken for the state, as it is usually built.

    It minimizes the regulator's cost over `PREDICTED_STEPS` steps, with the regulator's cost-to-go at their end, within
    the limits of the inputs and those of the box less a margin, a fraction of it, which may be left at a high price.
    (Rawlings, Mayne and Diehl: "Model Predictive Control: Theory, Computation, and Design", 2017.)
    """
    plant, problem, steps = env.plant, regulator_problem(env, weights), PREDICTED_STEPS
    A, B, E, D, m = problem.A, problem.B, problem.E, problem.D, plant.m
    to_go = np.real(sqrtm(solve_discrete_are(A, B, E.T @ E, D.T @ D, s=E.T @ D)))
    beyond, (of_state, pushed) = ((0, 0), (0, len(A) - plant.n)), np.hsplit(plant.step_rows, [plant.n])
    rows, between = np.pad(plant.box, beyond), np.pad(of_state, beyond)
    low, high = closed(*np.hstack([plant.step_ends, plant.kept_ends]))
    low, high = np.tile(low + margin, steps), np.tile(high - margin, steps)
    every_row = np.block([[between, pushed], [rows, np.zeros((len(rows), m))]])
    least, most = (np.tile(ends, steps) for ends in plant.input_ends)
    free, forced, costs, limits = np.eye(len(A)), np.zeros((len(A), steps * m)), [], []
    for k in range(steps):  # z_k = free z_0 + forced u
        now = np.eye(steps * m)[k * m : (k + 1) * m]
        costs.append((E @ free, E @ forced + D @ now))
        limits.append((between @ free, between @ forced + pushed @ now))
        free, forced = A @ free, A @ forced + B @ now
        limits.append((rows @ free, rows @ forced))
    costs.append((to_go @ free, to_go @ forced))
    drift, effect = (np.concatenate(each) for each in zip(*costs, strict=True))
    moved, felt = (np.concatenate(each) for each in zip(*limits, strict=True))
    # Variables are the inputs, and by how much each step leaves the box.
    leaving, nothing = np.repeat(np.eye(steps), len(rows) + len(between), axis=0), np.zeros((steps * m, steps))
    P = csc_matrix(block_diag(2.0 * np.triu(effect.T @ effect), np.zeros((steps, steps))))
    every = np.eye(steps * m)
    inequalities = csc_matrix(
        np.block(
            [[felt, -leaving], [-felt, -leaving], [every, nothing], [-every, nothing], [nothing.T, -np.eye(steps)]]
        )
    )
    settings = _clarabel.DefaultSettings()
    settings.verbose = settings.presolve_enable = False
    without_limits = -np.linalg.lstsq(effect, drift)[0]

    def solved(entries: np.ndarray, at_rest: np.ndarray, u_s: np.ndarray) -> np.ndarray:
        slope, place = effect.T @ (drift @ entries), moved @ entries + at_rest
        q = np.concatenate([2.0 * slope, np.full(steps, _PRICE_OF_LEAVING)])
        b = np.concatenate([high - place, place - low, most - u_s, u_s - least, np.zeros(steps)])
        cones = [_clarabel.NonnegativeConeT(len(b))]
        found = _clarabel.DefaultSolver(P, q, inequalities, b, cones, settings).solve()
        if found.status not in (_clarabel.SolverStatus.Solved, _clarabel.SolverStatus.AlmostSolved):
            raise RuntimeError(f"the predictive controller's program was not solved: {found.status}")
        return np.array(found.x[:m])

    def inputs(observations: np.ndarray, estimates: np.ndarray, disturbances: np.ndarray) -> np.ndarray:
        entries, z_s, u_s = problem.shifted(observations, estimates, disturbances)
        at_rest, inputs_at_rest = np.tile(np.hstack([z_s, u_s]) @ every_row.T, steps), np.tile(u_s, steps)
        plans = entries @ without_limits.T  # the minimum without limits is the minimum where it keeps them
        applied = plans + inputs_at_rest
        kept = ((least <= applied) & (applied <= most)).all(axis=1)
        places = entries @ moved.T + plans @ felt.T + at_rest
        kept &= ((low <= places) & (places <= high)).all(axis=1)
        for k in np.flatnonzero(~kept):
            plans[k, :m] = solved(entries[k], at_rest[k], inputs_at_rest[k])
        return plans[:, :m] + u_s

    return inputs


def equilibrium(plant: LinearPlant, output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns state (n,) and input (m,) with x = A x + B u and c x = 1 for an output c, the smallest ones.

    Where there are none, the least-squares solution; both in units of box and limits.
    """
    both = _rests(plant, output, plant.A, plant.B)[:, -1]
    return both[: plant.n], both[plant.n :]


def _rests(plant: LinearPlant, output: np.ndarray, A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Returns R, shape (entries + m, n + 1): R (d, r) is z above u with z = A z + B u + (d, 0) and c z = r."""
    n, others = plant.n, np.ones(len(A) - plant.n)
    half, scale = np.append(plant.half_widths, others), np.concatenate([plant.half_widths, others, plant.input_half])
    rest = np.hstack([np.eye(len(A)) - A, -B]) / half[:, None]
    equations = np.vstack([rest, np.pad(output, (0, len(others) + plant.m))])
    given = np.zeros((len(A) + 1, n + 1))
    given[:n, :n], given[-1, -1] = np.diag(1.0 / plant.half_widths), 1.0
    return scale[:, None] * np.linalg.lstsq(equations * scale, given)[0]


def _zero(env: NCSEnv, fallback: Fallback, seed: int) -> Inputs:
    return lambda observations, estimates, disturbances: np.zeros((len(estimates), env.plant.m))


def _random(env: NCSEnv, fallback: Fallback, seed: int) -> Inputs:
    rng, (low, high) = np.random.default_rng(seed), env.plant.input_ends
    return lambda observations, estimates, disturbances: rng.uniform(low, high, (len(estimates), len(low)))


def _fallback(env: NCSEnv, fallback: Fallback, seed: int) -> Inputs:
    return lambda observations, estimates, disturbances: estimates @ fallback.gain.T + fallback.constant


def _undisturbed(infos: Any) -> tuple[np.ndarray, np.ndarray]:
    return infos["estimate"], np.zeros(infos["estimate"].shape)


# Those whose weights are tuned, made from an environment and weights.
REGULATORS: dict[str, Callable[[NCSEnv, RegulatorWeights], Inputs]] = {"lqr": regulator, "mpc": model_predictive}
REGULATORS |= {f"mpc:{each}": partial(model_predictive, margin=each / 100.0) for each in MARGINS}
# Those that also know that a disturbance persists.
OBSERVER = ":observer"
REGULATORS |= {f"{each}{OBSERVER}": REGULATORS[each] for each in ("lqr", "mpc")}

CONTROLLERS: dict[str, Callable[[NCSEnv, Fallback, int], Inputs]] = {
    "zero input": _zero,
    "K x_hat": _fallback,
    "random": _random,
}
"""The policies by name, made from an environment, the certificate's fallback and a seed."""


# Tasks whose reward and observations controllers know.
_PURSUED = Regulation, SpeedTracking, SetpointTracking


def why_aimless(name: str, task: Task) -> str:
    """Returns why a controller cannot pursue what a task with its own reward asks for, an empty string if it can."""
    own = type(task).reward, type(task).observe
    if name not in REGULATORS or any(own == (each.reward, each.observe) for each in _PURSUED):
        return ""
    return (
        f"{name} does not know what a {type(task).__name__} asks for: it pursues Regulation, SpeedTracking and "
        "SetpointTracking"
    )


def controller(
    name: str, env: NCSEnv, fallback: Fallback, seed: int, weights: RegulatorWeights = DEFAULT_WEIGHTS
) -> Policy:
    """Returns a policy in `CONTROLLERS` or `REGULATORS` for vector environments like a single one.

    Raises:
        ValueError: If a regulator does not know what the task asks for.
    """
    if problem := why_aimless(name, env.task):
        raise ValueError(problem)
    make, plant = REGULATORS.get(name), env.plant
    inputs = CONTROLLERS[name](env, fallback, seed) if make is None else make(env, weights)
    observed = DisturbanceObserver(env, weights.disturbance).see if name.endswith(OBSERVER) else _undisturbed

    def actions(observations: np.ndarray, infos: Any) -> np.ndarray:
        u = inputs(observations, *observed(infos))
        return np.clip((u - plant.input_middle) / plant.input_half, -1.0, 1.0)

    return actions
