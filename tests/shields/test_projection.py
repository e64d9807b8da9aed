import cvxpy as cp
import numpy as np
import pytest

from shields.projection import closest_admissible


def reference(wanted, offset, effect, radius, limit):
    """The same projection as a conic program."""
    u = cp.Variable(len(wanted))
    constraints = [cp.norm(offset + effect @ u) <= radius, cp.abs(u) <= limit]
    problem = cp.Problem(cp.Minimize(cp.sum_squares(u - wanted)), constraints)
    problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10)
    return u.value if problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) else None


def random_case(rng, m):
    n = int(rng.integers(1, 5))
    effect = rng.standard_normal((n, m)) * 10.0 ** rng.uniform(-2, 1, m)
    if rng.random() < 0.2:
        effect[:, rng.integers(m)] = 0.0
    limit = rng.uniform(0.3, 3.0, m)
    wanted = rng.uniform(-1, 1, m) * limit
    offset = rng.standard_normal(n)
    radius = np.linalg.norm(offset) * rng.uniform(0.3, 1.2)
    return wanted, offset, effect, radius, limit


@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
@pytest.mark.parametrize("m", [1, 2, 3])
def test_projection_agrees_with_a_conic_solver(m):
    rng = np.random.default_rng(m)
    compared = 0
    for _ in range(250):
        wanted, offset, effect, radius, limit = random_case(rng, m)
        found = closest_admissible(wanted, offset, effect, radius, limit)
        expected = reference(wanted, offset, effect, radius, limit)
        if found is None or expected is None:
            # Only at the edge of feasibility may the two disagree.
            nearest = reference(wanted, offset, effect, radius * (1 + 1e-5), limit)
            tighter = reference(wanted, offset, effect, radius * (1 - 1e-5), limit)
            assert (found is None and tighter is None) or (expected is None and nearest is not None)
            continue
        compared += 1
        assert np.linalg.norm(offset + effect @ found) <= radius * (1 + 1e-9)
        assert (np.abs(found) <= limit).all()
        distance, best = np.linalg.norm(found - wanted), np.linalg.norm(expected - wanted)
        assert distance <= best * (1 + 1e-4) + 1e-6
    assert compared > 100


def test_wanted_input_inside_is_returned_as_it_is():
    wanted = np.array([0.1, -0.2])
    found = closest_admissible(wanted, np.zeros(2), np.eye(2), 1.0, np.ones(2))
    np.testing.assert_array_equal(found, wanted)


def test_limits_and_test_can_both_bind():
    found = closest_admissible(np.array([1.0, 1.0]), np.array([2.0, 0.0]), np.eye(2), 1.2, np.array([1.0, 1.0]))
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 801)] * 2), axis=-1).reshape(-1, 2)
    shift = np.array([2.0, 0.0])
    allowed = grid[np.linalg.norm(grid + shift, axis=1) <= 1.2]
    best = np.linalg.norm(allowed - 1.0, axis=1).min()
    assert np.linalg.norm(found - 1.0) == pytest.approx(best, abs=5e-3)


def test_out_of_reach_is_none():
    assert closest_admissible(np.zeros(2), np.array([5.0, 0.0]), np.eye(2), 1.0, np.ones(2)) is None
    assert closest_admissible(np.zeros(1), np.array([2.0, 0.0]), np.zeros((2, 1)), 1.0, np.ones(1)) is None
