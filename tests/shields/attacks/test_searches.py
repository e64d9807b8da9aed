"""Searches for one step that leaves the safe set: by evolution, the decision as a black box, and by ascent."""

import numpy as np
import pytest
from scipy.optimize import differential_evolution

from tests.certificates import certificate_of, metric
from tests.product import safety_filter
from tests.shields.attacks.cases import RANDOM, TRUCKS
from tests.shields.edges import gained

PLANTS = TRUCKS | RANDOM


@pytest.mark.cases(4)
@pytest.mark.parametrize("mode", ["project", "switch", "boundary"])
@pytest.mark.parametrize("generations", [60, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["4000 kg", "n=2 m=1 p=1", "n=3 m=2 p=1", "n=4 m=3 p=2"])
def test_no_search_over_state_error_disturbance_and_proposal_leaves_the_safe_set(name, generations, mode):
    # Gradient-free, the decision as a black box: x in S, e in E(Sigma_k), d in E(D), any proposal, any Sigma_k.
    plant = PLANTS[name]
    certificate, n = certificate_of(plant), plant.n
    shield = safety_filter(certificate, plant, mode)
    inside = [certificate.safe_set.factor, certificate.error_set.factor, plant.disturbance.factor]

    def levels(numbers):  # of many candidates, one per column
        balls = numbers[: 3 * n].reshape(3, n, -1)
        balls = balls / np.maximum(np.linalg.norm(balls, axis=1, keepdims=True), 1.0)
        size = numbers[-1]
        x, e, d = (factor @ ball for factor, ball in zip(inside, balls, strict=True))
        errors = shield.errors_of_many(size[:, None, None] ** 2 * certificate.Sigma)
        u = shield.decide_columns(x + size * e, errors, plant.u_max[:, None] * numbers[3 * n : -1]).input
        reached = plant.A @ x + plant.B @ u + d
        return -np.sqrt(np.einsum("ik,ij,jk->k", reached, metric(certificate), reached))

    bounds = [(-1.0, 1.0)] * (3 * n + plant.m) + [(1e-3, 1.0)]
    settings = {"maxiter": generations, "popsize": 8, "rng": 0, "polish": False, "tol": 0.0}
    found = differential_evolution(levels, bounds, vectorized=True, updating="deferred", **settings)
    assert -found.fun <= 1.0
    assert -found.fun > (0.5 if mode == "boundary" else 0.9)  # the search does come close


@pytest.mark.parametrize("name", PLANTS)
def test_no_ascent_over_state_error_and_disturbance_leaves_the_safe_set_under_the_gain(name):
    # (I) by another route: coordinate ascent from many starts, the input rounded as it is applied.
    plant = PLANTS[name]
    certificate = certificate_of(plant)
    shield, rng = safety_filter(certificate, plant), np.random.default_rng(0)
    closed, gain = plant.A + plant.B @ certificate.K, plant.B @ certificate.K
    safe, errors, M = certificate.safe_set, certificate.error_set, metric(certificate)
    lx, le, ld = certificate.proofs[-1].shares
    reach = (
        closed @ certificate.safe_set.shape_matrix @ closed.T / lx
        + gain @ certificate.Sigma @ gain.T / le
        + certificate.D / ld
    )
    worst, bound = 0.0, np.sqrt(np.linalg.eigvals(M @ reach).real.max())
    for _ in range(60):
        slope = rng.standard_normal(plant.n)
        for _ in range(40):
            x, e, d = (
                safe.extreme_point(closed.T @ slope),
                errors.extreme_point(gain.T @ slope),
                plant.disturbance.extreme_point(slope),
            )
            slope = M @ (closed @ x + gain @ e + d)
        u = gained(shield, x + e)
        assert (np.abs(u) <= plant.u_max).all()
        worst = max(worst, safe.gauge(plant.A @ x + plant.B @ u + d))
    assert worst <= bound + 1e-7  # `bound` leaves the rounding of actions out
    assert worst > 0.9 * bound
    assert bound <= 1.0
