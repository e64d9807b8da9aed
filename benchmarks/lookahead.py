"""What mode "lookahead" admits and what it costs, against mode "project" and the same program in cvxpy.

    python benchmarks/lookahead.py [--sections situations loop ends training] [--safe-set ellipsoid] [--situations 2000]

Plans end in the safe set of the certificate: the polytope, with `--safe-set ellipsoid` the ellipsoid in it, with
`--safe-set sought` the polytope of a sought gain.

Section "loop" runs 64 environments in both modes with random actions and with actions pushed towards the upper limits,
and says how often and how far inputs were changed and how long a frame takes. Section "ends" compares plans that end in
either set on the batch reactor under random actions: in a loop of each, and for the same situations, taken from either
loop, with nothing stored. "with the solver" asks it for plans that end in P, too, wherever nothing is stored; "outside"
is the share of states outside the ellipsoid S. Section "training" trains PPO on the
batch reactor behind both modes and runs every agent behind both. Times are CPU times; what follows is about section
"situations".

Situations are a true state drawn uniformly from the box, an error on the boundary of the error ellipsoid that is met
in the middle of an episode (the one of median size), and the estimate that follows. A situation is admitted if some
input is certified: by a plan of at most N steps, or for the second column by the one-step test alone. "bound" is the
share for which some input keeps the next state in the box whatever error and disturbance are, with nothing asked of
what comes later: no shield admits more. "in S" is the share of true states that lie in the safe set.
Times are of situations that fail the one-step test, for proposals drawn uniformly from the limits: with nothing stored
("search", the solver is called unless a candidate begins with the proposal), and with the plan found stored ("stored").
"too far" is how much farther from the proposal the input is then than the search with the solver finds, in u_max.
"""

from __future__ import annotations

import argparse
import time
from functools import cache
from typing import NamedTuple

import cvxpy as cp
import gymnasium as gym
import numpy as np
from scipy.optimize import linprog
from stable_baselines3.common.vec_env import VecNormalize

from agents import SB3VecEnv
from agents.algorithms import build_model
from agents.hyperparams import complete_hyperparams
from ncs_gym import Ellipsoid, LinearPlant
from shields import Certificate, SafetyFilter, VectorSafetyShield, synthesize
from shields.runtime.backup_plans.plan_check import Tightening
from shields.runtime.backup_plans.plan_search import Planner

# Environment, horizon; where plans end in the ellipsoid more steps pay on the cart-pole.
CASES = {
    "sought": (("TruckTrailerCruise", 3), ("CartPole", 6), ("BatchReactor", 6)),
    "ellipsoid": (("TruckTrailer", 3), ("TruckTrailerCruise", 3), ("CartPole", 12), ("BatchReactor", 6)),
    "polytope": (("TruckTrailer", 3), ("TruckTrailerCruise", 3), ("CartPole", 6), ("BatchReactor", 6)),
}
EPISODES, STEPS = 5, 60
# So many situations are given to cvxpy.
CVXPY = 60
SECTIONS = ("situations", "loop", "ends", "training")
MODES = ("project", "lookahead")
# Steps of 64 environments that are measured, and before that.
ENVS, MEASURED, WARM = 64, 150, 50
# Seed of sections "loop" and "training"; the rule was chosen on seed 0.
SEED = 1


class Situations(NamedTuple):
    """States, estimates and proposals, shapes (count, n), (count, n) and (count, m), and one error shape."""

    states: np.ndarray
    estimates: np.ndarray
    proposed: np.ndarray
    shape: np.ndarray


class PlainProgram:
    """The plan of N inputs with the closest first one, stated for cvxpy (DPP) and solved by Clarabel."""

    def __init__(self, shield: SafetyFilter) -> None:
        plant, steps = shield.plant, shield.horizon
        self.plans = shield.lookahead.planner.test
        self.start, self.proposed = cp.Parameter(plant.n), cp.Parameter(plant.m)
        self.row_limits, self.weighting, self.radius = (
            cp.Parameter((steps, len(self.plans.prediction.rows))),
            cp.Parameter((plant.n, plant.n)),
            cp.Parameter(),
        )
        self.u, self.c = cp.Variable((steps, plant.m)), cp.Variable((steps + 1, plant.n))
        self.weighted = cp.Variable(plant.n)
        constraints = [self.c[0] == self.start, cp.abs(self.u) <= np.tile(plant.u_max, (steps, 1))]
        constraints += [self.c[1:] == self.c[:-1] @ plant.A.T + self.u @ plant.B.T]
        rows, count = self.plans.prediction.rows, len(plant.box_rows)
        constraints += [cp.abs(self.c[1:-1] @ plant.box_rows.T) <= self.row_limits[:-1, :count]] if steps > 1 else []
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
        return solved(self.problem)


def kept_by_some_input(plant: LinearPlant, situations: Situations) -> float:
    """Returns for what share of situations some input keeps the next state in the box, whatever error and disturbance.

    No shield that knows no more than the estimate and the shape of its error can admit more.
    """
    C, D = plant.box_rows, plant.disturbance.shape_matrix
    reach = sum(
        np.sqrt(np.maximum(np.einsum("ji,ik,jk->j", *each), 0.0))
        for each in ((C, D, C), (C @ plant.A, situations.shape, C @ plant.A))
    )
    rows, drifts = C @ plant.B, situations.estimates @ (C @ plant.A).T
    A_ub, b_ub = np.vstack([rows, -rows]), np.hstack([1.0 - reach - drifts, 1.0 - reach + drifts])
    bounds = np.stack([-plant.u_max, plant.u_max], axis=1)
    return float(np.mean([linprog(np.zeros(plant.m), A_ub, each, bounds=bounds).success for each in b_ub]))


def solved(problem: cp.Problem) -> bool:
    try:
        problem.solve(solver=cp.CLARABEL)
    except cp.SolverError:  # it happens where there is hardly a solution
        return False
    return problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)


def drawn(env: gym.Env, count: int) -> Situations:
    inner, rng, shapes = env.unwrapped, np.random.default_rng(0), []
    for seed in range(EPISODES):
        env.reset(seed=seed)
        shapes += [env.step(np.zeros(inner.plant.m, np.float32))[4]["error_shape"] for _ in range(STEPS)]
    shape = sorted(shapes, key=lambda each: np.trace(inner.plant.weight @ each))[len(shapes) // 2]
    states = np.empty((0, inner.plant.n))
    while len(states) < count:
        more = rng.uniform(-1, 1, (count, inner.plant.n)) * inner.plant.half_widths
        states = np.concatenate([states, more[(np.abs(more @ inner.plant.box_rows.T) <= 1.0).all(axis=1)]])
    states = states[:count]
    errors = Ellipsoid(shape).sample_boundary(rng, count)
    return Situations(states, states + errors, rng.uniform(-1, 1, (count, inner.plant.m)) * inner.plant.u_max, shape)


def timed(decide, situations: list[tuple[np.ndarray, ...]]) -> np.ndarray:
    """Microseconds of CPU time per call, each the better of two."""
    times = np.empty((2, len(situations)))
    for row in times:
        for e, situation in enumerate(situations):
            start = time.process_time()
            decide(*situation)
            row[e] = 1e6 * (time.process_time() - start)
    return times.min(axis=0)


@cache
def certified(name: str, safe_set: str) -> Certificate:
    """Returns the certificate of a registered environment."""
    env = gym.make(f"ncs_gym/{name}-v0").unwrapped
    sought = safe_set == "sought"
    return synthesize(
        env.plant, contract=env.certificate_contract, safe_set=None if sought else safe_set, search_gain=sought
    )


def report(name: str, safe_set: str, horizon: int, count: int) -> str:
    env = gym.make(f"ncs_gym/{name}-v0", terminate_on_violation=False)
    certificate = certified(name, safe_set)
    plant = env.unwrapped.plant
    shield = SafetyFilter(certificate, plant, "lookahead", horizon)
    project = SafetyFilter(certificate, plant)
    situations = drawn(env, count)
    inside = np.mean(certificate.safe_set.gauge(situations.states) <= 1.0)
    cases = [(x_hat, situations.shape, u) for x_hat, u in zip(situations.estimates, situations.proposed, strict=True)]
    one_step = np.mean([project.decide(*each).passed for each in cases])
    admitted = np.mean([shield.decide(*each).passed for each in cases])
    bound = kept_by_some_input(plant, situations)
    searched = [each for each in cases if shield.decide(*each).reason != "safe"]
    if not searched:
        return f"{name:20s} {horizon:3d} every proposal passes the one-step test"
    ours, plain = timed(shield.decide, searched), PlainProgram(shield)
    others = timed(plain.solve, [searched[i % len(searched)] for i in range(CVXPY)])
    found = [shield.decide(*each) for each in searched]
    pairs = [
        (case, one, shield.decide(*case[:2], -case[2])) for case, one in zip(searched, found, strict=True)
    ]  # what is stored was made for another proposal
    pairs = [
        (*each, np.concatenate([each[2].input[None], each[2].plan])) for each in pairs if each[2].reason == "planned"
    ]
    again, faster, farther = "-", "-", "-"
    if pairs:
        median = np.median(timed(shield.decide, [(*case, stored) for case, _, _, stored in pairs]))
        far = [
            np.linalg.norm(shield.decide(*case, stored).input - case[2]) - np.linalg.norm(one.input - case[2])
            for case, one, _, stored in pairs
        ]
        again, faster = f"{median:.0f}", f"{np.median(others) / median:.1f}x"
        farther = f"{np.mean(far) / plant.u_max.max():.2f}"
    quick = timed(project.decide, [each for each in cases if project.decide(*each).reason == "safe"][:300])
    return (
        f"{name:18s}{horizon:3d}{inside:7.1%}{one_step:9.1%}{admitted:10.1%}{bound:8.1%}"
        f"{np.median(quick):9.0f}{np.median(ours):7.0f}{np.quantile(ours, 0.99):6.0f}"
        f"{again:>7}{np.median(others):6.0f}{np.median(others) / np.median(ours):7.1f}x{faster:>8}{farther:>8}"
    )


def shielded(name: str, safe_set: str, mode: str, horizon: int, **settings) -> VectorSafetyShield:
    env = gym.make_vec(f"ncs_gym/{name}-v0", num_envs=ENVS, **settings)
    longest = horizon if mode == "lookahead" else None
    return VectorSafetyShield(env, certified(name, safe_set), mode, horizon=longest, on_unproved="ignore")


def driven(env, act, steps: int) -> tuple[float, ...]:
    """Microseconds per frame, share of inputs overridden, mean correction and reward per frame."""
    observation, info = env.reset(seed=SEED)
    sums, start = np.zeros(3), 0.0
    for step in range(WARM + steps):
        if step == WARM:
            sums[:], start = 0.0, time.process_time()
        observation, rewards, _, _, info = env.step(act(observation))
        sums += info["shield_intervened"].mean(), info["shield_correction"].mean(), rewards.mean()
    return 1e6 * (time.process_time() - start) / (steps * ENVS), *(sums / steps)


def loop(safe_set: str) -> None:
    print("environment            actions     us per frame: project lookahead   overridden            correction")
    for name, horizon in CASES[safe_set][1:]:
        for actions, mean, spread in (("random", 0.0, None), ("pushed", 0.8, 0.5)):
            results = []
            for mode in MODES:
                env, rng = shielded(name, safe_set, mode, horizon), np.random.default_rng(SEED)
                shape = env.action_space.shape

                def act(_, rng=rng, shape=shape, mean=mean, spread=spread):
                    drawn = rng.uniform(-1, 1, shape) if spread is None else rng.normal(mean, spread, shape)
                    return np.clip(drawn, -1, 1).astype(np.float32)

                results.append(driven(env, act, MEASURED))
            (first, few, small, _), (second, many, large, _) = results
            print(
                f"{name:22s} {actions:10s} {first:22.1f} {second:9.1f}   {few:6.1%} -> {many:6.1%}   "
                f"{small:7.3f} -> {large:7.3f}",
                flush=True,
            )


class AskingPlanner(Planner):
    """Asks the solver for plans that end in P as `Planner` does for those that end in S."""

    def find(self, estimates, shapes, proposed, projected, stored):
        plans = super().find(estimates, shapes, proposed, projected, stored)
        tightening = self.test.tightenings_of(shapes)
        left = np.flatnonzero(np.isnan(stored[:, 0, 0]) & (plans.distances > 0.0))
        if left.size:
            known = Tightening(*(part[left] for part in tightening))
            plans.improve(left, self._solved(estimates[left], known, proposed[left]))
        return plans


def asking(shield: SafetyFilter) -> SafetyFilter:
    shield.lookahead.planner.__class__ = AskingPlanner
    return shield


def ends() -> None:
    name, horizon = CASES["polytope"][-1]
    S, plant = certified(name, "ellipsoid").ellipsoid, gym.make(f"ncs_gym/{name}-v0").unwrapped.plant
    kinds = {"S": "ellipsoid", "P": "polytope", "P, with the solver": "polytope"}
    print(f"{name}, plans end in   {'overridden':>12s}{'correction':>12s}{'outside':>9s}")
    situations = {}
    for end, safe_set in kinds.items():
        env, rng, sums = shielded(name, safe_set, "lookahead", horizon), np.random.default_rng(SEED), np.zeros(3)
        if "solver" in end:
            asking(env.filter)
        _, info = env.reset(seed=SEED)
        taken = situations[end] = []
        for step in range(WARM + MEASURED):
            action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            if step >= WARM and step % 25 == 0:
                taken += zip(info["estimate"].copy(), info["error_shape"].copy(), action * plant.u_max, strict=True)
            info = env.step(action)[4]
            if step >= WARM:
                outside = np.mean(S.gauge(info["state"]) > 1.0)
                sums += info["shield_intervened"].mean(), info["shield_correction"].mean(), outside
        overridden, correction, outside = sums / MEASURED
        print(f"in a loop: {end:20s}{overridden:11.1%}{correction:12.3f}{outside:9.1%}", flush=True)
    filters = {end: SafetyFilter(certified(name, kind), plant, "lookahead", horizon) for end, kind in kinds.items()}
    asking(filters["P, with the solver"])
    for loop_of in ("S", "P"):
        for end, shield in filters.items():
            found = [shield.decide(*each) for each in situations[loop_of]]
            far = [np.linalg.norm(one.input - each[2]) for one, each in zip(found, situations[loop_of], strict=True)]
            share = np.mean([one.intervened for one in found])
            print(f"situations of loop {loop_of}: {end:20s}{share:6.1%}{np.mean(far):12.3f}", flush=True)


def training(safe_set: str, steps: int) -> None:
    name, horizon = CASES[safe_set][-1]
    hyperparams, agents, rates = complete_hyperparams("PPO", {"n_envs": ENVS}), {}, {}
    for count in (1, steps):  # what only the first training of a process takes time for is not measured
        for mode in MODES:
            env = SB3VecEnv(shielded(name, safe_set, mode, horizon, autoreset_mode="SameStep"))
            normalized = VecNormalize(env, gamma=hyperparams["gamma"])
            model, start = build_model("PPO", normalized, hyperparams, SEED), time.process_time()
            model.learn(count)
            rates[mode] = model.num_timesteps / (time.process_time() - start)
            agents[mode] = model, normalized
    print(f"PPO on {name}, frames per second of CPU time:", {mode: round(rate) for mode, rate in rates.items()})
    print(f"ratio {rates['lookahead'] / rates['project']:.2f}")
    for trained, (model, normalized) in agents.items():
        for mode in MODES:

            def act(observation, model=model, normalized=normalized):
                return model.predict(normalized.normalize_obs(observation), deterministic=True)[0]

            _, share, correction, reward = driven(shielded(name, safe_set, mode, horizon), act, 2 * MEASURED)
            print(
                f"trained behind {trained:9s} run behind {mode:9s}: overridden {share:6.1%}, correction "
                f"{correction:.3f}, reward per step {reward:.4f}",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--safe-set", choices=CASES, default="polytope")
    parser.add_argument("--situations", type=int, default=2000)
    parser.add_argument("--steps", type=int, default=150_000)
    options = parser.parse_args()
    if "situations" in options.sections:
        print(f"{'states':>28s}{'situations admitted':>27s}{'us per decision':>35s}{'cvxpy over':>16s}")
        print(
            f"{'environment':18s}{'N':>3s}{'in S':>7s}{'one step':>9s}{'lookahead':>10s}{'bound':>8s}"
            f"{'one step':>9s}{'search':>7s}{'99%':>6s}{'stored':>7s}"
            f"{'cvxpy':>6s}{'search':>8s}{'stored':>8s}{'too far':>8s}"
        )
        for name, horizon in CASES[options.safe_set]:
            print(report(name, options.safe_set, horizon, options.situations), flush=True)
    if "loop" in options.sections:
        loop(options.safe_set)
    if "ends" in options.sections:
        ends()
    if "training" in options.sections:
        training(options.safe_set, options.steps)


if __name__ == "__main__":
    main()
