import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from ncs_gym import ChannelContract, cart_pole, truck_trailer
from ncs_gym.plants.library import batch_reactor
from ncs_gym.plants.lqr import regulator_gain
from shields import Infeasible
from shields.synthesis.design_problem import design_problem
from shields.synthesis.tolerance import invariant_ellipsoid, regulators
from tests.product import library_plant, linear_plant, synthesize

CONTRACT = ChannelContract(2, 1e-4)


def test_its_set_is_the_smallest_that_is_invariant_with_its_gain():
    problem, _ = design_problem(cart_pole(), CONTRACT)
    gain = invariant_ellipsoid(problem, regulators(cart_pole())[1])
    (lx, le, ld), BK, Sigma = gain.multipliers, problem.B @ gain.K, problem.covering_error_shape
    closed_loop = problem.A + BK
    successors = closed_loop @ gain.L @ closed_loop.T / lx + BK @ Sigma @ BK.T / le + problem.D_u / ld
    np.testing.assert_allclose(gain.L, successors, rtol=1e-9, atol=1e-12)
    inputs = np.sqrt([[row @ shape @ row for shape in (gain.L, Sigma)] for row in gain.K]).sum(axis=1)
    box = np.sqrt(np.diag(problem.C @ gain.L @ problem.C.T))
    assert 1.0 / gain.margin == pytest.approx(max(inputs.max(), box.max()), rel=1e-9)


@pytest.mark.parametrize("make", [batch_reactor, cart_pole])
def test_no_other_multipliers_have_a_larger_margin(make):
    problem, _ = design_problem(make(), CONTRACT)
    gain, rng = invariant_ellipsoid(problem, regulators(make())[1]), np.random.default_rng(0)
    Sigma = problem.covering_error_shape
    assert margin_of(problem, Sigma, gain.K, gain.multipliers) == pytest.approx(gain.margin, rel=1e-6)
    for size in np.repeat([0.3, 1e-2, 1e-3], 100):
        shares = np.abs(np.array(gain.multipliers) * (1.0 + size * rng.standard_normal(3)))
        assert margin_of(problem, Sigma, gain.K, shares / max(shares.sum(), 1.0)) < gain.margin * (1.0 + 1e-4)


def margin_of(problem, Sigma, K, multipliers):
    """By which factor all radii may grow, by the sum of a series for the smallest invariant ellipsoid."""
    lx, le, ld = multipliers
    closed_loop, BK = (problem.A + problem.B @ K) / np.sqrt(lx), problem.B @ K
    if np.abs(np.linalg.eigvals(closed_loop)).max() >= 1.0:
        return 0.0
    L = solve_discrete_lyapunov(closed_loop, BK @ Sigma @ BK.T / le + problem.D_u / ld)
    inputs = np.sqrt(np.einsum("ij,jk,ik->i", K, L, K)) + np.sqrt(np.einsum("ij,jk,ik->i", K, Sigma, K))
    return 1.0 / max(inputs.max(), np.sqrt(np.einsum("ij,jk,ik->i", problem.C, L, problem.C)).max())


def test_a_gain_that_does_not_stabilize_has_no_set():
    problem, _ = design_problem(cart_pole(), CONTRACT)
    assert invariant_ellipsoid(problem, np.zeros((1, 4))) is None


PENDULUM = {"A": [[1.1, 0.1], [0.1, 1.0]], "B": [[0.0], [0.1]], "box": [0.3, 1.0], "u_max": 5.0, "dt": 0.1}
SMALL = {"disturbance_bound": [1e-4, 1e-3], "sensor_bound": 1e-3, "initial_bound": (np.eye(2), [1e-3, 1e-3])}


def test_disturbance_that_exceeds_a_limit_alone_is_named():
    plant = library_plant(
        truck_trailer, gamma=0.0, disturbance_bound=2.0, process_noise_cov=np.zeros((2, 2)), sensor_bound=0.01
    )
    exceeded = r"the disturbance of one step alone reaches [\d.]+ times the limit \|coupling stretch\| <= 2 m"
    with pytest.raises(Infeasible, match=exceeded):
        synthesize(plant)


def test_plant_that_no_gain_stabilizes_is_not_blamed_on_its_bounds():
    plant = linear_plant(**PENDULUM | SMALL | {"A": [[1.1, 0.0], [0.0, 0.5]]})
    told = "no gain stabilizes the plant: no input moves x1, which does not decay by itself"
    with pytest.raises(Infeasible, match=told) as caught:
        synthesize(plant, contract=ChannelContract(0))
    assert caught.value.shortfall == 1.0


def test_regulator_decays_as_fast_as_asked_for():
    plant = cart_pole()
    for decay in (0.75, 0.9, 1.0):
        gain = regulator_gain(plant.A, plant.B, 1.0, decay)
        assert np.abs(np.linalg.eigvals(plant.A + plant.B @ gain)).max() < np.sqrt(decay)
    assert regulator_gain(plant.A, np.zeros_like(plant.B), 1.0, 1.0) is None
