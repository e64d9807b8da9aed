import numpy as np
import pytest

from ncs_gym import truck_trailer
from shields.paper.bounds import PaperModel
from shields.paper.optimization_problem import MarginProgram, VolumeProgram, codesign, grid, solve_op

SMALL = truck_trailer(gamma=1e-6, process_noise_cov=1e-6 * np.eye(2))
POINTS = [(k, 1.0 + (1.0 / k - 1.0) * s) for k in (0.8, 0.86, 0.9, 0.94, 0.98) for s in (0.0, 0.05, 0.3, 0.8)]


@pytest.mark.parametrize(("kappa", "rho"), POINTS)
def test_eliminated_and_updated_program_agrees_with_op_as_printed(kappa, rho):
    bounds = PaperModel(SMALL).at(kappa, rho)
    printed = solve_op(SMALL, bounds)
    assert (MarginProgram(SMALL).largest(bounds) >= bounds.alpha) is (printed is not None)
    volume = VolumeProgram(SMALL).largest(bounds)
    assert np.isfinite(volume) is np.bool_(printed is not None)
    if printed is not None:
        assert volume == pytest.approx(printed.log_det, abs=1e-5)


def test_updating_leaves_nothing_of_the_point_before():
    program, model = VolumeProgram(SMALL), PaperModel(SMALL)
    order = [model.at(kappa, rho) for kappa, rho in POINTS]
    forwards = [program.largest(bounds) for bounds in order]
    backwards = [program.largest(bounds) for bounds in reversed(order)][::-1]
    fresh = [VolumeProgram(SMALL).largest(bounds) for bounds in order]
    np.testing.assert_allclose(forwards, fresh, atol=1e-6)
    np.testing.assert_allclose(backwards, fresh, atol=1e-6)


def test_solution_meets_the_printed_constraints():
    design = codesign(SMALL)
    L, K, bounds = design.L, design.K, design.bounds
    closed = SMALL.A + SMALL.B @ K
    tolerance = 1e-9
    assert np.linalg.eigvalsh(bounds.kappa * L - closed @ L @ closed.T)[0] >= -tolerance
    assert np.linalg.eigvalsh(L)[0] >= bounds.alpha
    assert np.linalg.cond(L) <= bounds.rho * (1 + tolerance)
    assert max(row @ L @ row for row in SMALL.C) <= 1.0
    used = (K @ L @ K.T).item() + np.square(K @ L).sum() * bounds.epsilon_up / bounds.alpha**2
    assert used <= 8.0


def test_several_inputs_share_one_auxiliary_matrix():
    from ncs_gym import LinearPlant

    plant = LinearPlant(
        A=[[0.6, 0.2], [-0.1, 0.7]], B=np.eye(2), C=np.eye(2), u_max=[1.0, 2.0], dt=0.1, gamma=1e-6,
        process_noise_cov=1e-7 * np.eye(2), measurement_noise_cov=1e-6 * np.eye(2), initial_cov=1e-7 * np.eye(2),
    )  # fmt: skip
    bounds = PaperModel(plant).at(0.7, 1.2)
    assert VolumeProgram(plant).largest(bounds) == pytest.approx(solve_op(plant, bounds).log_det, abs=1e-5)


def test_grid_walks_as_printed_and_skips_where_the_bound_is_infinite():
    points = list(grid(0.25, 0.5))
    assert points == [(0.75, 1.0), (0.5, 1.0), (0.5, 1.5), *[(0.25, 1.0 + 0.5 * j) for j in range(6)]]


@pytest.mark.parametrize("steps", [(0.0, 0.1), (0.1, -1.0), (np.nan, 0.1), (0.1, 0.0)])
def test_steps_that_do_not_move_are_refused(steps):
    with pytest.raises(ValueError, match="must be a number > 0"):
        next(grid(*steps))


def test_first_feasible_pair_wins():
    first = codesign(SMALL).bounds
    model, program = PaperModel(SMALL), MarginProgram(SMALL)
    for kappa, rho in grid(0.02, 0.05):
        bounds = model.at(kappa, rho)
        if (kappa, rho) == (first.kappa, first.rho):
            break
        assert program.largest(bounds) < bounds.alpha * (1 + 1e-6)


def test_largest_search_is_no_smaller_than_the_first_and_than_any_point_of_the_grid():
    plant = truck_trailer(gamma=1e-5, process_noise_cov=np.zeros((2, 2)))
    first, largest = codesign(plant), codesign(plant, search="largest")
    assert largest.log_det > first.log_det + 0.1
    model, program = PaperModel(plant), VolumeProgram(plant)
    volumes = [program.largest(model.at(kappa, rho)) for kappa, rho in list(grid(0.02, 0.05))[::7]]
    assert largest.log_det >= max(volumes) - 1e-5


def test_what_is_monotone():
    # alpha, eps and eps_up grow with rho; the margin without the communication error grows with kappa and with rho.
    model, program = PaperModel(SMALL), MarginProgram(SMALL, with_error=False)
    for kappa in (0.85, 0.9, 0.95):
        bounds = [model.at(kappa, rho) for rho in np.linspace(1.0, 0.999 / kappa, 8)]
        for name in ("alpha", "epsilon", "epsilon_up"):
            assert (np.diff([getattr(b, name) for b in bounds]) > 0).all()
        assert (np.diff([max(program.largest(b), 0.0) for b in bounds]) >= -1e-6).all()
    for rho in (1.0, 1.02, 1.05):
        margins = [max(program.largest(model.at(kappa, rho)), 0.0) for kappa in np.linspace(0.8, 0.94, 8)]
        assert (np.diff(margins) >= -1e-6).all()


def test_unknown_search_is_refused():
    with pytest.raises(ValueError, match="search must be"):
        codesign(SMALL, search="best")
