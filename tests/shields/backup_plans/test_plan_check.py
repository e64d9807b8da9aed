"""The plan test against extreme errors and disturbances, sampled ones, and rational arithmetic."""

from decimal import Decimal, localcontext

import numpy as np
import pytest

from ncs_gym import Ellipsoid
from shields.polytope import Polytope
from shields.runtime.backup_plans import PlanTest, Prediction
from shields.runtime.safety_filter import MARGIN
from shields.runtime.set_test import SMALLEST_RADIUS, ellipsoid_test
from shields.verification.rational_matrix import multiply, quadratic, rational
from tests.certificates import metric
from tests.product import linear_plant, safety_filter
from tests.shields.attacks.adversary import farthest
from tests.shields.attacks.cases import case as attacked_case
from tests.shields.edges import edge_of

STEPS = 5
MORE = ("batch reactor", "n=6 m=2 p=3", "batch reactor, polytope")
NAMES = (
    *("cruise", "cart-pole", "n=4 m=3 p=2", "cart-pole, polytope", "servo, polytope alone"),
    *(pytest.param(name, marks=pytest.mark.slow) for name in MORE),
)


@pytest.fixture(scope="module", params=NAMES)
def case(request):
    known = attacked_case(request.param)
    first = safety_filter(known.certificate, known.plant).test
    assert (not first.cone) == ("polytope" in request.param)
    return known.plant, known.certificate, PlanTest(Prediction(first, STEPS), MARGIN)


def situations(plant, certificate, rng, count):
    """Estimates in and around the box, error shapes of all forms inside the certified one, and plans."""
    estimates = rng.uniform(-1, 1, (count, plant.n)) * plant.half_widths * rng.uniform(0.2, 1.5, (count, 1))
    factor = np.linalg.cholesky(certificate.Sigma)
    turns = np.linalg.qr(rng.standard_normal((count, plant.n, plant.n)))[0]
    sizes = 10.0 ** rng.uniform(-3, 0, (count, plant.n))
    shapes = factor @ (turns * (0.7 * sizes)[:, None]) @ turns.swapaxes(1, 2) @ factor.T
    plans = (
        rng.uniform(-1, 1, (count, 1, STEPS, plant.m)) * plant.largest_input * rng.uniform(0.2, 1.0, (count, 1, 1, 1))
    )
    return estimates, 0.5 * (shapes + shapes.swapaxes(1, 2)), plans


def states(plant, x, plan, disturbances):
    """x_1..x_N of the true plant."""
    reached = []
    for u, d in zip(plan, disturbances, strict=True):
        x = plant.A @ x + plant.B @ u + d
        reached.append(x)
    return np.array(reached)


def extreme_ends(plant, x_hat, shape, plan, directions, step):
    """x_{step+1}, shape (k, n), if error and disturbances push it as far as they can in directions (k, n)."""
    pulls = [directions.T]
    for _ in range(step + 1):
        pulls.append(plant.A.T @ pulls[-1])
    x = x_hat[:, None] + farthest(shape, pulls[step + 1])
    for i, u in enumerate(plan[: step + 1]):
        x = plant.A @ x + (plant.B @ u)[:, None] + farthest(plant.disturbance.shape_matrix, pulls[step - i])
    return x.T


def farthest_out_of_box(plant, x_hat, shape, plan, step):
    """The largest |c x_{step+1}|."""
    both = np.concatenate([plant.box, -plant.box])
    return np.abs(extreme_ends(plant, x_hat, shape, plan, both, step) @ plant.box.T).max()


def test_what_may_not_begin_a_plan_begins_none_of_many(case):
    plant, certificate, test = case
    rng = np.random.default_rng(5)
    estimates, shapes, plans = situations(plant, certificate, rng, 300)
    others = plant.largest_input * rng.choice([-1.0, 0.0, 1.0], (300, 40, STEPS, plant.m))
    others[:, :, 0] = plans[:, :, 0]
    tightening = test.tightenings_of(shapes)
    certified = test.certified(estimates, tightening, np.concatenate([plans, others], axis=1))
    may = test.may_begin(estimates, tightening, plans[:, 0, 0])
    assert certified[may].any()
    assert not certified[~may].any()
    assert may.all() == (isinstance(certificate.safe_set, Ellipsoid))  # there the end, S, is not looked at
    assert not test.may_begin(np.full_like(estimates, np.nan), tightening, plans[:, 0, 0]).any() or may.all()


def test_tightenings_are_what_extreme_errors_and_disturbances_attain(case):
    plant, certificate, test = case
    rng = np.random.default_rng(0)
    estimates, shapes, plans = situations(plant, certificate, rng, 6)
    row_limits = test.tightenings_of(shapes).row_limits
    for x_hat, shape, (plan,), limits in zip(estimates, shapes, plans, row_limits, strict=True):
        nominal = states(plant, x_hat, plan, np.zeros((STEPS, plant.n)))
        for step in range(STEPS):
            rows = test.prediction.rows
            reached = (rows * (extreme_ends(plant, x_hat, shape, plan, rows, step) - nominal[step])).sum(axis=1)
            np.testing.assert_allclose(reached, 1.0 - limits[step], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", ["cruise, at all times", "reactor, at all times"])
def test_tightenings_between_samples_are_what_extreme_errors_and_disturbances_attain(name):
    known = attacked_case(name)
    plant, rows = known.plant, known.plant.step_rows[:, : known.plant.n]
    test = PlanTest(Prediction(safety_filter(known.certificate, plant).test, STEPS), MARGIN)
    estimates, shapes, plans = situations(plant, known.certificate, np.random.default_rng(0), 4)
    for x_hat, shape, (plan,), limits in zip(
        estimates, shapes, plans, test.tightenings_of(shapes).between, strict=True
    ):
        nominal = [x_hat, *states(plant, x_hat, plan, np.zeros((STEPS, plant.n)))]
        for step in range(STEPS):
            ends = extreme_ends(plant, x_hat, shape, plan, rows, step - 1)  # of no input for the first
            reached = (rows * (ends - nominal[step])).sum(axis=1)
            np.testing.assert_allclose(plant.step_ends[1] - limits[step], reached, rtol=1e-6, atol=1e-9)


def largest_level(plant, certificate, x_hat, shape, plan, step, rng):
    """Largest |x_{step+1}|_M found by ascent over error and disturbances, from many starts; of a polytope exactly."""
    if isinstance(certificate.safe_set, Polytope):
        ends = extreme_ends(plant, x_hat, shape, plan, certificate.safe_set.F, step)
    else:
        directions = rng.standard_normal((4, plant.n))
        for _ in range(15):
            ends = extreme_ends(plant, x_hat, shape, plan, directions, step)
            directions = ends @ metric(certificate)
    return certificate.safe_set.gauge(ends).max()


@pytest.mark.cases(2)
def test_plans_are_certified_if_every_possible_state_stays_in_the_box_and_ends_in_the_safe_set(case):
    # The box part is exact: where it fails, an error and disturbances leave the box; else the end must be close to S.
    plant, certificate, test = case
    rng = np.random.default_rng(2)
    estimates, shapes, plans = situations(plant, certificate, rng, 60)
    certified = test.certified(estimates, test.tightenings_of(shapes), plans)[:, 0]
    levels, refused, lengths = [0.0], 0, 0
    for x_hat, shape, (plan,), passed in zip(estimates, shapes, plans, certified, strict=True):
        outside = False
        for step in range(STEPS):
            level = 0.0
            if passed[step] or not outside:
                level = largest_level(plant, certificate, x_hat, shape, plan, step, rng)
            if passed[step]:
                assert not outside
                assert farthest_out_of_box(plant, x_hat, shape, plan, step) <= 1.0
                levels.append(level)
                assert level <= 1.0
                lengths += step > 0
            elif not outside:
                # the exact containment in S is sharper than the test, though not by much; in P the test is exact
                assert level > (0.6 if isinstance(certificate.safe_set, Ellipsoid) else 1.0 - 1e-6)
                refused += 1
            outside |= bool(farthest_out_of_box(plant, x_hat, shape, plan, step) > 1.0 + 1e-8)
    assert refused > 5
    assert lengths > 10
    assert max(levels) > 0.9


@pytest.mark.parametrize("where", ["estimate", "shape", "input"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e120, 1e300])
def test_nothing_is_certified_of_what_cannot_be_used(case, where, value):
    plant, certificate, test = case
    estimate, shape = np.zeros((1, plant.n)), 1e-6 * certificate.Sigma[None].copy()
    plan = np.zeros((1, 1, STEPS, plant.m))
    assert test.certified(estimate, test.tightenings_of(shape), plan).any()
    {"estimate": estimate, "shape": shape, "input": plan[:, 0, 0]}[where][0].flat[0] = value
    assert not test.certified(estimate, test.tightenings_of(shape), plan).any()


def test_inputs_beyond_their_limits_are_not_certified(case):
    plant, certificate, test = case
    estimate, shape = np.zeros((1, plant.n)), 1e-6 * certificate.Sigma[None]
    plan = np.zeros((1, 1, STEPS, plant.m))
    plan[0, 0, 2, 0] = np.nextafter(plant.largest_input[0], np.inf)
    certified = test.certified(estimate, test.tightenings_of(shape), plan)[0, 0]
    assert not certified[2:].any()
    assert certified[:2].any()


def test_indefinite_shapes_leave_no_room(case):
    _, certificate, test = case
    tightening = test.tightenings_of(-certificate.Sigma[None])
    assert np.isnan(tightening.row_limits).all()
    assert np.isnan(tightening.radius).all()


def root_of(number):
    """The square root of a fraction, to fifty digits."""
    with localcontext(prec=50):
        return (Decimal(number.numerator) / Decimal(number.denominator)).sqrt()


def exact_reach(plant, row, x_hat, shape, plan):
    """The farthest that an error and disturbances take c x_j from zero after all inputs of a plan, to fifty digits."""
    A, B, D = (rational(matrix) for matrix in (plant.A, plant.B, plant.disturbance.shape_matrix))
    pulls = [rational(row[None])]
    for _ in plan:
        pulls.append(multiply(pulls[-1], A))
    center = multiply(pulls[-1], rational(x_hat[:, None]))[0][0]
    for pull, u in zip(pulls[-2::-1], plan, strict=True):
        center += multiply(multiply(pull, B), rational(u[:, None]))[0][0]
    spread = root_of(quadratic(pulls[-1], rational(shape))) + sum(root_of(quadratic(p, D)) for p in pulls[:-1])
    with localcontext(prec=50):
        return abs(Decimal(center.numerator) / Decimal(center.denominator)) + spread


QUIET = {"u_max": 1.0, "dt": 0.1, "sensor_bound": 0.0, "initial_bound": 0.0}


@pytest.mark.cases(2)
@pytest.mark.parametrize("margin", [0.0, 0.1])
@pytest.mark.parametrize(("where", "step"), [("box", 1), ("box", 2), ("end", 1), ("end", 2)])
def test_plans_are_certified_in_rational_arithmetic_where_large_inputs_cancel(where, step, margin):
    plant = linear_plant(A=[[1e-4]], B=[[1e6, -1e6]], box=[1.0], disturbance_bound=0.0, **QUIET)
    L, steps = (np.array([[1e4]]), step + 1) if where == "box" else (np.eye(1), step)  # one of them is far away
    test, rng = PlanTest(Prediction(ellipsoid_test(L, plant), steps), margin), np.random.default_rng(0)
    nothing, levels = np.zeros((1, 1)), []
    known = test.tightenings_of(nothing[None])
    for _ in range(20):
        plan, first, start = np.zeros((steps, 2)), rng.uniform(-0.9, 0.9), np.array([1e-3 * rng.uniform(-1.0, 1.0)])

        def passes(size, plan=plan, first=first, start=start):
            plan[step - 1] = first, first - size
            return test.certified(start[None], known, plan[None, None])[0, 0, -1]

        passes(edge_of(passes, 1e-5))
        levels.append(exact_reach(plant, plant.box[0], start, nothing, plan[:step]))
    assert 1.0 - margin - 1e-6 < min(levels) <= max(levels) <= 1.0 - margin


@pytest.mark.cases(1)
@pytest.mark.parametrize(("where", "step"), [("box", 2), ("box", 3), ("end", 2), ("end", 3)])
def test_plans_are_certified_in_rational_arithmetic_where_powers_cancel(where, step):
    # A is half of the identity and what its own square annihilates, but for rounding.
    A = 3001.7 * np.array([[0.3, -0.1], [0.9, -0.3]]) + 0.5 * np.eye(2)
    plant = linear_plant(A=A, B=[[0.3], [0.9]], box=[1.0, 1.0], disturbance_bound=0.0, **QUIET)
    L, steps = (1e4 * np.eye(2), step + 1) if where == "box" else (np.diag([1e16, 1.0]), step)
    test, rng = PlanTest(Prediction(ellipsoid_test(L, plant), steps), 0.0), np.random.default_rng(0)
    nothing, levels = np.zeros((2, 2)), []
    known = test.tightenings_of(nothing[None])
    for _ in range(30):
        plan, start = np.zeros((steps, 1)), rng.uniform(0.1, 0.5) * np.array([1.0, 3.0])

        def passes(size, plan=plan, start=start):
            plan[step - 1] = size
            return test.certified(start[None], known, plan[None, None])[0, 0, -1]

        passes(edge_of(passes, 1.0))
        levels.append(exact_reach(plant, np.array([0.0, 1.0]), start, nothing, plan[:step]))
    assert 1.0 - 1e-3 < min(levels) <= max(levels) <= 1.0


@pytest.mark.parametrize("scale", [0.5, 1.0])
def test_nothing_is_certified_where_the_radius_is_too_small_for_the_weights(case, scale):
    plant = case[0]
    L = np.linalg.inv(plant.weight)
    test = PlanTest(Prediction(ellipsoid_test(L, plant), 1), 0.0)
    nothing, plan = np.zeros((1, plant.n)), np.zeros((1, 1, 1, plant.m))
    shape = scale * L[None]
    size = edge_of(lambda s: test.certified(nothing, test.tightenings_of(s * shape), plan)[0, 0, 0], 1e3)
    assert SMALLEST_RADIUS <= test.tightenings_of(size * shape).radius.item() < 1.01 * SMALLEST_RADIUS


@pytest.mark.cases(2)
@pytest.mark.parametrize("size", [1.0, 1e4, 1e7, 1e10])
@pytest.mark.parametrize(
    ("where", "steps", "margin"),
    [("end", 1, 0.0), ("end", 2, 0.0), ("end", 2, 0.05), ("box", 1, 0.0), ("box", 2, 0.0), ("box", 2, 0.05)],
)
def test_plans_are_certified_in_rational_arithmetic_however_far_out_the_estimate_is(where, steps, margin, size):
    plant = linear_plant(A=[[0.5, -0.3], [0.0, 0.0]], B=[[1.0], [0.0]], box=[1.0, 1.0], disturbance_bound=0.0, **QUIET)
    L, horizon = (1e4 * np.eye(2), steps + 1) if where == "box" else (np.eye(2), steps)  # one of them is far away
    test, rng = PlanTest(Prediction(ellipsoid_test(L, plant), horizon), margin), np.random.default_rng(0)
    nothing, inwards, levels = np.zeros((2, 2)), np.array([1.0, 0.0]), []
    known = test.tightenings_of(nothing[None])
    plan = np.array([[0.0], [0.9], [0.0]])[2 - steps : 2 - steps + horizon]
    for _ in range(30):
        far = np.array([0.3, 0.5]) * size * rng.uniform(0.5, 1.0)  # which A annihilates, but for rounding

        def passes(x, far=far):
            return test.certified((far + inwards * x)[None], known, plan[None, None])[0, 0, -1]

        if passes(0.0):
            x_hat = far + inwards * edge_of(passes, 16.0)
            levels.append(exact_reach(plant, inwards, x_hat, nothing, plan[:steps]))
    assert len(levels) > 25
    assert max(levels) <= 1.0 - margin
    assert min(levels) > 1.0 - margin - 1e-13 * size - 1e-6


# Coordinates x = F z in which the second row of the box, and of a root of S, is (-TILT, 1): products with it cancel. F,
# its inverse and S = F F' are exact in float64, since TILT is a whole number, and what is multiplied by it is rounded.
TILT = 20003.0
TILTED = np.array([[1.0, 0.0], [TILT, 1.0]])
ROWS = np.array([[1.0, 0.0], [-TILT, 1.0]])


def test_box_is_certified_in_rational_arithmetic_where_the_error_is_long_and_thin():
    plant = linear_plant(A=0.5 * np.eye(2), B=np.zeros((2, 1)), box=ROWS, disturbance_bound=0.0, **QUIET)
    test, rng = PlanTest(Prediction(ellipsoid_test(1e4 * TILTED @ TILTED.T, plant), 2), 0.0), np.random.default_rng(0)
    nothing, plan, levels = np.zeros((1, 2)), np.zeros((1, 1, 2, 1)), []
    for _ in range(6):
        factor = TILTED @ rng.standard_normal((2, 2)) * [1.0, 0.1]
        shape = factor @ factor.T
        size = edge_of(lambda s, P=shape: test.certified(nothing, test.tightenings_of(s * P[None]), plan)[0, 0, 1], 1e3)
        levels.append(max(exact_reach(plant, row, nothing[0], size * shape, plan[0, 0, :1]) for row in ROWS))
    assert 1.0 - 1e-4 < min(levels) <= max(levels) <= 1.0


@pytest.mark.parametrize("margin", [0.0, 0.1])
@pytest.mark.parametrize("far", [0.0, 1.0, 1e6])
def test_a_state_is_known_to_be_in_the_box_in_rational_arithmetic(far, margin):
    """With an error that is long and thin, or with an estimate so far along the box that it cancels in its row."""
    wide = np.diag([1e-9, 0.9]) @ ROWS
    plant = linear_plant(A=0.5 * np.eye(2), B=np.zeros((2, 1)), box=wide, disturbance_bound=0.0, **QUIET)
    test = PlanTest(Prediction(ellipsoid_test(1e4 * TILTED @ TILTED.T, plant), 1), margin)
    rng = np.random.default_rng(0)
    levels = []
    for _ in range(30):
        x_hat = far * rng.uniform(0.5, 1.0) * np.array([1.0, TILT])
        factor = TILTED @ rng.standard_normal((2, 2)) * [1.0, 0.1]
        shape = factor @ factor.T if far == 0.0 else np.diag([0.0, 1.0])
        size = edge_of(lambda s, P=shape, x=x_hat: test.knows_in_box(x, s * P), 1e3)
        levels.append(max(exact_reach(plant, row, x_hat, size * shape, []) for row in wide))
    assert 1.0 - margin - 1e-2 < min(levels) <= max(levels) <= 1.0 - margin


@pytest.mark.cases(1)
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_end_is_certified_in_rational_arithmetic_where_disturbances_are_long_and_thin(steps):
    # Disturbances that do not move on add up tightly, and so does an error as small as the smallest multiplier.
    rng, levels = np.random.default_rng(0), []
    error = np.diag([0.0, 1e-18])
    for _ in range(20):
        bound = TILTED @ np.diag([1e-3, 1e-2] * rng.uniform(0.5, 1.0, 2)) @ TILTED.T
        plant = linear_plant(A=np.eye(2), B=np.zeros((2, 1)), box=ROWS, disturbance_bound=Ellipsoid(bound), **QUIET)
        test = PlanTest(Prediction(ellipsoid_test(TILTED @ TILTED.T, plant), steps), 0.0)
        known, plan = test.tightenings_of(error[None]), np.zeros((1, 1, steps, 1))
        x = edge_of(lambda x, t=test, k=known, p=plan: t.certified(np.array([[0.0, x]]), k, p)[0, 0, -1], 16.0)
        levels.append(exact_reach(plant, ROWS[1], np.array([0.0, x]), error, plan[0, 0]))
    assert 1.0 - 1e-4 < min(levels) <= max(levels) <= 1.0
