import numpy as np
import pytest

from ncs_gym import LinearPlant, truck_trailer
from shields.paper.algorithm import kappa_rho_grid, search_grid
from shields.paper.bounds import PaperModel
from shields.paper.optimization_problem import solve_op
from shields.paper.reduced_problem import ReducedProblem

SMALL = truck_trailer(gamma=1e-6, process_noise_cov=1e-6 * np.eye(2))
POINTS = [(k, 1.0 + (1.0 / k - 1.0) * s) for k in (0.8, 0.86, 0.9, 0.94, 0.98) for s in (0.0, 0.05, 0.3, 0.8)]


@pytest.mark.parametrize(("kappa", "rho"), POINTS)
def test_reduced_problem_agrees_with_op_as_printed(kappa, rho):
    bounds = PaperModel(SMALL).at(kappa, rho)
    printed = solve_op(SMALL, bounds)
    reduced = ReducedProblem(SMALL)
    assert (reduced.largest_eigenvalue(bounds) >= bounds.alpha) is (printed is not None)
    log_det = reduced.largest_log_det(bounds)
    assert np.isfinite(log_det) is np.bool_(printed is not None)
    if printed is not None:
        assert log_det == pytest.approx(printed.log_det, abs=1e-5)


def test_a_point_is_solved_the_same_whatever_was_solved_before():
    reduced, bounds = ReducedProblem(SMALL), [PaperModel(SMALL).at(*point) for point in POINTS]
    forwards = [reduced.largest_log_det(each) for each in bounds]
    backwards = [reduced.largest_log_det(each) for each in reversed(bounds)][::-1]
    assert forwards == backwards


def test_log_det_and_eigenvalue_of_a_known_solution():
    # One state without dynamics: L <= 1 by the box, whatever K is, in units in which the box is 2 wide to each side.
    plant = LinearPlant(A=[[0.0]], B=[[1.0]], box=[[0.5]], u_max=1.0, dt=0.1, gamma=1e-9, process_noise_cov=[[1e-9]])
    bounds = PaperModel(plant).at(0.5, 1.5)
    assert ReducedProblem(plant).largest_eigenvalue(bounds) == pytest.approx(4.0, rel=1e-6)
    assert ReducedProblem(plant).largest_log_det(bounds) == pytest.approx(np.log(4.0), abs=1e-6)


def test_solution_meets_the_printed_constraints():
    solution = search_grid(SMALL)
    L, K, bounds = solution.L, solution.K, solution.bounds
    closed = SMALL.A + SMALL.B @ K
    tolerance = 1e-9
    assert np.linalg.eigvalsh(bounds.kappa * L - closed @ L @ closed.T)[0] >= -tolerance
    assert np.linalg.eigvalsh(L)[0] >= bounds.alpha
    assert np.linalg.cond(L) <= bounds.rho * (1 + tolerance)
    assert max(row @ L @ row for row in SMALL.C) <= 1.0
    used = (K @ L @ K.T).item() + np.square(K @ L).sum() * bounds.epsilon_up / bounds.alpha**2
    assert used <= 8.0


def test_several_inputs_share_one_auxiliary_matrix():
    plant = LinearPlant(
        A=[[0.6, 0.2], [-0.1, 0.7]], B=np.eye(2), box=np.eye(2), u_max=[1.0, 2.0], dt=0.1, gamma=1e-6,
        process_noise_cov=1e-7 * np.eye(2), measurement_noise_cov=1e-6 * np.eye(2), initial_cov=1e-7 * np.eye(2),
    )  # fmt: skip
    bounds = PaperModel(plant).at(0.7, 1.2)
    assert ReducedProblem(plant).largest_log_det(bounds) == pytest.approx(solve_op(plant, bounds).log_det, abs=1e-5)


def test_grid_walks_as_printed_and_skips_where_the_bound_is_infinite():
    points = list(kappa_rho_grid(0.25, 0.5))
    assert points == [(0.75, 1.0), (0.5, 1.0), (0.5, 1.5), *[(0.25, 1.0 + 0.5 * j) for j in range(6)]]


@pytest.mark.parametrize("steps", [(0.0, 0.1), (0.1, -1.0), (np.nan, 0.1), (0.1, 0.0)])
def test_steps_that_do_not_move_are_refused(steps):
    with pytest.raises(ValueError, match="must be a number > 0"):
        next(kappa_rho_grid(*steps))


def test_first_feasible_pair_wins():
    first = search_grid(SMALL).bounds
    model, reduced = PaperModel(SMALL), ReducedProblem(SMALL)
    for kappa, rho in kappa_rho_grid(0.02, 0.05):
        bounds = model.at(kappa, rho)
        if (kappa, rho) == (first.kappa, first.rho):
            break
        assert reduced.largest_eigenvalue(bounds) < bounds.alpha * (1 + 1e-6)


def test_largest_search_is_no_smaller_than_the_first_and_than_any_point_of_the_grid():
    plant = truck_trailer(gamma=1e-5, process_noise_cov=np.zeros((2, 2)))
    grid = {"dkappa": 0.03, "drho": 0.08}
    first, largest = search_grid(plant, **grid), search_grid(plant, search="largest", **grid)
    assert largest.log_det > first.log_det + 0.1
    model, reduced = PaperModel(plant), ReducedProblem(plant)
    volumes = [reduced.largest_log_det(model.at(kappa, rho)) for kappa, rho in list(kappa_rho_grid(**grid))[::5]]
    assert largest.log_det >= max(volumes) - 1e-5


def test_what_is_monotone():
    # alpha, eps and eps_up grow with rho; lambda_min(L) without the communication error grows with kappa and with rho.
    model, reduced = PaperModel(SMALL), ReducedProblem(SMALL)

    def eigenvalue(bounds):
        return max(reduced.largest_eigenvalue(bounds, with_error=False), 0.0)

    for kappa in (0.85, 0.9, 0.95):
        bounds = [model.at(kappa, rho) for rho in np.linspace(1.0, 0.999 / kappa, 8)]
        for name in ("alpha", "epsilon", "epsilon_up"):
            assert (np.diff([getattr(b, name) for b in bounds]) > 0).all()
        assert (np.diff([eigenvalue(b) for b in bounds]) >= -1e-6).all()
    for rho in (1.0, 1.02, 1.05):
        eigenvalues = [eigenvalue(model.at(kappa, rho)) for kappa in np.linspace(0.8, 0.94, 8)]
        assert (np.diff(eigenvalues) >= -1e-6).all()


def test_unknown_search_is_refused():
    with pytest.raises(ValueError, match="search must be"):
        search_grid(SMALL, search="best")


def test_largest_set_is_the_solution_of_op_as_printed():
    bounds = PaperModel(SMALL).at(0.9, 1.05)
    printed, found = solve_op(SMALL, bounds), ReducedProblem(SMALL).largest_set(bounds)
    np.testing.assert_allclose(found[0], printed.L, atol=1e-3)
    np.testing.assert_allclose(found[1], printed.K, atol=5e-3)
    assert np.linalg.slogdet(found[0])[1] == pytest.approx(ReducedProblem(SMALL).largest_log_det(bounds), abs=1e-5)


def test_largest_set_without_the_margin_exists_where_op_has_none():
    plant = truck_trailer()
    bounds, reduced = PaperModel(plant).at(0.9, 1.05), ReducedProblem(truck_trailer())
    assert reduced.largest_set(bounds) is None
    L, K = reduced.largest_set(bounds, with_margin=False, with_error=False)
    assert np.linalg.eigvalsh(L)[0] < bounds.alpha
    closed = plant.A + plant.B @ K
    assert np.linalg.eigvalsh(0.9 * L - closed @ L @ closed.T)[0] >= -1e-6
    assert (K @ L @ K.T).item() <= 8.0 + 1e-6
