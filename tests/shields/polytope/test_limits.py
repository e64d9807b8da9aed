"""Limits of every kind: proofs of both verifiers, files, decisions by a conic solver, and attacks in every mode."""

from __future__ import annotations

from itertools import product

import cvxpy as cp
import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import AdversarialDisturbance, Ellipsoid
from shields import verify
from shields.polytope import Polytope
from tests.product import safety_filter, vector_shield
from tests.second_verifier.verify import verify_again
from tests.shields.polytope.limits import CHANNEL, CONTRACT, PLANTS, certificate, mixed_values


@pytest.mark.parametrize("name", PLANTS)
def test_both_engines_prove_it_with_the_same_margins(name):
    plant, found = PLANTS[name], certificate(name)
    ours, other = verify(found, plant), verify_again(found, plant)
    assert ours.valid
    assert other.valid
    margins = {condition.name: condition.margin for condition in other.conditions}
    shared = [each for each in ours.conditions if each.name.startswith(("(P)", "(PU)", "(PM)"))]
    assert len(shared) >= 2
    assert sum(each.name.startswith("(PM)") for each in shared) == len(plant.mixed_rows)
    for condition in shared:
        assert condition.margin == pytest.approx(margins[condition.name], rel=1e-9, abs=1e-12)
    assert isinstance(found.safe_set, Polytope)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name not in ("tanks", "hill", "feedthrough"))) for name in PLANTS],
)
def test_decision_is_that_of_extreme_points_and_of_a_conic_solver(name):
    plant, found = PLANTS[name], certificate(name)
    shield, P, rng = safety_filter(found, plant), found.safe_set, np.random.default_rng(0)
    shape, reasons = 0.5 * found.error_shapes[0], []
    reach = Ellipsoid(shape).support(P.rows @ plant.A) + plant.disturbance.support(P.rows)
    own, known = (Ellipsoid(shape).support(faces) for faces in (plant.mixed_rows[:, : plant.n], P.rows))
    rows = np.vstack([np.hstack([P.rows @ plant.A, P.rows @ plant.B]), plant.mixed_rows])
    low = np.concatenate([P.low + reach, plant.mixed_ends[0] + own])
    high = np.concatenate([P.high - reach, plant.mixed_ends[1] - own])
    estimates = P.center + (P.sample_boundary(rng, 50) - P.center) * rng.uniform(0.3, 1.1, (50, 1))
    for estimate, proposed in zip(estimates, rng.uniform(*plant.input_ends, (50, plant.m)), strict=True):
        decision = shield.decide(estimate, shape, proposed)
        inside = min((P.rows @ estimate - P.low - known).min(), (P.high - P.rows @ estimate - known).min())
        assert abs(inside) < 1e-7 or shield.knows_inside(estimate, shape) == (inside > 0.0)
        values = rows @ np.concatenate([estimate, proposed])
        left = min((values - low).min(), (high - values).min())
        if abs(left) > 1e-7:
            assert (decision.reason == "safe") == (left > 0.0)
        assert ((plant.input_ends[0] <= decision.input) & (decision.input <= plant.input_ends[1])).all()
        reasons.append(decision.reason)
        if decision.reason == "safe":
            continue
        u = cp.Variable(plant.m)
        c = rows[:, : plant.n] @ estimate + rows[:, plant.n :] @ u
        kept = [c[np.isfinite(high)] <= high[np.isfinite(high)], c[np.isfinite(low)] >= low[np.isfinite(low)]]
        limits = [u <= plant.input_ends[1], u >= plant.input_ends[0]]
        problem = cp.Problem(cp.Minimize(cp.sum_squares(u - proposed)), kept + limits)
        problem.solve(solver=cp.CLARABEL)
        if problem.status == cp.OPTIMAL and decision.reason == "projected":
            np.testing.assert_allclose(decision.input, u.value, atol=1e-5 * plant.input_half.max())
        elif problem.status == cp.INFEASIBLE:
            assert decision.reason == "fallback"
            wanted = found.resting_input + found.K @ (estimate - found.resting_state)
            clipped = np.clip(wanted, *plant.input_ends)
            np.testing.assert_allclose(decision.input, clipped, atol=1e-6 * plant.input_half.max())
    assert "safe" in reasons
    assert ("fallback" if name == "hill" else "projected") in reasons  # a step moves little of the speed on a hill


@pytest.mark.parametrize("name", ["angle", "tanks"])
def test_boundary_lets_an_input_pass_only_where_both_ends_of_all_inputs_would(name):
    plant, found, rng = PLANTS[name], certificate(name), np.random.default_rng(0)
    boundary, switch = (safety_filter(found, plant, mode) for mode in ("boundary", "switch"))
    P, shape, seen = found.safe_set, 1e-4 * found.error_shapes[0], set()
    for estimate in P.center + (P.sample_boundary(rng, 60) - P.center) * rng.uniform(0.0, 1.0, (60, 1)):
        corners = map(np.array, product(*plant.input_ends.T))
        passed = all(switch.decide(estimate, shape, corner).reason == "safe" for corner in corners)
        assert (boundary.decide(estimate, shape, found.resting_input).reason == "safe") is passed
        seen.add(passed)
    assert seen == {True, False}


@pytest.mark.cases(5)
@pytest.mark.parametrize("mode", ["project", "switch", "boundary", "lookahead"])
@pytest.mark.parametrize("name", PLANTS)
def test_no_limit_is_passed_while_guaranteed(name, mode):
    plant, found, count = PLANTS[name], certificate(name), 40
    P, rng = found.safe_set, np.random.default_rng(1)
    names = {"plant": plant, "channel": CHANNEL, "contract": CONTRACT, "max_episode_steps": 70}
    for disturbance in (AdversarialDisturbance(), AdversarialDisturbance(rows=P.rows), "sphere"):
        env = gym.make_vec("ncs_gym/LinearNCS-v0", num_envs=count, disturbance=disturbance, noise="extreme", **names)
        shield = vector_shield(env, found, mode)
        starts = P.center + 0.9 * (P.sample_boundary(rng, count) - P.center)
        _, info = shield.reset(seed=3, options={"state": starts})
        assert info["shield_guaranteed"].all()
        closest, intervened = -np.inf, 0
        for k in range(60):
            states = info["state"]
            ends = np.sign(rng.uniform(-1.0, 1.0, (count, plant.m)))
            actions = [ends, np.ones_like(ends), -np.ones_like(ends)][k // 20]
            _, _, _, _, info = shield.step(actions.astype(np.float32))
            assert info["shield_guaranteed"].all(), info["shield_reason"]
            assert not info["cost"].any()
            values = info["state"] @ P.rows.T
            if mode != "lookahead":
                assert ((P.low <= values) & (values <= P.high)).all()
            assert ((plant.input_ends[0] <= info["input"]) & (info["input"] <= plant.input_ends[1])).all()
            intervened += info["shield_intervened"].sum()
            if len(plant.mixed_rows):
                passed = mixed_values(plant, states, info["input"])
                np.testing.assert_allclose(info["worst_constraint_values"][:, len(plant.box) :], passed, atol=1e-12)
                closest = max(closest, passed.max())
        assert intervened > 0
        if len(plant.mixed_rows):  # the limit is what binds
            assert (-0.05 if mode in ("project", "lookahead") else -0.5) < closest <= 0.0
