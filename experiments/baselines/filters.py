"""Safety filters that take the estimate for the true state, as wrappers of vector environments; they prove nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from ncs_gym import LinearPlant, NCSVectorEnv
from shields import Certificate
from shields.runtime.backup_plans.plan_check import Prediction
from shields.runtime.backup_plans.plan_search import PlanProgram
from shields.runtime.safety_filter import SafetyFilter
from shields.runtime.set_test import certificate_test, closed
from shields.verification import require_valid

# Margins that filters and controllers are given, in percent of the box, and of the way to a face of the safe set.
MARGINS = (5, 10, 20, 40, 50)
# Steps that are looked ahead; a tube leaves no room for more than a few.
HORIZON, TUBE_HORIZON = 20, 3
# A solution may miss the limits of box and safe set by this much, as solvers do.
TOLERANCE = 1e-6

# Maps estimates (N, n), proposed inputs (N, m) and where an episode has just begun (N,) to the inputs to apply, (N, m).
Rule = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class CertaintyEquivalentFilter:
    """Decides as the shield does, with Sigma_k = 0 in the place of the true error ellipsoid, and so without a proof.

    The margin is the fraction of the safe box that is kept free after the next step: margin^2 W^-1, of the ellipsoid
    x'W x <= 1 inside it, in the place of A Sigma_k A', where states can be off at all (past inputs are known).

    Raises:
        CertificateError: If the certificate does not verify for the plant.
    """

    def __init__(self, certificate: Certificate, plant: LinearPlant, margin: float = 0.0) -> None:
        self._filter = SafetyFilter(certificate, plant)
        unknown, back = np.arange(plant.n) < plant.n - plant.past, np.linalg.pinv(plant.A)
        off = margin**2 * np.where(np.outer(unknown, unknown), np.linalg.inv(plant.weight), 0.0)
        self._assumed = self._filter.errors_of_many((back @ off @ back.T)[None])

    def __call__(self, estimates: np.ndarray, proposed: np.ndarray, begun: np.ndarray) -> np.ndarray:
        """Returns the inputs to apply, shape (N, m), as a `Rule`."""
        errors = self._assumed.of(np.zeros(len(estimates), np.intp))
        return self._filter.decide_columns(estimates.T, errors, proposed.T, None).input.T


class PredictiveFilter:
    """The closest input from which a nominal plan exists that ends in the safe set.

    It solves, with x_0 = x_hat taken for the true state and neither disturbance nor error set,

        min |u_0 - proposed|^2  s.t.  x_{i+1} = A x_i + B u_i,  u_i within the limits,
                                      low_j + t_ij <= c_j x_i <= high_j - t_ij (0 < i < N),  |x_N|_M <= 1 - t_N,

    or low + t_N(g) <= g x_N <= high - t_N(g) for the rows g of the certificate's polytope, if it has one. Limits within
    a step hold, too: of states and inputs together, and of the box at other times.
    The tightenings t are zero, a margin, the same for all, or those of a tube: with u_i + K (x_hat_i - x_i) applied,
    the true state is off x_i by (A+BK)^i e_0 + sum_j (A+BK)^j (B K e + d), each term as large as the certificate's
    error sets and the plant's disturbance let it be. Where the proposed input followed by u = K x is such a plan
    already, nothing is solved. Where the program has no solution, the rest of the last plan is applied, then the
    fallback.

    After Wabersich and Zeilinger 2018 and Wabersich and Zeilinger 2021; the tube of an estimate is that of
    Mayne et al. 2006 (docs/bibliography.md).

    Args:
        certificate: Gives S and K; verified exactly here.
        plant: Its plant.
        horizon: N [steps], at least 2.
        margin: Fraction that is kept free of half the range of the box and of the way to a face of the safe set.
        tube: Whether the tightenings are those of the tube, beside the margin.

    Raises:
        CertificateError: If the certificate does not verify for the plant.
        ValueError: If a tube is asked for where there are limits within a step.
    """

    def __init__(
        self,
        certificate: Certificate,
        plant: LinearPlant,
        horizon: int = HORIZON,
        margin: float = 0.0,
        *,
        tube: bool = False,
    ) -> None:
        require_valid(certificate, plant)
        self._plant, self._fallback, self._horizon = plant, certificate.fallback, horizon
        self._plans = np.empty((0, horizon - 1, plant.m))
        test = certificate_test(certificate, plant)
        self._root, self._ends_in_ellipsoid = test.root, bool(test.cone)
        self._prediction = Prediction(test, horizon)
        self._program = PlanProgram(self._prediction)
        self._middle, half = _middle_and_half(*plant.kept_ends)
        at_samples = np.tile(half - margin, (horizon + 1, 1))
        self._end_middle, end_half, to_face = np.zeros(1), np.ones(1), np.ones(1)
        if not test.cone:
            self._end_middle, end_half = test.middle[: len(test.root)], test.half[: len(test.root)]
            to_face = end_half - np.abs(test.root @ certificate.resting_state - self._end_middle)
        self._end_limits = end_half - margin * to_face
        if tube:
            if len(plant.step_rows):
                raise ValueError("a tube knows no limits of states and inputs together, nor of times between samples")
            reach, end = _tube(certificate, plant, self._end_sizes, horizon)
            at_samples, self._end_limits = at_samples - reach, self._end_limits - end
        self._limits = at_samples[1:-1]
        k, ends = len(plant.box), len(self._end_limits)
        self._all_limits = np.ones((horizon, max(k, ends)))  # the last row is for ends in P
        self._all_limits[:-1, :k], self._all_limits[-1, :ends] = self._limits, self._end_limits
        self._weighting = self._root[: test.cone]
        self._step_middle, step_half = _middle_and_half(*plant.step_ends)
        self._within = step_half - margin

    def __call__(self, estimates: np.ndarray, proposed: np.ndarray, begun: np.ndarray) -> np.ndarray:
        """Returns the inputs to apply, shape (N, m), as a `Rule`; plans of before an episode began are void."""
        if len(self._plans) != len(estimates):
            self._plans = np.full((len(estimates), self._horizon - 1, self._plant.m), np.nan)
        self._plans[begun] = np.nan
        applied, (fine, plans) = proposed.copy(), self._followed_by_gain(estimates, proposed)
        self._plans[fine] = plans[fine]
        for e in np.flatnonzero(~fine).tolist():
            plan = self._solved(estimates[e], proposed[e])
            if plan is None:
                plan = np.concatenate([self._plans[e], np.full((1, self._plant.m), np.nan)])
            if np.isnan(plan[0]).any():
                plan[0] = self._gained(estimates[e])
            applied[e], self._plans[e] = plan[0], plan[1:]
        return applied

    def _followed_by_gain(self, estimates: np.ndarray, proposed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns where a proposed input and then u = K x are a plan, (N,), and these inputs, (N, horizon - 1, m)."""
        plant, states, inputs, plans = self._plant, estimates, proposed, []
        fine = np.ones(len(states), np.bool_)
        for limits in [*self._limits, np.full(len(plant.box), np.inf)]:
            fine &= self._keeps_within_steps(states, inputs, 0.0)
            states = states @ plant.A.T + inputs @ plant.B.T
            fine &= (np.abs(states @ plant.box.T - self._middle) <= limits).all(axis=1)
            inputs = self._gained(states)
            plans.append(inputs)
        return fine & (self._levels(states) <= self._end_limits).all(axis=-1), np.stack(plans[:-1], axis=1)

    def _solved(self, estimate: np.ndarray, proposed: np.ndarray) -> np.ndarray | None:
        """Returns the inputs of the best plan, shape (horizon, m); None if the solver finds none."""
        plant = self._plant
        moved = plant.box @ plant.A @ estimate + plant.box @ plant.B @ plant.input_middle - self._middle
        missed = np.abs(moved) - np.abs(plant.box @ plant.B) @ plant.input_half
        if not (missed <= self._limits[0]).all() or (self._end_limits <= 0.0).any():
            return None  # no input brings the next state into the box, or nothing is left of the end
        radius = float(self._end_limits[0])  # counts for ends in S
        within = np.tile(self._within, (self._horizon, 1))
        plan = self._program.solve(estimate, self._all_limits, self._weighting, radius, within, proposed)
        if plan is None:
            return None
        plan = np.clip(plan, *plant.input_ends)
        centers = self._prediction.centers(estimate[None], plan[None, None])[..., 0, 0]
        inside = (np.abs(centers[:-1] @ plant.box.T - self._middle) <= self._limits + TOLERANCE).all()
        begun = np.vstack([estimate, centers[:-1]])
        inside &= self._keeps_within_steps(begun, plan, TOLERANCE).all()
        return plan if inside and (self._levels(centers[-1]) <= self._end_limits + TOLERANCE).all() else None

    def _keeps_within_steps(self, states: np.ndarray, inputs: np.ndarray, tolerance: float) -> np.ndarray:
        """Returns whether limits within a step are kept, of shape (N, n) and (N, m): shape (N,)."""
        values = np.hstack([states, inputs]) @ self._plant.step_rows.T
        return np.all(np.abs(values - self._step_middle) <= self._within + tolerance, axis=1)

    def _levels(self, states: np.ndarray) -> np.ndarray:
        """Returns |x|_M, shape (..., 1), or how far the rows g x of P are from their middles, shape (..., r)."""
        values = states @ self._root.T - self._end_middle
        return np.linalg.norm(values, axis=-1, keepdims=True) if self._ends_in_ellipsoid else np.abs(values)

    def _end_sizes(self, shape: np.ndarray) -> np.ndarray:
        """Returns the largest levels in an ellipsoid of a shape (n, n): shape (1,) or (r,)."""
        moved = self._root @ shape @ self._root.T
        return np.sqrt(np.maximum(np.linalg.eigvalsh(moved)[-1:] if self._ends_in_ellipsoid else np.diag(moved), 0.0))

    def _gained(self, states: np.ndarray) -> np.ndarray:
        """Returns the fallback within the limits, shape (m,) or (N, m)."""
        inputs = states @ self._fallback.gain.T + self._fallback.constant
        return np.clip(inputs, *self._plant.input_ends)


def _middle_and_half(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = closed(low, high)
    return 0.5 * (low + high), 0.5 * (high - low)


def _tube(
    certificate: Certificate, plant: LinearPlant, end_sizes: Callable[[np.ndarray], np.ndarray], horizon: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns how far true states are off a plan in the rows of the box, (horizon + 1, k), and at its end."""
    K, rows = certificate.K, plant.box
    first = list(certificate.error_shapes)
    pushes = [plant.B @ K @ shape @ (plant.B @ K).T for shape in first]

    def sizes(shapes: list[np.ndarray], power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the largest support of any of the shapes, moved by a matrix, in the rows and at the end."""
        moved = [power @ shape @ power.T for shape in shapes]
        supports = np.sqrt(np.maximum([np.einsum("ij,jk,ik->i", rows, each, rows) for each in moved], 0.0))
        return supports.max(axis=0), np.max([end_sizes(each) for each in moved], axis=0)

    power, summed, summed_end = np.eye(plant.n), np.zeros(len(rows)), np.zeros(())
    reach = [sizes(first, power)[0]]
    for _ in range(horizon):
        for shapes in (pushes, [plant.disturbance.shape_matrix]):
            support, at_end = sizes(shapes, power)
            summed, summed_end = summed + support, summed_end + at_end
        power = (plant.A + plant.B @ K) @ power
        support, at_end = sizes(first, power)
        reach.append(summed + support)
    return np.array(reach), summed_end + at_end


# How each filter is made from a certificate and its plant.
_NOMINAL: dict[str, Callable[..., Rule]] = {"trusting": CertaintyEquivalentFilter, "psf": PredictiveFilter}
# Also with margins in percent, as in "psf:10", and with a tube.
FILTERS: dict[str, Callable[..., Rule]] = {
    **_NOMINAL,
    **{f"{name}:{each}": partial(make, margin=each / 100) for name, make in _NOMINAL.items() for each in MARGINS},
    "psf:tube": partial(PredictiveFilter, horizon=TUBE_HORIZON, tube=True),
}


class EstimateFilter(VectorWrapper):
    """Applies what a filter makes of the proposed inputs, given the estimates; it proves nothing.

    The infos gain `shield_intervened`, `input_proposed` and `shield_correction`, but no `shield_guaranteed`. A step
    that only resets an environment counts no intervention. The penalty is subtracted from the reward per intervention.

    Raises:
        ValueError: If the innermost environment is not an `NCSVectorEnv`.
    """

    def __init__(self, env: VectorEnv, rule: Rule, penalty: float = 0.0) -> None:
        self.penalty = penalty
        super().__init__(env)
        inner = _environment_behind(env)
        self._plant, self._inputs_of, self._rule = inner.plant, inner.inputs_of, rule
        self._begins_at_once = inner.autoreset_mode is AutoresetMode.SAME_STEP

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts episodes."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._estimates, self._begun = info["estimate"].copy(), info["episode_steps"] == 0
        nothing = np.zeros((self.num_envs, self._plant.m))
        return observation, info | _info(nothing, nothing, np.zeros(self.num_envs, np.bool_))

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Steps the environments with the filtered actions."""
        proposed = self._inputs_of(actions).T.copy()
        applied = self._rule(self._estimates, proposed, self._begun)
        intervened = (applied != proposed).any(axis=1)
        actions = np.array(actions, np.float64)
        actions[intervened] = (applied[intervened] - self._plant.input_middle) / self._plant.input_half
        observation, rewards, terminated, truncated, info = self.env.step(actions)
        self._estimates, self._begun = info["estimate"].copy(), info["episode_steps"] == 0
        intervened &= self._begins_at_once | ~self._begun  # a step that only resets decides nothing
        applied = np.where(intervened[:, None], applied, proposed)
        info = info | _info(applied, proposed, intervened)
        return observation, rewards - self.penalty * intervened, terminated, truncated, info


@dataclass(frozen=True)
class EstimateFilterSettings:
    """Settings of a filter of `FILTERS` around a vector environment, which calling it puts there (`LoopConfig.filter`).

    The penalty is subtracted from the reward per intervention.
    """

    name: str
    certificate: Certificate
    penalty: float = 0.0

    def __call__(self, env: VectorEnv) -> EstimateFilter:
        """Returns the environment behind the filter; raises CertificateError if the certificate is not its plant's."""
        rule = FILTERS[self.name](self.certificate, _environment_behind(env).plant)
        return EstimateFilter(env, rule, self.penalty)


def _environment_behind(env: VectorEnv) -> NCSVectorEnv:
    inner = env.unwrapped
    if not isinstance(inner, NCSVectorEnv):
        raise ValueError(f"a filter by the estimate needs an NCSVectorEnv inside, got {type(inner).__name__}")
    return inner


def _info(applied: np.ndarray, proposed: np.ndarray, intervened: np.ndarray) -> dict[str, Any]:
    return {
        "shield_intervened": intervened.copy(),
        "input_proposed": proposed.copy(),
        "shield_correction": np.linalg.norm(applied - proposed, axis=1),
    }
