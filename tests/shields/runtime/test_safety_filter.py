from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from shields.runtime.guard import NumberedErrors
from shields.runtime.safety_filter import MARGIN, MODES, REASONS
from tests.certificates import certificate_of, metric
from tests.plants import random_plant
from tests.product import altered, safety_filter
from tests.shields.edges import edge_of, gained
from tests.shields.runtime.batches import decided_alike

TWO_STATES = random_plant(3, 2, 1)
# Actions are so coarse that float32 steps are visible in the test.
STRONG = altered(TWO_STATES, u_max=1e4)


def many(shield, estimates, shapes, inputs):
    """The decisions about rows of estimates (N, n) and inputs (N, m) and as many shapes, in one batch."""
    return shield.decide_columns(estimates.T, shield.errors_of_many(shapes), inputs.T)


@pytest.fixture(scope="module", params=[(2, 1), (4, 3), pytest.param((3, 2), marks=pytest.mark.slow)], ids=str)
def case(request):
    n, m = request.param
    plant = random_plant(3, n, m)
    return plant, certificate_of(plant)


def test_an_input_that_passes_is_returned_untouched(case):
    plant, certificate = case
    shield = safety_filter(certificate, plant)
    u = 1e-3 * plant.largest_input
    decision = shield.decide(np.zeros(plant.n), 0.01 * certificate.Sigma, u)
    assert not decision.intervened
    np.testing.assert_array_equal(decision.input, u)
    assert decision.reason == "safe"
    u[0] = 99.0  # a copy: a reused buffer changes no decision
    assert decision.input[0] < 1.0


def test_projected_input_is_expressible_in_float32_and_the_closest(case):
    plant, certificate = case
    shield, rng = safety_filter(certificate, plant), np.random.default_rng(1)
    checked = 0
    for _ in range(200):
        estimate = 1.2 * certificate.safe_set.sample(rng)
        wanted = rng.uniform(-1, 1, plant.m) * plant.largest_input
        shape = 0.3 * certificate.Sigma
        decision = shield.decide(estimate, shape, wanted)
        if decision.reason != "projected":
            continue
        checked += 1
        assert (decision.intervened, decision.proved, decision.fallback) == (True, True, False)
        action = (decision.input / plant.largest_input).astype(np.float32)
        np.testing.assert_array_equal(plant.largest_input * action.astype(np.float64), decision.input)
        # No random admissible input is closer by more than the rounding.
        sets = shield.test.reachable(estimate[:, None], shield.errors_of(shape).batch())
        near = decision.input + (wanted - decision.input) * rng.uniform(0, 1, (100, 1))
        others = np.vstack([rng.uniform(-1, 1, (400, plant.m)) * plant.largest_input, near])
        admissible = sets.margins(others.T)[0] >= 0.0
        distances = np.linalg.norm(others - wanted, axis=1)
        best = distances[admissible].min(initial=np.inf)
        assert np.linalg.norm(decision.input - wanted) <= best + 1e-5
    assert checked > 10


@pytest.mark.parametrize(
    "proposed",
    [
        *(np.array([value]) for value in (np.nan, np.inf, 4.0000001, -4.0000001, 1j, 10**400, np.datetime64(1, "s"))),
        np.zeros(2),
        np.zeros((1, 1)),
        *("left", None, object()),
        np.ma.array([1.0], mask=[True]),
        [10**400],
    ],
)
def test_invalid_input_becomes_the_fallback(certificate, loaded, proposed):
    estimate = np.array([0.5, 0.1])
    decision = safety_filter(certificate, loaded).decide(estimate, certificate.Sigma, proposed)
    assert decision.reason == "invalid"
    assert decision.intervened
    assert decision.fallback
    np.testing.assert_allclose(decision.input, certificate.K @ estimate, atol=1e-6)


@pytest.mark.parametrize("estimate", [np.array([np.nan, 0.0]), np.array([np.inf, 0.0]), *map(np.zeros, (3, (2, 1)))])
def test_unusable_estimate_gives_zero_and_no_promise(certificate, loaded, estimate):
    decision = safety_filter(certificate, loaded).decide(estimate, certificate.Sigma, np.ones(1))
    assert decision.reason == "invalid"
    assert not decision.proved
    assert not decision.fallback
    assert (decision.input == 0.0).all()


UNUSABLE_SHAPES = [
    np.full((2, 2), np.nan),
    np.eye(3),
    -np.eye(2),
    np.array([[0.01, 5.0], [5.0, 0.01]]),
    np.array([[0.1, 0.5], [0.0, 0.1]]),
    1e-4 * np.ones(2),
    1e-4 * np.eye(2).ravel(),
    "none",
]


@pytest.mark.parametrize("shape", UNUSABLE_SHAPES)
@pytest.mark.parametrize("mode", MODES)
def test_unusable_error_shape_gives_the_gain_and_no_promise(certificate, loaded, shape, mode):
    estimate = np.array([1.5, 0.5])
    decision = safety_filter(certificate, loaded, mode).decide(estimate, shape, np.ones(1))
    assert decision.reason == "invalid"
    assert decision.intervened
    assert not decision.proved
    assert decision.fallback is (mode != "monitor")
    np.testing.assert_allclose(decision.input, np.ones(1) if mode == "monitor" else certificate.K @ estimate, atol=1e-6)


class Contrary:
    """Raises whatever it likes when asked for numbers."""

    def __array__(self, *args, **kwargs):
        raise RuntimeError("not today")


@pytest.mark.parametrize("states", [2, 3])
def test_decide_never_raises(states):
    plant = random_plant(3, states, states - 1)
    shield = safety_filter(certificate_of(plant), plant)
    good = np.zeros(states), 1e-4 * np.eye(states), np.zeros(plant.m)
    for k in range(3):
        for bad in (Contrary(), [Contrary()], object(), {}, "x", None, 1e-320 * good[k], 1e200 * np.ones_like(good[k])):
            with np.errstate(all="raise"):
                decision = shield.decide(*good[:k], bad, *good[k + 1 :])
            assert np.isfinite(decision.input).all()


def test_wrongly_projected_input_is_not_applied(certificate, loaded, monkeypatch):
    shield = safety_filter(certificate, loaded)
    case = np.array([1.6, 0.5]), 0.1 * certificate.Sigma, np.array([4.0])
    assert shield.decide(*case).reason == "projected"
    for rule in ("set_test.closest_on_line", "projection.closest_on_lines"):
        monkeypatch.setattr(f"shields.runtime.{rule}", lambda wanted, *rest: wanted)
    assert shield.decide(*case).reason == "fallback"
    assert many(shield, *(np.array([each]) for each in case)).reason.tolist() == [REASONS.index("fallback")]


def test_public_helpers_refuse_what_decide_would_call_invalid(certificate, loaded):
    shield = safety_filter(certificate, loaded)
    assert np.isnan(shield.margin(np.zeros(2), certificate.Sigma, np.zeros(3)))
    assert np.isnan(shield.margin(np.array([np.nan, 0.0]), certificate.Sigma, np.zeros(1)))
    assert np.isnan(shield.margin(np.zeros(2), 1e-4 * np.eye(3), np.zeros(1)))
    assert shield.margin([0.0, 0.0], certificate.Sigma.tolist(), [0.0]) > 0.0
    assert not shield.knows_inside(np.array([np.nan, 0.0]), certificate.Sigma)
    assert not shield.knows_inside(np.zeros(2), -certificate.Sigma)


def test_known_inside_ends_at_the_edge(certificate, loaded):
    shield, shape = safety_filter(certificate, loaded), 0.04 * certificate.Sigma
    direction = certificate.safe_set.extreme_point(np.array([1.0, 0.3]))
    radius = np.sqrt(np.linalg.eigvals(metric(certificate) @ shape).real.max())
    assert shield.knows_inside((1.0 - radius - 1e-6) * direction, shape)
    assert not shield.knows_inside((1.0 - radius + 1e-9) * direction, shape)
    assert not shield.knows_inside((1.0 - radius - 0.5 * MARGIN) * direction, shape)  # inside, but by too little


def test_proposed_fallback_is_no_intervention(case):
    plant, certificate = case
    rng = np.random.default_rng(5)
    for mode in ("switch", "monitor"):
        shield, seen = safety_filter(certificate, plant, mode), 0
        for _ in range(200):
            estimate = 3.0 * certificate.safe_set.sample(rng)
            decision = shield.decide(estimate, certificate.Sigma, gained(shield, estimate))
            assert not decision.intervened
            seen += decision.reason == "fallback"
        assert seen > 5


def test_monitor_never_changes_the_input_and_counts_what_switch_would_do(case):
    plant, certificate = case
    monitor, switch = safety_filter(certificate, plant, "monitor"), safety_filter(certificate, plant, "switch")
    rng, counted = np.random.default_rng(6), 0
    for _ in range(200):
        estimate, shape = 1.3 * certificate.safe_set.sample(rng), certificate.Sigma * rng.uniform(0.05, 1.0)
        u = rng.uniform(-1, 1, plant.m) * plant.largest_input * rng.random()
        watched, switched = monitor.decide(estimate, shape, u), switch.decide(estimate, shape, u)
        np.testing.assert_array_equal(watched.input, u)
        assert watched.intervened == switched.intervened
        counted += watched.intervened
        if watched.intervened:
            assert watched.reason == "unsafe"
            assert not watched.proved
            assert not watched.fallback
    assert 5 < counted < 195


def test_boundary_lets_an_input_pass_only_where_every_input_would(case):
    plant, certificate = case
    boundary, switch = safety_filter(certificate, plant, "boundary"), safety_filter(certificate, plant, "switch")
    rng = np.random.default_rng(7)
    seen = set()
    for _ in range(120):
        estimate, shape = certificate.safe_set.sample(rng) * rng.uniform(0, 1.2), 0.1 * certificate.Sigma
        u = rng.uniform(-1, 1, plant.m) * plant.largest_input
        decision = boundary.decide(estimate, shape, u)
        corners = np.array(list(product(*((-limit, limit) for limit in plant.largest_input))))
        all_pass = all(switch.decide(estimate, shape, corner).reason == "safe" for corner in corners)
        assert (decision.reason == "safe") is all_pass
        seen.add(decision.reason)
        if not all_pass:
            np.testing.assert_array_equal(decision.input, gained(boundary, estimate))
    assert "fallback" in seen


def test_the_test_is_passed_with_a_margin_or_not_at_all(certificate, loaded):
    shield = safety_filter(certificate, loaded, "switch")
    shape = 0.1 * certificate.Sigma
    last = edge_of(lambda u: shield.decide(np.array([1.6, 0.0]), shape, np.array([u])).reason == "safe", 4.0, 80)
    sets = shield.test.reachable(np.array([[1.6], [0.0]]), shield.errors_of(shape).batch())
    assert MARGIN * (1 - 1e-6) <= sets.margins(np.array([[last]]))[0].item() <= 2 * MARGIN  # but for its own rounding
    assert MARGIN >= 1e-10


def test_projection_leaves_room_for_float32():
    plant = STRONG
    certificate = certificate_of(plant)
    shield, rng = safety_filter(certificate, plant), np.random.default_rng(0)
    reasons = []
    for _ in range(300):
        estimate = 0.8 * certificate.safe_set.sample(rng)
        reasons.append(shield.decide(estimate, 1e-3 * certificate.Sigma, np.array([1e4])).reason)
    assert set(reasons) == {"projected"}


def random_cases(rng, shield, count):
    """Estimates, error shapes and proposals; some cannot be used, some are what the fallback would do."""
    plant, certificate = shield.plant, shield.certificate
    estimates = certificate.safe_set.sample_boundary(rng, count) * rng.uniform(0.0, 1.3, (count, 1))
    estimates[::3] *= 0.05
    factor = np.linalg.cholesky(certificate.Sigma)
    inner = rng.standard_normal((count, plant.n, plant.n)) * np.exp(rng.uniform(-4.0, 1.0, (count, 1, 1)))
    inner[::5, :, 0] *= 1e-8  # flat ones
    shapes = factor @ inner @ inner.swapaxes(1, 2) @ factor.T
    inputs = rng.uniform(-1.0, 1.0, (count, plant.m)) * plant.largest_input
    inputs[::7] = plant.largest_input
    inputs[::11] = [gained(shield, estimate) for estimate in estimates[::11]]
    estimates[3], estimates[4], estimates[5, 0], estimates[6] = 1e200, np.nan, np.inf, 0.0
    shapes[8], shapes[9], shapes[10], shapes[12, 0, 0] = 0.0, np.nan, -shapes[10], np.inf
    inputs[13, -1], inputs[14], inputs[15, 0] = np.nan, 1.1 * plant.largest_input, -np.inf
    return estimates, shapes, inputs


@pytest.mark.cases(4)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("n", "m"),
    [
        (1, 1),
        (2, 1),
        (4, 3),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in [(2, 2), (3, 2), (4, 1), (6, 3)]),
    ],
)
def test_decisions_one_by_one_equal_those_of_a_batch(n, m, mode):
    plant = altered(random_plant(n, n, m), u_max=0.3 / m)
    shield, rng, count = safety_filter(certificate_of(plant), plant, mode), np.random.default_rng(n + m), 1000
    reasons = decided_alike(shield, *random_cases(rng, shield, count), least=0.99).reason
    unusable = np.isin(np.arange(count), [3, 4, 5, 9, 10, 12, 13, 14, 15])
    np.testing.assert_array_equal(reasons == "invalid", unusable)
    expected = {
        "project": {"safe", "projected"},
        "monitor": {"safe", "unsafe"},
        "lookahead": {"safe", "planned"},
    }
    assert expected.get(mode, {"safe", "fallback"}) <= set(reasons)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", ["ellipsoid", "polytope"])
@pytest.mark.parametrize("states", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_single_decisions_take_off_as_much_for_rounding_as_batches_do(states, kind, mode):
    # As if float64 had five digits.
    plant = altered(random_plant(states, states, 1), u_max=0.3)
    shield, plain = (safety_filter(certificate_of(plant, None, kind), plant, mode) for _ in range(2))
    shield.test.rounding, rng = 1e-5, np.random.default_rng(0)
    estimates, shapes, inputs = random_cases(rng, shield, 100)
    estimates[20:] *= 10.0
    found, others = many(shield, estimates, shapes, inputs), many(plain, estimates, shapes, inputs)
    for e in range(100):
        one = shield.decide(estimates[e], shapes[e], inputs[e])
        assert REASONS[found.reason[e]] == one.reason
        np.testing.assert_allclose(found.margin[e], one.margin, rtol=1e-6)
    same = (found.input == others.input).all(axis=0) & np.isfinite(found.margin)
    assert (others.margin - found.margin)[same].min() > 0.0
    assert same.sum() > 50


def test_numbers_of_error_shapes_count_within_their_table(certificate, loaded):
    shield, sizes = safety_filter(certificate, loaded), np.array([0.1, 0.5, 0.3])
    known, shapes = NumberedErrors(shield), sizes[:, None, None] * certificate.Sigma
    for each in (shapes, shapes[::-1], shapes[1:], shapes):
        stay = np.array([False, True, False])[: len(each)]
        table = SimpleNamespace(shapes=each[:2], shape=each.__getitem__, certified=stay, is_certified=stay.item)
        for growing in (each[:2], each):
            table.shapes = growing
            numbers = np.arange(len(growing))[::-1]
            for k in numbers.tolist():
                assert known.of(table, k).radius == shield.errors_of(growing[k]).radius
                assert known.of(table, k).stays == stay[k]
            found = known.of(table, numbers)
            np.testing.assert_array_equal(found.radius, shield.errors_of_many(growing[::-1]).radius)
            np.testing.assert_array_equal(found.stays, stay[numbers])
