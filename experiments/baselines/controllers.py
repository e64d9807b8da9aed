"""Controllers that nobody has to train, for vector environments: linear ones, regulators, and no or random inputs.

The regulators are linear-quadratic, with a governor of its references, and model predictive. All three minimize the
same cost of the task's error, whose weights are tuned for each by itself. Where the box counts between samples, it does
for governor and predictions, too.
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
from ncs_gym import LinearPlant, NCSEnv, Regulation, SetpointTracking, SpeedTracking, Task
from ncs_gym.plants.lqr import lqr_gain
from ncs_gym.plants.past_inputs import is_row_of_past_input
from ncs_gym.validation import warn_caller
from shields.certificate import Fallback
from shields.runtime.rows_within_step import closed, rows_within_step

# Its types are not declared.
_clarabel: Any = clarabel
# Steps that a reference governor looks ahead, and a model predictive controller.
GOVERNED_STEPS, PREDICTED_STEPS = 100, 20
# What keeps the equations of a regulator well-posed where an input itself costs nothing.
_LEAST_WEIGHT = 1e-6
# What is no larger than this part of the sizes that it is a sum of is rounding.
_ROUNDING = 1e-12
# Price of leaving the limits of the box by their half-widths: a program without any solution serves nobody.
_PRICE_OF_LEAVING = 1e4

# Maps observations (N, entries) and estimates (N, n) to inputs (N, m) [physical units], not yet clipped.
Inputs = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class RegulatorWeights:
    """What a linear-quadratic regulator weighs against an error of the task of one width.

    Attributes:
        effort: An input at its limit; where the task prices changes of the input, a change by its limit.
        state: A state at the edge of the box.
    """

    effort: float = 0.01
    state: float = 0.01


DEFAULT_WEIGHTS = RegulatorWeights()


@dataclass(frozen=True)
class RegulatorProblem:
    """The sum of |E z + D u|^2 along z+ = A z + B u, where z is the state and what else of the observation counts.

    Attributes:
        A: Shape (entries, entries).
        B: Shape (entries, m).
        E: Shape (costs, entries).
        D: Shape (costs, m).
        target: What a target of 1 adds to z, shape (entries,); zeros for a task without targets.
    """

    A: np.ndarray
    B: np.ndarray
    E: np.ndarray
    D: np.ndarray
    target: np.ndarray

    @property
    def A_of_constant_target(self) -> np.ndarray:
        """A under which a target stays, shape (entries, entries): in A it may decay, or there would be no regulator."""
        decay = self.target - self.A @ self.target
        return self.A + np.outer(decay, self.target) / (self.target @ self.target)

    def entries(self, observations: np.ndarray, estimates: np.ndarray) -> np.ndarray:
        """Returns z, shape (N, entries), for observations and estimates (N, n)."""
        beyond = observations[:, estimates.shape[1] : len(self.A)]
        return np.hstack([estimates, beyond.astype(np.float64)])

    def gain(self) -> np.ndarray:
        """Returns the gain of the optimal u = gain z, shape (m, entries).

        Raises:
            ValueError: If there is none.
        """
        if (gain := lqr_gain(self.A, self.B, self.E.T @ self.E, self.D.T @ self.D, self.E.T @ self.D)) is None:
            raise ValueError("there is no linear-quadratic regulator: the inputs cannot stabilize the plant")
        return gain


def regulator_problem(env: NCSEnv, weights: RegulatorWeights) -> RegulatorProblem:
    """Returns what a regulator of an environment's task minimizes.

    Its cost weighs the error in the task's width, states in units of the box and inputs in units of their limits. The
    speed error of `SpeedTracking`, e+ = e - dt u, is a state of its own. For `Regulation` it is what the reward counts.
    """
    plant, task = env.plant, env.task
    if isinstance(task, SetpointTracking):
        return _tracking_problem(plant, task, weights)
    if isinstance(task, Regulation):
        return _regulation_problem(plant, task)
    states, effort = np.sqrt(weights.state) * plant.box, np.sqrt(weights.effort + _LEAST_WEIGHT)
    A, B, E, target = plant.A, plant.B, states, np.zeros(plant.n)
    if isinstance(task, SpeedTracking):
        A = np.pad(A, (0, 1))
        A[-1, -1] = 1.0
        B = np.vstack([B, -plant.dt * np.eye(plant.m)[task.input_index]])
        E = np.pad(E, (0, 1))
        E[-1, -1] = 1.0 / 5.0  # the reward counts errors in units of 5 m/s
        target = np.append(target, 1.0)
    D = np.vstack([np.zeros((len(E), plant.m)), effort * np.diag(1.0 / plant.input_half)])
    E = np.vstack([E, np.zeros((plant.m, len(A)))])
    return RegulatorProblem(A, B, E, D, target)


def _regulation_problem(plant: LinearPlant, task: Regulation) -> RegulatorProblem:
    """Returns the problem of x'Q x + u'R u of the task, with as little more as keeps it well-posed."""
    costs, units = task.costs(plant), (plant.half_widths, plant.input_half)
    least = _LEAST_WEIGHT * max((np.diag(cost) * unit**2).max() for cost, unit in zip(costs, units, strict=True))
    states, inputs = (
        np.linalg.cholesky(cost + np.diag(least / unit**2)).T for cost, unit in zip(costs, units, strict=True)
    )
    E = np.vstack([states, np.zeros((plant.m, plant.n))])
    D = np.vstack([np.zeros((plant.n, plant.m)), inputs])
    return RegulatorProblem(plant.A, plant.B, E, D, np.zeros(plant.n))


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
    of_target = np.zeros(size)
    of_target[n : n + targets] = 1.0
    return RegulatorProblem(A, B, np.vstack([error, box, -wanted]), np.vstack([free, given]), of_target)


def regulator(env: NCSEnv, weights: RegulatorWeights) -> Inputs:
    """Returns the linear-quadratic regulator of the task's error, with what is known of its targets."""
    problem = regulator_problem(env, weights)
    gain = problem.gain()
    return lambda observations, estimates: problem.entries(observations, estimates) @ gain.T


def governor(env: NCSEnv, weights: RegulatorWeights, margin: float = 0.0) -> Inputs:
    """Returns the regulator with its targets clipped by a reference governor.

    Targets, of `SpeedTracking` the error of the speed, are moved as little as possible so that the regulator's own
    loop, from the estimate taken for the state and without disturbance, with a constant target keeps the limits of box
    and inputs less a margin for the next `GOVERNED_STEPS` steps. Where no target does, the middle of what the limits
    ask for is used (Garone et al. 2017, docs/bibliography.md). The margin is a fraction of the box.

    Raises:
        ValueError: If the task has no targets.
    """
    plant, problem = env.plant, regulator_problem(env, weights)
    gain, target, known = problem.gain(), problem.target, problem.target != 0.0
    if not known.any():
        raise ValueError(f"a governor needs targets, and {type(env.task).__name__} has none")
    loop, k = problem.A_of_constant_target + problem.B @ gain, len(plant.box)
    grid, beyond = rows_within_step(plant), ((0, 0), (0, len(loop) - plant.n))
    between = np.pad(grid.state, beyond) + grid.input @ gain
    limits = np.vstack([np.pad(plant.box, beyond), between, gain / plant.input_half[:, None]])
    low, high = plant.input_ends / plant.input_half
    low = np.concatenate([plant.box_low + margin, grid.low + margin, low])
    high = np.concatenate([plant.box_high - margin, grid.high - margin, high])
    rows, power = [limits[k:]], loop  # the box now holds or not whatever the target is
    for _ in range(GOVERNED_STEPS):
        rows.append(limits @ power)
        power = loop @ power
    free = np.vstack(rows)
    slope = free @ target
    low, high = (np.concatenate([ends[k:], np.tile(ends, GOVERNED_STEPS)]) for ends in (low, high))
    felt = np.abs(slope) > _LEAST_WEIGHT * np.abs(slope).max()
    free, slope, low, high = free[felt], slope[felt], low[felt], high[felt]
    below = np.where(slope > 0.0, low, -high) / np.abs(slope)
    above = np.where(slope > 0.0, high, -low) / np.abs(slope)

    def inputs(observations: np.ndarray, estimates: np.ndarray) -> np.ndarray:
        entries = problem.entries(observations, estimates)
        middle = -(entries * ~known) @ free.T / slope
        low = (middle + below).max(axis=1, keepdims=True)
        high = (middle + above).min(axis=1, keepdims=True)
        center = 0.5 * (low + high)
        entries[:, known] = np.clip(entries[:, known], np.minimum(low, center), np.maximum(high, center))
        return entries @ gain.T

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
    beyond, grid = ((0, 0), (0, len(A) - plant.n)), rows_within_step(plant)
    rows, between = np.pad(plant.box, beyond), np.pad(grid.state, beyond)
    low, high = closed(np.concatenate([grid.low, plant.box_low]), np.concatenate([grid.high, plant.box_high]))
    low, high = np.tile(low + margin, steps), np.tile(high - margin, steps)
    least, most = (np.tile(ends, steps) for ends in plant.input_ends)
    free, forced, costs, limits = np.eye(len(A)), np.zeros((len(A), steps * m)), [], []
    for k in range(steps):  # z_k = free z_0 + forced u
        now = np.eye(steps * m)[k * m : (k + 1) * m]
        costs.append((E @ free, E @ forced + D @ now))
        limits.append((between @ free, between @ forced + grid.input @ now))
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

    def solved(entries: np.ndarray) -> np.ndarray:
        slope, place = effect.T @ (drift @ entries), moved @ entries
        q = np.concatenate([2.0 * slope, np.full(steps, _PRICE_OF_LEAVING)])
        b = np.concatenate([high - place, place - low, most, -least, np.zeros(steps)])
        cones = [_clarabel.NonnegativeConeT(len(b))]
        found = _clarabel.DefaultSolver(P, q, inequalities, b, cones, settings).solve()
        if found.status not in (_clarabel.SolverStatus.Solved, _clarabel.SolverStatus.AlmostSolved):
            raise RuntimeError(f"the predictive controller's program was not solved: {found.status}")
        return np.array(found.x[:m])

    def inputs(observations: np.ndarray, estimates: np.ndarray) -> np.ndarray:
        entries = problem.entries(observations, estimates)
        plans = entries @ without_limits.T  # the minimum without limits is the minimum where it keeps them
        kept = ((least <= plans) & (plans <= most)).all(axis=1)
        places = entries @ moved.T + plans @ felt.T
        kept &= ((low <= places) & (places <= high)).all(axis=1)
        for k in np.flatnonzero(~kept):
            plans[k, :m] = solved(entries[k])
        return plans[:, :m]

    return inputs


def equilibrium(plant: LinearPlant, output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns state (n,) and input (m,) with x = A x + B u and c x = 1, the smallest in units of box and limits.

    Where there is none, the least-squares solution. The output is c, shape (n,).
    """
    n, scale = plant.n, np.concatenate([plant.half_widths, plant.input_half])
    rest = np.hstack([np.eye(n) - plant.A, -plant.B]) / plant.half_widths[:, None]
    equations = np.vstack([rest, np.concatenate([output, np.zeros(plant.m)])])
    both = scale * np.linalg.lstsq(equations * scale, np.eye(n + 1)[-1])[0]
    return both[:n], both[n:]


def _zero(env: NCSEnv, fallback: Fallback, seed: int) -> Inputs:
    return lambda observations, estimates: np.zeros((len(estimates), env.plant.m))


def _random(env: NCSEnv, fallback: Fallback, seed: int) -> Inputs:
    rng, (low, high) = np.random.default_rng(seed), env.plant.input_ends
    return lambda observations, estimates: rng.uniform(low, high, (len(estimates), len(low)))


def _fallback(env: NCSEnv, fallback: Fallback, seed: int) -> Inputs:
    return lambda observations, estimates: estimates @ fallback.gain.T + fallback.constant


def _greedy(env: NCSEnv, fallback: Fallback, seed: int) -> Inputs:
    """Returns inputs that come closest to the task's goal in the step in which they reach it, and ignore the safe box.

    For `SpeedTracking` they remove the error of the speed, for `SetpointTracking` that of the output, with as little
    input as possible or with the largest input; for other tasks they are the least-squares solution of C x = 0.
    """
    plant, task, first = env.plant, env.task, env.plant.n
    moved = np.zeros(first)
    if isinstance(task, SpeedTracking):
        effect = plant.dt * np.eye(plant.m)[task.input_index]
    elif isinstance(task, SetpointTracking):
        effect, moved = _first_effect(plant, task.output)
    else:
        effect, moved = _first_effect(plant, plant.box[~is_row_of_past_input(plant)])
        gain = np.linalg.lstsq(effect, -moved)[0]
        return lambda observations, estimates: estimates @ gain.T
    # The inputs that raise the output the most, and that lower it the most.
    low, high = plant.input_ends
    farthest = np.where(effect > 0.0, [high, low], np.where(effect < 0.0, [low, high], 0.0))
    changes = np.abs(farthest @ effect)

    def inputs(observations: np.ndarray, estimates: np.ndarray) -> np.ndarray:
        missing = observations[:, first].astype(np.float64) - estimates @ moved
        side = (missing < 0.0).astype(np.intp)
        fractions = np.abs(missing) / np.where(changes > 0.0, changes, np.inf)[side]
        return np.minimum(1.0, fractions)[:, None] * farthest[side]

    return inputs


def _first_effect(plant: LinearPlant, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns what an input and the state add to `rows` x in the first step in which inputs reach it.

    That is one step later for every past input or further state in between. Rows are a vector (n,) or a matrix (k, n);
    the parts are of shape (m,) and (n,), or (k, m) and (k, n).

    Raises:
        ValueError: If no input ever does.
    """
    size = np.abs(rows)
    for _ in range(plant.n):
        effect, rows = rows @ plant.B, rows @ plant.A
        felt = np.abs(effect) > _ROUNDING * (size @ np.abs(plant.B))
        if felt.any():
            return np.where(felt, effect, 0.0), rows
        size = size @ np.abs(plant.A)
    raise ValueError("greedy has nothing to do: no input moves what the task asks for")


def _proportional(env: NCSEnv, fallback: Fallback, seed: int) -> Inputs:
    """Returns inputs in proportion to the error of the task.

    For `SpeedTracking` u = (target - speed) / dt, which within the limits removes the error in a step; for
    `SetpointTracking` the certified gain about the equilibrium at the target, u = u_s + K (x_hat - x_s), which is the
    operating point for other tasks, whatever the point at which the fallback rests.
    """
    first = env.plant.n
    if isinstance(env.task, SpeedTracking):
        direction = np.eye(env.plant.m)[env.task.input_index] / env.plant.dt
        return lambda observations, estimates: observations[:, first : first + 1] * direction
    if not isinstance(env.task, SetpointTracking):
        return lambda observations, estimates: estimates @ fallback.gain.T
    x_s, u_s = equilibrium(env.plant, env.task.output)

    def inputs(observations: np.ndarray, estimates: np.ndarray) -> np.ndarray:
        target = observations[:, first : first + 1].astype(np.float64)
        return target * u_s + (estimates - target * x_s) @ fallback.gain.T

    return inputs


# Those whose weights are tuned, made from an environment and weights.
REGULATORS: dict[str, Callable[[NCSEnv, RegulatorWeights], Inputs]] = {"lqr": regulator}
for _name, _make in {"governor": governor, "mpc": model_predictive}.items():
    REGULATORS |= {_name: _make} | {f"{_name}:{each}": partial(_make, margin=each / 100.0) for each in MARGINS}

CONTROLLERS: dict[str, Callable[[NCSEnv, Fallback, int], Inputs]] = {
    "zero input": _zero,
    "K x_hat": _fallback,
    "random": _random,
    "greedy": _greedy,
    "proportional": _proportional,
}
"""The policies by name, made from an environment, the certificate's fallback and a seed."""


# Tasks whose reward and observations controllers know.
_PURSUED = Regulation, SpeedTracking, SetpointTracking
# Those that pursue what the task asks for, as far as they know it; the others ask for nothing.
PURSUING = ("greedy", "proportional", *REGULATORS)


def why_aimless(name: str, task: Task) -> str:
    """Returns why a controller cannot pursue what a task asks for, an empty string if it can.

    What another reward asks for nobody knows, nor what other observations are; a profile of targets may be your own.
    """
    own, kind = (type(task).reward, type(task).observe), name.partition(":")[0]
    if kind == "governor" and own == (Regulation.reward, Regulation.observe):
        return f"{name} clips targets, and a {type(task).__name__} task has none: take lqr"
    if name not in PURSUING or any(own == (each.reward, each.observe) for each in _PURSUED):
        return ""
    return (
        f"{name} does not know what a {type(task).__name__} asks for: it pursues Regulation, SpeedTracking and "
        "SetpointTracking"
    )


def controller(
    name: str, env: NCSEnv, fallback: Fallback, seed: int, weights: RegulatorWeights = DEFAULT_WEIGHTS
) -> Policy:
    """Returns a policy for vector environments of a kind.

    Args:
        name: A name in `CONTROLLERS` or `REGULATORS`.
        env: A single environment with the plant and the task.
        fallback: A certificate's: u = u_c + K (x_hat - x_c), K x_hat around the operating point.
        seed: Seed of the random policy.
        weights: Weights of the regulators.

    Warns:
        UserWarning: If "greedy" brings states to rest, since it does not know what the task asks for.

    Raises:
        ValueError: If another controller does not know it.
    """
    if problem := why_aimless(name, env.task):
        if name != "greedy":
            raise ValueError(problem)
        warn_caller(f"{problem}; here it brings the state to the operating point", UserWarning)
    make, plant = REGULATORS.get(name), env.plant
    inputs = CONTROLLERS[name](env, fallback, seed) if make is None else make(env, weights)

    def actions(observations: np.ndarray, infos: Any) -> np.ndarray:
        u = inputs(observations, infos["estimate"])
        return np.clip((u - plant.input_middle) / plant.input_half, -1.0, 1.0)

    return actions
