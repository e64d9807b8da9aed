import cvxpy as cp
import numpy as np
import pytest

from ncs_gym import truck_trailer
from shields.paper.bounds import PaperModel
from shields.paper.optimization_problem import OptimizationProblem
from shields.paper.synthesis import grid_solutions, kappa_rho_grid
from tests.product import library_plant, linear_plant

SMALL = library_plant(truck_trailer, gamma=1e-6, process_noise_cov=1e-6 * np.eye(2))
POINTS = [(k, 1.0 + (1.0 / k - 1.0) * s) for k in (0.8, 0.9, 0.98) for s in (0.0, 0.3, 0.8)]


def log_det(solution):
    return np.linalg.slogdet(solution.L)[1]


def reduced(plant, bounds):
    """The largest log det L of OP with U and tau eliminated by hand, in the plant's own units; None without one."""
    n, m = plant.n, plant.m
    L, F, beta = cp.Variable((n, n), symmetric=True), cp.Variable((m, n)), cp.Variable()
    closed, identity, zero = plant.A @ L + plant.B @ F, np.eye(n), np.zeros((n, n))
    quotient = bounds.alpha**2 / bounds.epsilon_up * identity
    constraints = [
        cp.bmat([[bounds.kappa * L, closed.T], [closed, L]]) >> 0,
        L >> bounds.alpha * identity,
        cp.diag(plant.box @ L @ plant.box.T) <= 1.0,
        L >> beta * identity,
        L << bounds.rho * beta * identity,
    ]
    for i, limit in enumerate(plant.largest_input):
        row, half = F[i : i + 1, :], np.array([[limit**2 / 2.0]])
        constraints.append(cp.bmat([[half, row, row], [row.T, L, zero], [row.T, zero, quotient]]) >> 0)
    problem = cp.Problem(cp.Maximize(cp.log_det(L)), constraints)
    problem.solve(solver=cp.CLARABEL)
    return problem.value if problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) else None


@pytest.mark.cases(4)
@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
@pytest.mark.parametrize(("kappa", "rho"), POINTS)
def test_op_as_printed_agrees_with_a_program_without_its_auxiliary_variables(kappa, rho):
    bounds, problem = PaperModel(SMALL).at(kappa, rho), OptimizationProblem(SMALL)
    printed, expected = problem.solution(bounds), reduced(SMALL, bounds)
    assert (printed is None) is (expected is None)
    assert (problem.largest_eigenvalue(bounds) >= bounds.alpha) is (printed is not None)
    if printed is not None:
        assert log_det(printed) == pytest.approx(expected, abs=1e-5)


def test_a_point_is_solved_the_same_whatever_was_solved_before():
    problem, bounds = OptimizationProblem(SMALL), [PaperModel(SMALL).at(*point) for point in POINTS]

    def found(each):
        solution = problem.solution(each)
        return problem.largest_eigenvalue(each), solution and (solution.L.tobytes(), solution.K.tobytes())

    assert [found(each) for each in bounds] == [found(each) for each in reversed(bounds)][::-1]


def test_log_det_and_eigenvalue_of_a_known_solution():
    # One state without dynamics: L <= 1 by the box, whatever K is, in units in which the box is 2 wide to each side.
    plant = linear_plant(A=[[0.0]], B=[[1.0]], box=[[0.5]], u_max=1.0, dt=0.1, gamma=1e-9, process_noise_cov=[[1e-9]])
    bounds = PaperModel(plant).at(0.5, 1.5)
    assert OptimizationProblem(plant).largest_eigenvalue(bounds) == pytest.approx(4.0, rel=1e-6)
    assert log_det(OptimizationProblem(plant).solution(bounds)) == pytest.approx(np.log(4.0), abs=1e-6)


def test_solution_meets_the_printed_constraints():
    solution = next(grid_solutions(SMALL))
    L, K, bounds = solution.L, solution.K, solution.bounds
    closed = SMALL.A + SMALL.B @ K
    tolerance = 1e-9
    assert np.linalg.eigvalsh(bounds.kappa * L - closed @ L @ closed.T)[0] >= -tolerance
    assert np.linalg.eigvalsh(L)[0] >= bounds.alpha
    assert np.linalg.cond(L) <= bounds.rho * (1 + tolerance)
    assert max(row @ L @ row for row in SMALL.box) <= 1.0
    used = (K @ L @ K.T).item() + np.square(K @ L).sum() * bounds.epsilon_up / bounds.alpha**2
    assert used <= 8.0


def test_grid_walks_as_printed_and_skips_where_the_bound_is_infinite():
    points = list(kappa_rho_grid(0.25, 0.5))
    assert points == [(0.75, 1.0), (0.5, 1.0), (0.5, 1.5), *[(0.25, 1.0 + 0.5 * j) for j in range(6)]]


def test_what_is_monotone():
    # alpha, eps and eps_up grow with rho; lambda_min(L) without the communication error grows with kappa and with rho.
    model, problem = PaperModel(SMALL), OptimizationProblem(SMALL)

    def eigenvalue(bounds):
        return max(problem.largest_eigenvalue(bounds, with_error=False), 0.0)

    for kappa in (0.85, 0.9, 0.95):
        bounds = [model.at(kappa, rho) for rho in np.linspace(1.0, 0.999 / kappa, 8)]
        for name in ("alpha", "epsilon", "epsilon_up"):
            assert (np.diff([getattr(b, name) for b in bounds]) > 0).all()
        assert (np.diff([eigenvalue(b) for b in bounds]) >= -1e-6).all()
    for rho in (1.0, 1.02, 1.05):
        eigenvalues = [eigenvalue(model.at(kappa, rho)) for kappa in np.linspace(0.8, 0.94, 8)]
        assert (np.diff(eigenvalues) >= -1e-6).all()
