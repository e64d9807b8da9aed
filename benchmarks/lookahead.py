"""What mode "lookahead" admits and what it costs: `python -m benchmarks.lookahead COMMAND`.

Commands: admitted, decisions. Plans end in the safe set of the certificate: the polytope, with `--safe-set ellipsoid`
the ellipsoid in it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Annotated, Any

import cvxpy as cp
import gymnasium as gym
import numpy as np
from scipy.optimize import linprog

from benchmarks.commands import one_of, run, table
from benchmarks.timing import microseconds
from ncs_gym import Ellipsoid, LinearPlant
from ncs_gym.envs.env import ncs_env
from shields import SafetyFilter, VectorSafetyShield, synthesize
from shields.runtime.backup_plans import Lookahead
from shields.runtime.set_test import PredictedErrors

# Environment, horizon; where plans end in the ellipsoid more steps pay on the cart-pole.
CASES = {
    "ellipsoid": (("TruckTrailer", 3), ("TruckTrailerCruise", 3), ("CartPole", 12), ("BatchReactor", 6)),
    "polytope": (("TruckTrailer", 3), ("TruckTrailerCruise", 3), ("CartPole", 6), ("BatchReactor", 6)),
}
SafeSet = Annotated[str, one_of(tuple(CASES))]
# Environments side by side, steps before those that are timed, environments of every step whose decisions are timed one
# by one, and situations that are given to cvxpy.
ENVS, WARM, ALONE, CVXPY = 64, 50, 4, 60


def admitted(safe_set: SafeSet = "polytope", situations: int = 2000) -> None:
    """In what share of situations some input is certified, by the one-step test alone and by a plan.

    Situations are a true state drawn uniformly from the box, an error on the boundary of the error ellipsoid that is
    met in the middle of an episode (the one of median size), and the estimate that follows. "in S" is the share of true
    states that lie in the safe set; "one step" and "lookahead" the shares for which some input passes the test or
    begins a plan. "bound" is the share for which some input keeps the next state in the box whatever error and
    disturbance are, with nothing asked of what comes later: no shield admits more.
    """
    show = table("situations admitted", "N", "in S", "one step", "lookahead", "bound", first=20)
    for name, horizon in CASES[safe_set]:
        env = ncs_env(gym.make(f"ncs_gym/{name}-v0", terminate_on_violation=False))
        plant, certificate = env.plant, synthesize(env.plant, contract=env.certificate_contract, safe_set=safe_set)
        shape, rng = _median_shape(env), np.random.default_rng(0)
        states = np.empty((0, plant.n))
        while len(states) < situations:
            more = rng.uniform(-1, 1, (situations, plant.n)) * plant.half_widths
            states = np.concatenate([states, more[(np.abs(more @ plant.box.T) <= 1.0).all(axis=1)]])
        states = states[:situations]
        estimates = states + Ellipsoid(shape).sample_boundary(rng, situations)
        proposed = rng.uniform(-1, 1, (situations, plant.m)) * plant.largest_input
        shares = [np.mean(certificate.safe_set.gauge(states) <= 1.0)]
        for shield in (SafetyFilter(certificate, plant), SafetyFilter(certificate, plant, "lookahead", horizon)):
            decided = (shield.decide(x_hat, shape, u) for x_hat, u in zip(estimates, proposed, strict=True))
            shares.append(np.mean([each.proved for each in decided]))
        shares.append(_kept_by_some_input(plant, estimates, shape))
        show(name, horizon, *(f"{share:.1%}" for share in shares))


def _median_shape(env: Any) -> np.ndarray:
    """Returns the error shape of median size of some episodes."""
    shapes = []
    for seed in range(5):
        env.reset(seed=seed)
        shapes += [env.step(np.zeros(env.plant.m, np.float32))[4]["error_shape"] for _ in range(60)]
    return sorted(shapes, key=lambda each: np.trace(env.plant.weight @ each))[len(shapes) // 2]


def _kept_by_some_input(plant: LinearPlant, estimates: np.ndarray, shape: np.ndarray) -> float:
    """Returns for what share of estimates some input is sure to keep the next state in the box."""
    C, D = plant.box, plant.disturbance.shape_matrix
    reach = sum(
        np.sqrt(np.maximum(np.einsum("ji,ik,jk->j", *each), 0.0))
        for each in ((C, D, C), (C @ plant.A, shape, C @ plant.A))
    )
    rows, drifts = C @ plant.B, estimates @ (C @ plant.A).T
    A_ub, b_ub = np.vstack([rows, -rows]), np.hstack([1.0 - reach - drifts, 1.0 - reach + drifts])
    bounds = np.stack([-plant.largest_input, plant.largest_input], axis=1)
    return float(np.mean([linprog(np.zeros(plant.m), A_ub, each, bounds=bounds).success for each in b_ub]))


class PlainProgram:
    """The plan of N inputs with the closest first one, stated for cvxpy (DPP) and solved by Clarabel."""

    def __init__(self, shield: SafetyFilter) -> None:
        plant, steps = shield.plant, shield.horizon
        assert steps is not None
        assert isinstance(shield.lookahead, Lookahead)
        self.plans = shield.lookahead.planner.test
        self.start, self.proposed = cp.Parameter(plant.n), cp.Parameter(plant.m)
        self.row_limits, self.weighting, self.radius = (
            cp.Parameter((steps, len(self.plans.prediction.rows))),
            cp.Parameter((plant.n, plant.n)),
            cp.Parameter(),
        )
        self.u, self.c = cp.Variable((steps, plant.m)), cp.Variable((steps + 1, plant.n))
        self.weighted = cp.Variable(plant.n)
        constraints = [self.c[0] == self.start, cp.abs(self.u) <= np.tile(plant.largest_input, (steps, 1))]
        constraints += [self.c[1:] == self.c[:-1] @ plant.A.T + self.u @ plant.B.T]
        rows, count = self.plans.prediction.rows, len(plant.box)
        constraints += [cp.abs(self.c[1:-1] @ plant.box.T) <= self.row_limits[:-1, :count]] if steps > 1 else []
        if self.plans.prediction.ends:
            constraints += [self.weighted == self.weighting @ self.c[-1], cp.norm(self.weighted) <= self.radius]
        else:
            constraints += [cp.abs(rows @ self.c[-1]) <= self.row_limits[-1]]
        self.problem = cp.Problem(cp.Minimize(cp.sum_squares(self.u[0] - self.proposed)), constraints)

    def solve(self, estimate: np.ndarray, shape: np.ndarray, proposed: np.ndarray) -> bool:
        known = self.plans.tightenings_of(shape[None])
        row_limits, radius = self.plans.limits_at(estimate[None], known)
        if not (np.isfinite(radius[0, -1]) and radius[0, -1] > 0.0):
            return False
        self.start.value, self.proposed.value = estimate, proposed
        self.row_limits.value, self.radius.value = row_limits[0], radius[0, -1]
        if self.plans.prediction.ends:
            self.weighting.value = known.weighting[0, -1]
        try:
            self.problem.solve(solver=cp.CLARABEL)
        except cp.SolverError:  # it happens where there is hardly a solution
            return False
        return self.problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)


class Recorded(SafetyFilter):
    """A safety filter that keeps what it decides about, and the microseconds per decision."""

    def decide_columns(self, estimates: Any, errors: Any, proposed: Any, stored: Any = None) -> Any:
        start = time.process_time()
        decided = super().decide_columns(estimates, errors, proposed, stored)
        spent = 1e6 * (time.process_time() - start) / ENVS
        steps = self.__dict__.setdefault("steps", [])
        steps.append((spent, estimates.copy(), errors, proposed.copy(), stored.copy()))
        return decided


def decisions(safe_set: SafeSet = "polytope", steps: int = 100) -> None:
    """Microseconds per decision of mode "lookahead" in closed loop, against one cvxpy program per decision.

    64 environments run behind the shield with random actions. Every decision they meet is timed as they make it, in a
    batch of 64, and again one by one for some of them, as the wrapper of a single environment makes it. "searched" are
    those whose proposal fails the one-step test. A predictive filter without this order asks its solver at every step:
    "cvxpy" is the median time of the same convex program, with parameters (DPP) and solved by Clarabel.
    """
    titles = ("N", "searched", "median", "99%", "searched", "of 64", "99%", "cvxpy", "x median", "x of 64")
    show = table("us per decision", *titles, first=20)
    for name, horizon in CASES[safe_set]:
        env, rng = gym.make_vec(f"ncs_gym/{name}-v0", num_envs=ENVS), np.random.default_rng(0)
        single = ncs_env(gym.make(f"ncs_gym/{name}-v0"))
        certificate = synthesize(single.plant, contract=single.certificate_contract, safe_set=safe_set)
        shielded = VectorSafetyShield(env, certificate, "lookahead", horizon=horizon, on_unproved="ignore")
        shielded._guard.filter = Recorded(certificate, single.plant, "lookahead", horizon)
        shielded.reset(seed=0)
        for _ in range(WARM + steps):
            shielded.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        met = shielded.filter.__dict__["steps"][WARM:]
        together = np.array([step[0] for step in met])
        shield = SafetyFilter(certificate, single.plant, "lookahead", horizon)
        cases = [case for _, *step in met for case in _singles(*step)]
        alone = microseconds(shield.decide, cases)
        failed = np.array([shield.decide(*case).reason != "safe" for case in cases])
        searched = [case for case, fails in zip(cases, failed, strict=True) if fails]
        programs = [(x_hat, errors.shape, u) for x_hat, errors, u, _ in (searched or cases)[:CVXPY]]
        theirs = np.median(microseconds(PlainProgram(shield).solve, programs))
        times = [np.median(alone), np.quantile(alone, 0.99), np.median(alone[failed]) if failed.any() else np.nan]
        times += [np.median(together), np.quantile(together, 0.99), theirs]
        ratios = [f"{theirs / np.median(each):.0f}x" for each in (alone, together)]
        show(name, horizon, f"{failed.mean():.1%}", *(f"{each:.0f}" for each in times), *ratios)


def _singles(
    estimates: np.ndarray, errors: PredictedErrors, proposed: np.ndarray, stored: np.ndarray
) -> Iterator[tuple[Any, ...]]:
    """Yields the first decisions of a batch as arguments of single ones."""
    for e in range(ALONE):
        plan = stored[..., e]
        known = errors.of(np.array([e])).single()
        yield estimates[:, e].copy(), known, proposed[:, e].copy(), plan[~np.isnan(plan[:, 0])]


COMMANDS = (admitted, decisions)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
