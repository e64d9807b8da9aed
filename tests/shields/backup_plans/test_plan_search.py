"""The search for plans: as close as another solver gets, and nothing but certified plans whatever a solver does."""

import pickle
from types import SimpleNamespace

import clarabel
import cvxpy as cp
import numpy as np
import pytest

from ncs_gym import Ellipsoid
from ncs_gym.ellipsoid import outer_sum
from tests.certificates import metric
from tests.product import safety_filter
from tests.shields.attacks.cases import case
from tests.shields.runtime.batches import decided_alike

NAMES = ["cruise", "cart-pole", "batch reactor", "n=4 m=3 p=2"]


def shield_of(name, horizon=None):
    known = case(name)
    return safety_filter(known.certificate, known.plant, "lookahead", horizon or known.horizon)


def situations(shield, rng, count):
    """Estimates in the box, small error shapes and proposals."""
    plant = shield.plant
    estimates = rng.uniform(-1, 1, (count, plant.n)) * plant.half_widths * rng.uniform(0.3, 1.0, (count, 1))
    shapes = shield.certificate.error_shapes[0] * rng.uniform(0.01, 0.5, (count, 1, 1))
    return estimates, shapes, rng.uniform(-1, 1, (count, plant.m)) * plant.largest_input


def best_distance(shield, x_hat, shape, proposed, length):
    """Distance from the proposal to the closest first input of a plan of this length, by cvxpy; inf without any.

    The same sets by another route: ellipsoids summed pair by pair, weights from the eigenvalues.
    """
    plant, M = shield.plant, metric(shield.certificate)
    root = np.linalg.cholesky(M).T
    u = cp.Variable((length, plant.m))
    constraints, center, power, disturbed = (
        [cp.abs(u) <= np.tile(plant.largest_input, (length, 1))],
        x_hat,
        np.eye(plant.n),
        0.0,
    )
    sums = None
    for j in range(length):
        D = power @ plant.disturbance.shape_matrix @ power.T
        disturbed = disturbed + np.sqrt(np.einsum("ij,jk,ik->i", plant.box, D, plant.box))
        sums = D if sums is None else outer_sum(sums, D, M)
        center, power = plant.A @ center + plant.B @ u[j], plant.A @ power
        reach = Ellipsoid(power @ shape @ power.T).support(plant.box) + disturbed
        if (reach >= 1.0).any():
            return np.inf
        if j < length - 1:
            constraints.append(cp.abs(plant.box @ center) <= 1.0 - reach)
    values, axes = np.linalg.eigh(root @ outer_sum(power @ shape @ power.T, sums, M) @ root.T)
    h = np.sqrt(values[-1])
    if h >= 1.0:
        return np.inf
    weights = np.sqrt((1 - h) * h / (h - values))
    constraints.append(cp.norm((weights[:, None] * axes.T @ root) @ center) <= 1.0 - h)
    problem = cp.Problem(cp.Minimize(cp.sum_squares((u[0] - proposed) / plant.largest_input)), constraints)
    if plant.m > 1:
        assert np.ptp(plant.largest_input) == 0.0  # or distances in units of the limits would be others
    problem.solve(solver=cp.CLARABEL, tol_feas=1e-9, tol_gap_abs=1e-10, tol_gap_rel=1e-10)
    return plant.largest_input[0] * np.sqrt(max(problem.value, 0.0)) if problem.status == cp.OPTIMAL else np.inf


@pytest.mark.cases(1)
@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
@pytest.mark.parametrize("name", NAMES)
def test_input_applied_is_as_close_to_the_proposal_as_an_independent_solver_gets(name):
    shield, rng = shield_of(name), np.random.default_rng(0)
    reasons, apart = [], []
    for x_hat, shape, proposed in zip(*situations(shield, rng, 30), strict=True):
        decision = shield.decide(x_hat, shape, proposed)
        reasons.append(decision.reason)
        best = min(best_distance(shield, x_hat, shape, proposed, length) for length in (1, shield.horizon))
        if decision.proved:
            distance = np.linalg.norm(decision.input - proposed)
            assert distance <= best + 1e-3 * shield.plant.largest_input[0]
            apart.append(distance)
        else:
            # What is missed lies within the reserve that the solver's precision and float32 take.
            assert best > 0.0
            reasons[-1] = "missed" if best < np.inf else decision.reason
    assert {"safe", "planned"} <= set(reasons)
    assert reasons.count("missed") <= 1
    assert max(apart) > 0.0 or name == "cart-pole"  # there it is all or nothing


def test_plans_are_what_they_say():
    shield, rng = shield_of("batch reactor"), np.random.default_rng(1)
    test, seen = shield.lookahead.planner.test, set()
    for x_hat, shape, proposed in zip(*situations(shield, rng, 150), strict=True):
        decision = shield.decide(x_hat, shape, proposed)
        seen.add(decision.reason)
        assert decision.plan.ndim == 2
        assert decision.plan.shape[1] == shield.plant.m
        assert len(decision.plan) < shield.horizon
        assert decision.intervened == (decision.input != proposed).any()
        assert not decision.stored
        if decision.reason == "planned":
            plan = np.concatenate([decision.input[None], decision.plan])
            padded = np.zeros((1, 1, shield.horizon, shield.plant.m))
            padded[0, 0, : len(plan)] = plan
            certified = test.certified(x_hat[None], test.tightenings_of(shape[None]), padded)[0, 0]
            assert certified[len(plan) - 1]
            actions = decision.plan / shield.plant.largest_input
            np.testing.assert_array_equal(actions.astype(np.float32) * shield.plant.largest_input, decision.plan)
        else:
            assert len(decision.plan) == 0
    assert {"safe", "planned"} <= seen


@pytest.mark.cases(2)
@pytest.mark.parametrize("name", NAMES)
def test_nothing_certified_means_the_next_stored_input_and_without_any_the_gain(name):
    shield, rng = shield_of(name), np.random.default_rng(2)
    plant = shield.plant
    far, shape = 30.0 * plant.half_widths, 0.1 * shield.certificate.Sigma
    stored = plant.largest_input * rng.uniform(-1, 1, (3, plant.m)).astype(np.float32)
    for left in (3, 2, 1):
        decision = shield.decide(far, shape, plant.largest_input, stored)
        assert decision.reason == "stored"
        assert decision.stored
        assert not decision.proved
        assert not decision.fallback
        assert decision.intervened
        np.testing.assert_array_equal(decision.input, stored[0])
        np.testing.assert_array_equal(decision.plan, stored[1:])
        stored = decision.plan
        assert len(stored) == left - 1
    decision = shield.decide(far, shape, plant.largest_input, stored)
    assert decision.reason == "fallback"
    assert decision.fallback
    assert not decision.stored


@pytest.mark.parametrize("what", ["estimate", "shape", "input", "input beyond its limits", "input of another shape"])
def test_what_cannot_be_used_means_the_next_stored_input(what):
    shield = shield_of("cruise")
    nothing, Sigma, stored = np.full(2, np.nan), shield.certificate.Sigma, np.array([[1.0], [2.0]])
    case = {"estimate": np.zeros(2), "shape": 0.1 * Sigma, "input": np.zeros(1)} | {
        "estimate": {"estimate": nothing},
        "shape": {"shape": np.full((2, 2), np.nan)},
        "input": {"input": nothing[:1]},
        "input beyond its limits": {"input": np.array([4.1])},
        "input of another shape": {"input": np.zeros(3)},
    }[what]
    decision = shield.decide(*case.values(), stored)
    assert decision.reason == "stored"
    assert decision.input.tolist() == [1.0]
    assert decision.plan.tolist() == [[2.0]]
    assert shield.decide(*case.values()).reason == "invalid"


@pytest.mark.parametrize("name", ["cruise", "n=4 m=3 p=2"])
def test_horizon_of_one_is_mode_project(name):
    shield, rng = shield_of(name, 1), np.random.default_rng(3)
    project = safety_filter(shield.certificate, shield.plant, "project")
    for x_hat, shape, proposed in zip(*situations(shield, rng, 100), strict=True):
        decision, other = shield.decide(x_hat, shape, proposed), project.decide(x_hat, shape, proposed)
        np.testing.assert_allclose(decision.input, other.input, rtol=2.0**-23)
        assert decision.reason == other.reason
        assert len(decision.plan) == 0


def decisions(shield, cases, stored=()):
    return [shield.decide(*each, stored) for each in zip(*cases, strict=True)]


@pytest.mark.parametrize("name", ["cruise", "batch reactor"])
def test_decisions_are_the_same_after_pickling_and_do_not_depend_on_what_was_decided_before(name):
    shield, rng = shield_of(name), np.random.default_rng(4)
    cases = situations(shield, rng, 60)
    first, again = decisions(shield, cases), decisions(shield, cases)
    backwards = decisions(pickle.loads(pickle.dumps(shield)), [each[::-1] for each in cases])[::-1]
    for one, two, three in zip(first, again, backwards, strict=True):
        assert one.reason == two.reason == three.reason
        for other in (two, three):
            np.testing.assert_array_equal(one.input, other.input)
            np.testing.assert_array_equal(one.plan, other.plan)


class NoArray:
    def __array__(self, *_, **__):
        raise TypeError


NO_PLANS = (
    *(None, "plan", NoArray(), [[1.0], [1.0, 2.0]]),
    *(np.zeros((2, 2)), np.full((1, 1), np.nan), np.full((1, 1), 1e9), np.ones((99, 1))),
)


def test_what_is_no_plan_counts_as_none_stored():
    shield, far = shield_of("cart-pole, polytope"), shield_of("cruise")
    cases = situations(shield, np.random.default_rng(6), 40)
    expected = decisions(shield, cases)
    assert "projected" in {one.reason for one in expected}
    for stored in NO_PLANS:
        for one, other in zip(expected, decisions(shield, cases, stored), strict=True):
            assert one.reason == other.reason
            np.testing.assert_array_equal(one.input, other.input)
    for one, other in zip(expected, decisions(shield, cases, np.zeros((2, 1))), strict=True):
        assert one.reason != "projected" or other.reason in ("projected", "planned")
        assert other.reason != "projected" or len(other.plan) == 0  # nothing is left of the plan before
    for stored in (*NO_PLANS, [[4.1]], np.zeros((9, 1))):  # beyond the limits, and longer than plans are
        decision = far.decide(np.full(2, 30.0), 0.1 * far.certificate.Sigma, np.zeros(1), stored)
        assert decision.reason == "fallback"


@pytest.mark.cases(2)
@pytest.mark.parametrize("name", NAMES)
def test_decisions_one_by_one_equal_those_of_a_batch(name):
    shield, rng, count = shield_of(name), np.random.default_rng(5), 60
    plant = shield.plant
    estimates, shapes, proposed = situations(shield, rng, count)
    stored = np.full((count, shield.horizon, plant.m), np.nan)
    for plan in stored[::2]:
        length = int(rng.integers(1, shield.horizon))
        plan[:length] = plant.largest_input * rng.uniform(-1, 1, (length, plant.m)).astype(np.float32)
    estimates[::9] *= 3.0
    many = decided_alike(shield, estimates, shapes, proposed, stored)
    assert {"planned", "stored"} <= set(many.reason)


def broken_solver(how, rng):
    """A solver that does something wrong when it is made, updated or asked to solve."""

    def fail(*_, **__):
        raise RuntimeError("the solver failed")

    class Solver:
        def __init__(self, P, q, *_):
            self.size = len(q)
            if how == "raises when made":
                fail()

        def update(self, **_):
            if how == "raises when updated":
                fail()

        def solve(self):
            if how == "raises":
                fail()
            x = {
                "NaN": np.full(self.size, np.nan),
                "too short": np.zeros(self.size - 1),
                "garbage": rng.uniform(-1, 1, self.size),
                "too large": rng.uniform(-9, 9, self.size),
                "nothing": None,
            }.get(how)
            return SimpleNamespace(x=x, status="Solved")

    return Solver


FAILURES = "raises when made", "raises when updated", "raises", "NaN", "too short", "garbage", "too large", "nothing"


def break_solver(monkeypatch, how, rng):
    monkeypatch.setattr(clarabel, "DefaultSolver", broken_solver(how, rng))


@pytest.mark.cases(2)
@pytest.mark.parametrize("how", FAILURES)
def test_a_solver_that_fails_means_a_certified_plan_or_the_stored_one(how, monkeypatch):
    shield, rng = shield_of("cart-pole"), np.random.default_rng(6)
    test, reasons = shield.lookahead.planner.test, set()
    cases = situations(shield, rng, 60)
    working = decisions(shield, cases)
    break_solver(monkeypatch, how, rng)
    shield = shield_of("cart-pole")
    stored = np.zeros((4, 1))
    failing = decisions(shield, cases, stored)
    for x_hat, shape, decision in zip(*cases[:2], failing, strict=True):
        reasons.add(decision.reason)
        plan = np.zeros((1, 1, shield.horizon, 1))
        plan[0, 0, 0], plan[0, 0, 1 : len(decision.plan) + 1] = decision.input, decision.plan
        certified = test.certified(x_hat[None], test.tightenings_of(shape[None]), plan)[0, 0]
        assert decision.stored or certified[len(decision.plan)]
    assert "stored" in reasons
    assert sum(one.reason == "planned" for one in working) > sum(one.reason == "planned" for one in failing)
