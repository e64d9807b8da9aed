import clarabel
import numpy as np
import pytest
from scipy.sparse import csc_array

from shields.runtime import projection


def closest_admissible(wanted, offset, effect, radius, limit):
    """The projection of one input, shape (m,), as a batch of one; None if there is none."""
    with np.errstate(all="ignore"):
        columns = wanted[:, None], offset[:, None], effect[:, :, None], np.array([radius])
        found = projection.closest_admissible(*columns, limit)[:, 0]
    return None if np.isnan(found).any() else found


def closest_on_line(wanted, a, b, c, radius, limit):
    """The projection of one number."""
    with np.errstate(all="ignore"):
        found = projection.closest_on_lines(*(np.float64(each) for each in (wanted, a, b, c, radius)), limit)
    alone = projection.closest_on_line(*(float(each) for each in (wanted, a, b, c, radius, limit)))
    np.testing.assert_array_equal(alone, found)  # the two texts of the rule agree bit for bit, on NaN too
    return None if np.isnan(found) else float(found)


class SolverError(Exception):
    """The conic solver has no answer."""


def conic_solution(wanted, offset, effect, radius, limit):
    """The same projection by a conic solver, |offset + effect u| <= radius and |u| <= limit; None if there is none."""
    m = len(wanted)
    rows = np.vstack([np.eye(m), -np.eye(m), np.zeros((1, m)), -effect])  # rows u + slack = limits, slack in the cones
    limits = np.concatenate([limit, limit, [radius], offset])
    cones = [clarabel.NonnegativeConeT(2 * m), clarabel.SecondOrderConeT(1 + len(offset))]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    squares = csc_array(2.0 * np.eye(m)), -2.0 * wanted
    solution = clarabel.DefaultSolver(*squares, csc_array(rows), limits, cones, settings).solve()
    status = clarabel.SolverStatus
    if solution.status in (status.Solved, status.AlmostSolved):
        return np.array(solution.x)
    if solution.status in (status.PrimalInfeasible, status.AlmostPrimalInfeasible):
        return None
    raise SolverError(str(solution.status))


ROWS = 6


def random_case(rng, m):
    n = int(rng.integers(1, ROWS + 1))
    effect = rng.standard_normal((n, m)) * 10.0 ** rng.uniform(-2, 1, m)
    if rng.random() < 0.2:
        effect[:, rng.integers(m)] = 0.0
    if rng.random() < 0.2:  # nearly the same effect twice
        effect[:, -1] = effect[:, 0] * (1.0 + 1e-4 * rng.standard_normal())
    limit = rng.uniform(0.3, 3.0, m)
    wanted = rng.uniform(-1, 1, m) * limit
    offset = rng.standard_normal(n)
    radius = np.linalg.norm(offset) * rng.uniform(0.3, 1.2)
    return wanted, offset, effect, radius, limit


@pytest.mark.cases(1)
@pytest.mark.parametrize("m", [1, 2, 3, 5])
def test_projection_agrees_with_a_conic_solver_in_random_cases(m):
    rng = np.random.default_rng(m)
    compared = bound = failed = 0
    for _ in range(600):
        wanted, offset, effect, radius, limit = random_case(rng, m)
        found = closest_admissible(wanted, offset, effect, radius, limit)
        try:
            expected = conic_solution(wanted, offset, effect, radius, limit)
        except SolverError:
            failed += 1
            continue
        if found is None or expected is None:
            # Only at the edge of feasibility may the two disagree.
            nearest = conic_solution(wanted, offset, effect, radius * (1 + 1e-5), limit)
            tighter = conic_solution(wanted, offset, effect, radius * (1 - 1e-5), limit)
            assert (found is None and tighter is None) or (expected is None and nearest is not None)
            continue
        compared += 1
        assert np.linalg.norm(offset + effect @ found) <= radius * (1 + 1e-9)
        assert (np.abs(found) <= limit).all()
        distance, best = np.linalg.norm(found - wanted), np.linalg.norm(expected - wanted)
        assert distance <= best * (1 + 1e-4) + 1e-6
        bound += bool((np.abs(found) == limit).any()) and distance > 1e-3
        if m == 1:
            a, b, c = (effect.T @ effect).item(), (effect.T @ offset).item(), float(offset @ offset)
            line = closest_on_line(wanted.item(), a, b, c, radius, limit.item())
            assert line == pytest.approx(found.item(), rel=1e-9, abs=1e-9)  # as the scalar shield does it
    assert compared > 120
    assert failed < 4
    assert m == 1 or bound > 8  # cases in which an input limit binds too


def hard_case(rng):
    """Three inputs against two states, with an admissible input that attains some limits just inside the test."""
    effect, offset = rng.standard_normal((2, 3)), 4.0 * rng.standard_normal(2)
    inside = rng.uniform(-1, 1, 3)
    attained = rng.random(3) < 0.5
    inside[attained] = np.sign(inside[attained])
    wanted = np.sign(rng.standard_normal(3)) * rng.uniform(0.8, 1.0, 3)
    return wanted, offset, effect, np.linalg.norm(offset + effect @ inside) * 1.01, np.ones(3)


def test_projection_agrees_with_a_conic_solver_where_limits_bind():
    rng = np.random.default_rng(0)
    branched = 0
    for _ in range(400):
        case = hard_case(rng)
        found, expected = closest_admissible(*case), conic_solution(*case)
        assert found is not None
        distance, best = np.linalg.norm(found - case[0]), np.linalg.norm(expected - case[0])
        assert distance <= best * (1 + 1e-4) + 1e-6
        branched += bool((np.abs(found) == 1.0).any())
    assert branched > 80


@pytest.mark.cases(2)
@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_many_projections_at_once_are_those_one_by_one(m):
    rng, count, n, limit = np.random.default_rng(m), 400, 4, np.linspace(0.5, 1.5, m)
    wanted = rng.uniform(-1.0, 1.0, (m, count)) * limit[:, None]
    offset, effect = 2.0 * rng.standard_normal((n, count)), rng.standard_normal((n, m, count))
    effect[:, -1, ::9] = rng.choice([0.0, -2.0]) * effect[:, 0, ::9]  # only one direction moves, or none
    inside = rng.choice([-1.0, -0.3, 0.3, 1.0], (m, count)) * limit[:, None]
    radius = 1.01 * np.linalg.norm(offset + (effect * inside).sum(axis=1), axis=0)  # some input passes, barely
    radius[::3] *= rng.uniform(0.3, 1.0, len(radius[::3]))
    radius[1], radius[2], wanted[:, 4] = -1.0, np.nan, np.nan
    with np.errstate(all="ignore"):
        found = projection.closest_admissible(wanted, offset, effect, radius, limit)
    assert found.shape == (m, count)
    outcomes = {"none": 0, "limits": 0, "inside": 0}
    for e in range(count):
        one = closest_admissible(wanted[:, e], offset[:, e], effect[:, :, e], radius[e], limit)
        u = found[:, e]
        assert np.isnan(u).any() == (one is None)
        if one is None:
            assert np.isnan(u).all()
            outcomes["none"] += 1
            continue
        outcomes["limits" if (np.abs(u) == limit).any() else "inside"] += 1
        assert (np.abs(u) <= limit).all()
        assert np.linalg.norm(offset[:, e] + effect[:, :, e] @ u) <= radius[e] * (1.0 + 1e-9)
        assert np.linalg.norm(u - wanted[:, e]) == pytest.approx(np.linalg.norm(one - wanted[:, e]), rel=1e-9, abs=1e-9)
    assert np.isnan(found[:, [1, 2, 4]]).all()
    if m == 1:  # what is wanted is within the limit, and so is the closest
        del outcomes["limits"]
    assert min(outcomes.values()) > 15


@pytest.mark.parametrize("m", [2, 3])
def test_converges_where_one_input_does_far_more_than_the_others(m):
    # By another route: the multiplier by bisection, in the axes of a singular value decomposition.
    rng = np.random.default_rng(0)
    for _ in range(80):
        effect = (np.eye(m) + 0.2 * rng.standard_normal((m, m))) * 10.0 ** rng.uniform(-4, 4, m)
        center = rng.standard_normal(m)
        offset = -effect @ center
        radius = np.linalg.norm(offset) * 10.0 ** rng.uniform(-2, 0)
        wanted = center + 100.0 * rng.standard_normal(m)
        found = closest_admissible(wanted, offset, effect, radius, np.full(m, 1e6))
        _, gains, axes = np.linalg.svd(effect)
        away, low, high = axes @ (wanted - center), -100.0, 100.0
        for _ in range(200):
            middle = 0.5 * (low + high)
            outside = np.linalg.norm(gains * away / (1.0 + 10.0**middle * gains**2)) > radius
            low, high = (middle, high) if outside else (low, middle)
        expected = center + axes.T @ (away / (1.0 + 10.0**high * gains**2))
        if np.linalg.norm(offset + effect @ wanted) <= radius:
            expected = wanted
        assert np.linalg.norm(found - wanted) == pytest.approx(np.linalg.norm(expected - wanted), rel=1e-8)


def test_out_of_reach_is_none():
    assert closest_admissible(np.zeros(2), np.array([5.0, 0.0]), np.eye(2), 1.0, np.ones(2)) is None
    assert closest_admissible(np.zeros(1), np.array([2.0, 0.0]), np.zeros((2, 1)), 1.0, np.ones(1)) is None
    assert closest_admissible(np.zeros(1), np.zeros(2), np.ones((2, 1)), -1e-9, np.ones(1)) is None
    assert closest_on_line(0.0, 1.0, 0.0, 0.0, -1e-9, 1.0) is None
    assert closest_on_line(0.0, 1.0, -5.0, 25.0, 1.0, 1.0) is None  # beyond the limit
    assert closest_on_line(0.0, 0.0, 0.0, 25.0, 1.0, 1.0) is None  # the input moves nothing
    assert closest_on_line(0.3, 0.0, 0.0, 0.5, 1.0, 1.0) == 0.3


def test_closest_points_of_one_input_are_the_same_in_numbers_as_in_arrays():
    """Bit for bit, also of rows that no input moves, limits that leave nothing, and NaN."""
    rng, found = np.random.default_rng(0), []
    for _ in range(800):
        rows = rng.integers(1, 6)
        effect = rng.standard_normal(rows) * rng.choice(
            [0.0, 5e-324, 1e-3, 1.0, 1e3], rows, p=[0.1, 0.05, 0.25, 0.3, 0.3]
        )
        offset, limits = 0.5 * rng.standard_normal(rows), rng.uniform(-0.1, 2.0, rows)
        limits[rng.random(rows) < 0.02], offset[rng.random(rows) < 0.02] = np.nan, np.nan
        effect, offset, limits = np.append(effect, 1.0), np.append(offset, 0.1), np.append(limits, 1.5)  # of the input
        wanted = rng.uniform(-1.5, 1.5)
        many = projection.closest_between(np.array([[wanted]]), offset[:, None], effect[:, None], limits[:, None])
        alone = projection.closest_in_interval(wanted, offset.tolist(), effect.tolist(), limits.tolist())
        np.testing.assert_array_equal(alone, many.item())
        found.append(alone == wanted)
    assert 80 < sum(found) < 720


@pytest.mark.parametrize("m", [1, 2, 3])
def test_nothing_is_found_without_a_radius(m):
    still = np.zeros(m)
    assert closest_admissible(still, still, np.eye(m), -1e-9, np.ones(m)) is None
    np.testing.assert_array_equal(closest_admissible(still, still, np.eye(m), 0.0, np.ones(m)), still)
    np.testing.assert_allclose(closest_admissible(still + 0.5, still, np.eye(m), 0.0, np.ones(m)), still, atol=1e-150)
