"""Certificates of a polytope alone, where no ellipsoid is found: proved and carried over."""

from __future__ import annotations

import numpy as np
import pytest

from ncs_gym import ChannelContract
from shields import Infeasible
from shields.synthesis.certification import carried_over, nearby_certificate
from shields.synthesis.design_problem import design_problem
from shields.synthesis.max_margin_gain import max_margin_gain
from shields.synthesis.polytope_certificates import certify_polytope
from shields.synthesis.polytope_gain import most_tolerant_gain, polytope_margin
from tests.certificates import certificate_of, feasible_age_not_sought
from tests.plants import named, servo, with_radii
from tests.product import synthesize
from tests.verdicts import verified

AGE = ChannelContract(3)


def found(name="servo"):
    """Certificate and plant."""
    plant, contract = named(name)
    return certificate_of(plant, contract, "polytope"), plant


def test_where_no_ellipsoid_is_found_a_polytope_is_and_both_verifiers_prove_it():
    _, plant = found()
    certificate = synthesize(plant, contract=AGE)
    assert not certificate.keeps_ellipsoid
    assert verified(certificate, plant).valid
    assert {proof.shares is None for proof in certificate.proofs} == {True}
    assert "inside it, not invariant, the ellipsoid" in " ".join(str(certificate).split())
    boundary = certificate.ellipsoid.sample_boundary(np.random.default_rng(0), 2000)
    assert 0.98 < certificate.polytope.gauge(boundary).max() <= 1.0


@pytest.mark.parametrize("name", ["servo", pytest.param("servo, at all times", marks=pytest.mark.slow)])
def test_ellipsoid_that_is_asked_for_is_infeasible_where_only_a_polytope_is_found(name):
    with (
        feasible_age_not_sought(),
        pytest.raises(Infeasible, match=r"\(I\) no invariant ellipsoid in the box|between two samples"),
    ):
        synthesize(found(name)[1], contract=AGE, safe_set="ellipsoid")


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 4))])
def test_margin_of_a_gain_is_what_errors_and_disturbances_reach_together(seed):
    """There are signals that reach the sum of supports; 0.99 times the margin certifies, 1.02 times does not."""
    rng, plant = np.random.default_rng(seed), servo(1.0)
    problem, _ = design_problem(plant, AGE)
    gain = max_margin_gain(problem, problem.covering_error_shape)
    K = gain.K * (1.0 + 0.1 * rng.standard_normal(gain.K.shape))
    margin = polytope_margin(problem, K)
    closed_loop, reached = problem.A + problem.B @ K, []
    for row in (*problem.C, *K):
        x, pushes, used = np.zeros(2), [row], 0.0
        while np.abs(pushes[-1]).max() > 1e-12:
            pushes.append(pushes[-1] @ closed_loop)
        for push in reversed(pushes[:-1]):  # each step pushes the row where it will end
            supports = [np.sqrt(push @ problem.B @ K @ S @ (push @ problem.B @ K)) for S in problem.error_shapes]
            S = problem.error_shapes[int(np.argmax(supports))]
            e = S @ (push @ problem.B @ K) / max(supports)
            d = problem.D_u @ push / np.sqrt(push @ problem.D_u @ push)
            x = closed_loop @ x + problem.B @ (K @ e) + d
        used = row @ x
        if any(np.array_equal(row, own) for own in K):
            used += max(np.sqrt(row @ S @ row) for S in problem.error_shapes)
        reached.append(used)
    assert 1.0 / max(reached) == pytest.approx(margin, rel=1e-6)
    _, physical = problem.to_physical(np.eye(2), K)
    certified = [certify_polytope(with_radii(plant, f * margin), physical, AGE) for f in (0.99, 1.02)]
    assert certified[0] is not None
    assert certified[1] is None


def test_more_tolerant_gain_is_found_and_carried_over_to_easier_problems():
    plant = servo(1.0)
    problem, _ = design_problem(plant, AGE)
    start = max_margin_gain(problem, problem.covering_error_shape)
    margin = most_tolerant_gain(problem, start).margin
    assert margin >= polytope_margin(problem, start.K) > 1.15 * start.margin
    hardest = with_radii(plant, 0.98 * margin)
    certificate = nearby_certificate(hardest, AGE)
    assert not certificate.keeps_ellipsoid
    assert nearby_certificate(hardest, AGE, polytope=False) is None
    assert verified(carried_over(certificate, plant, ChannelContract(2)), plant).valid
    assert carried_over(certificate, hardest, ChannelContract(2)) is certificate
    assert carried_over(certificate, hardest, ChannelContract(4)) is None
