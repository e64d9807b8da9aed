"""Searches for one step that leaves the safe set: by evolution, the decision as a black box, and by ascent."""

import numpy as np
import pytest
from scipy.optimize import differential_evolution

from tests.certificates import certificate_of, metric
from tests.product import safety_filter
from tests.shields.attacks.cases import RANDOM, TRUCKS

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
        u = shield.decide_columns(x + size * e, errors, plant.largest_input[:, None] * numbers[3 * n : -1]).input
        reached = plant.A @ x + plant.B @ u + d
        return -np.sqrt(np.einsum("ik,ij,jk->k", reached, metric(certificate), reached))

    bounds = [(-1.0, 1.0)] * (3 * n + plant.m) + [(1e-3, 1.0)]
    settings = {"maxiter": generations, "popsize": 8, "rng": 0, "polish": False, "tol": 0.0}
    found = differential_evolution(levels, bounds, vectorized=True, updating="deferred", **settings)
    assert -found.fun <= 1.0
    assert -found.fun > (0.5 if mode == "boundary" else 0.9)  # the search does come close
