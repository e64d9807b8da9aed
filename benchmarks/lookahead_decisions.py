"""Microseconds per decision of mode "lookahead" in closed loop, against one cvxpy program per decision.

    python benchmarks/lookahead_decisions.py [--safe-set ellipsoid] [--steps 100]

64 environments run behind the shield with random actions. Every decision they meet is timed as they make it, in a batch
of 64, and again one by one for some of them, as the wrapper of a single environment makes it. "searched" are those
whose proposal fails the one-step test. A predictive filter without this order asks its solver at every step: "cvxpy" is
the median time of the same convex program, stated with parameters (DPP) and solved by Clarabel. CPU time.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from lookahead import CASES, CVXPY, ENVS, WARM, PlainProgram, shielded, timed

from shields.runtime.safety_filter import SafetyFilter
from shields.runtime.set_test import PredictedErrors

# Environments of every step whose decisions are timed one by one.
ALONE = 4


class Recorded(SafetyFilter):
    """A safety filter that keeps what it decides about, and the microseconds per decision."""

    def decide_columns(self, estimates, errors, proposed, stored=None):
        start = time.process_time()
        decided = super().decide_columns(estimates, errors, proposed, stored)
        spent = 1e6 * (time.process_time() - start) / ENVS
        steps = self.__dict__.setdefault("steps", [])
        steps.append((spent, estimates.copy(), errors, proposed.copy(), stored.copy()))
        return decided


def row(name: str, safe_set: str, horizon: int, steps: int) -> str:
    env, rng = shielded(name, safe_set, "lookahead", horizon), np.random.default_rng(0)
    env._filter = Recorded(env.filter.certificate, env.filter.plant, "lookahead", horizon)
    env.reset(seed=0)
    for _ in range(WARM + steps):
        env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
    met = env.filter.__dict__["steps"][WARM:]
    together = np.array([step[0] for step in met])
    shield = SafetyFilter(env.filter.certificate, env.filter.plant, "lookahead", horizon)
    cases = [case for _, *step in met for case in singles(*step)]
    alone = timed(shield.decide, cases)
    failed = np.array([shield.decide(*case).reason != "safe" for case in cases])
    searched = [case for case, fails in zip(cases, failed, strict=True) if fails]
    plain = PlainProgram(shield)
    programs = [(x_hat, errors.shape, u) for x_hat, errors, u, _ in (searched or cases)[:CVXPY]]
    others = np.median(timed(plain.solve, programs))
    searching = f"{np.median(alone[failed]):.0f}" if failed.any() else "-"
    return (
        f"{name:18s}{horizon:3d}{failed.mean():9.1%}"
        f"{np.median(alone):9.0f}{np.quantile(alone, 0.99):6.0f}{searching:>9s}"
        f"{np.median(together):9.0f}{np.quantile(together, 0.99):6.0f}{others:8.0f}"
        f"{others / np.median(alone):11.0f}x{others / np.median(together):11.0f}x"
    )


def singles(estimates: np.ndarray, errors: PredictedErrors, proposed: np.ndarray, stored: np.ndarray):
    """Yields the first decisions of a batch as arguments of single ones."""
    for e in range(ALONE):
        plan = stored[..., e]
        known = errors.of(np.array([e])).single()
        yield estimates[:, e].copy(), known, proposed[:, e].copy(), plan[~np.isnan(plan[:, 0])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--safe-set", choices=CASES, default="polytope")
    options = parser.parse_args()
    print(f"{'us per decision: one by one':>54s}{'batches of 64':>15s}{'cvxpy / median of':>32s}")
    print(
        f"{'environment':18s}{'N':>3s}{'searched':>9s}{'median':>9s}{'99%':>6s}{'searched':>9s}"
        f"{'median':>9s}{'99%':>6s}{'cvxpy':>8s}{'one by one':>12s}{'in batches':>12s}"
    )
    for name, horizon in CASES[options.safe_set]:
        print(row(name, options.safe_set, horizon, options.steps), flush=True)


if __name__ == "__main__":
    main()
