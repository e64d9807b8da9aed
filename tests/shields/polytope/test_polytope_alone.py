"""Certificates of a polytope alone, where no ellipsoid is found: proved, and refused when changed."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ncs_gym import ChannelContract
from shields import Certificate, CertificateError, Infeasible, synthesize
from shields.certificate import Proof
from shields.synthesis.certification import carried_over, certify_polytope, nearby_certificate
from shields.synthesis.design_problem import design_problem
from shields.synthesis.max_margin_gain import max_margin_gain
from shields.synthesis.network_requirements import with_radii
from shields.synthesis.polytope_gain import most_tolerant_gain, polytope_margin
from tests.shields.attacks.cases import servo
from tests.shields.polytope.test_polytope_certificate import both

AGE = ChannelContract(3)


@cache
def found(**changes):
    """Certificate and plant."""
    return synthesize(servo(**changes), contract=AGE), servo(**changes)


@pytest.mark.parametrize("changes", [{}, {"factor": 1.1, "between_samples": 4}])
def test_where_no_ellipsoid_is_found_a_polytope_is_and_both_engines_prove_it(changes, tmp_path):
    certificate, plant = found(**changes)
    assert not certificate.keeps_ellipsoid
    assert both(certificate, plant)
    assert {proof.shares is None for proof in certificate.proofs} == {True}
    assert "inside it, not invariant, the ellipsoid" in " ".join(str(certificate).split())
    boundary = certificate.ellipsoid.sample_boundary(np.random.default_rng(0), 2000)
    assert 0.98 < certificate.polytope.gauge(boundary).max() <= 1.0
    certificate.save(tmp_path / "alone.json")
    again = Certificate.load(tmp_path / "alone.json")
    assert again == certificate
    assert both(again, plant)
    with pytest.raises(Infeasible, match=r"\(I\) no invariant ellipsoid in the box|between two samples"):
        synthesize(plant, contract=AGE, safe_set="ellipsoid")


def test_what_is_changed_is_refused_by_both_engines():
    certificate, plant = found()
    polytope = certificate.polytope
    box = len(plant.box_rows)
    wider = np.concatenate([polytope.rows[:box], 0.97 * polytope.rows[box:]])
    fewer = np.where(np.arange(len(polytope.rows)) == np.abs(polytope.multipliers[-1]).argmax(), 0.9, 1.0)
    changed = {
        "L": replace(certificate, L=1.001 * certificate.L),
        "gain": replace(certificate, K=1.02 * certificate.K),
        "rows": replace(certificate, polytope=replace(polytope, rows=wider)),
        "multipliers": replace(certificate, polytope=replace(polytope, multipliers=polytope.multipliers * fewer)),
        "disturbance": replace(certificate, D=0.999 * certificate.D),
        "errors": replace(
            certificate, proofs=tuple(replace(each, Sigma=0.99 * each.Sigma) for each in certificate.proofs)
        ),
    }
    for name, each in changed.items():
        assert not both(each, plant), name
    # Claims that are not there to be proved.
    shares = np.array([0.9, 0.05, 0.05])
    claimed = tuple(replace(each, shares=shares, inputs=np.array([0.5])) for each in certificate.proofs)
    assert not both(replace(certificate, proofs=claimed), plant)


@pytest.mark.parametrize("changes", [{}, {"factor": 1.1, "between_samples": 4}, {"factor": 0.8, "between_samples": 4}])
def test_a_polytope_of_another_dimension_is_refused_by_both_engines(changes):
    certificate, plant = found(**changes)
    for wrong in (certificate.polytope.rows[:, :1], np.pad(certificate.polytope.rows, ((0, 0), (0, 1)))):
        assert not both(replace(certificate, polytope=replace(certificate.polytope, rows=wrong)), plant)


def test_a_candidate_never_makes_the_result_smaller_and_an_ellipsoid_comes_without_a_polytope():
    whole, plant = found(factor=0.8)
    assert whole.keeps_ellipsoid
    smaller = certify_polytope(plant, np.array([[-12.66, -0.034]]), AGE)
    same = certify_polytope(plant, whole.K, AGE)
    assert smaller.provenance["polytope_share_of_box"] < whole.provenance["polytope_share_of_box"]
    for candidate in (smaller, same, whole):
        assert synthesize(plant, contract=AGE, candidates=[candidate]) == whole
    ellipsoid = synthesize(plant, contract=AGE, safe_set="ellipsoid", candidates=[whole])
    assert ellipsoid.polytope is None
    assert ellipsoid == synthesize(plant, contract=AGE, safe_set="ellipsoid")


def test_an_ellipsoid_without_multipliers_needs_a_polytope():
    certificate, _ = found()
    with pytest.raises(CertificateError, match="no multipliers of \\(I\\), and it has no polytope"):
        replace(certificate, polytope=None)
    first, *others = certificate.proofs
    mixed = replace(first, shares=np.array([0.9, 0.05, 0.05]), inputs=np.array([0.5]))
    with pytest.raises(CertificateError, match="either all of its proofs"):
        replace(certificate, proofs=(mixed, *others))
    with pytest.raises(CertificateError, match="both be given, or neither"):
        Proof(Sigma=first.Sigma, rate=first.rate, shares=np.array([0.9, 0.05, 0.05]))
    document = json.loads(json.dumps(certificate.document))
    assert Certificate.read(document) == certificate


@pytest.mark.parametrize("seed", range(4))
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
    certified = [
        certify_polytope(with_radii(plant, disturbance=f * margin, noise=f * margin), physical, AGE)
        for f in (0.99, 1.02)
    ]
    assert certified[0] is not None
    assert certified[1] is None


def test_more_tolerant_gain_is_found_and_carried_over_to_easier_problems():
    plant = servo(1.0)
    problem, _ = design_problem(plant, AGE)
    start = max_margin_gain(problem, problem.covering_error_shape)
    margin = most_tolerant_gain(problem, start).margin
    assert margin >= polytope_margin(problem, start.K) > 1.15 * start.margin
    hardest = with_radii(plant, disturbance=0.98 * margin, noise=0.98 * margin)
    certificate = nearby_certificate(hardest, AGE)
    assert not certificate.keeps_ellipsoid
    assert nearby_certificate(hardest, AGE, polytope=False) is None
    assert both(carried_over(certificate, plant, ChannelContract(2)), plant)
    assert carried_over(certificate, hardest, ChannelContract(2)) is certificate
    assert carried_over(certificate, hardest, ChannelContract(4)) is None
    assert synthesize(plant, contract=AGE, safe_set="ellipsoid", candidates=[certificate]).keeps_ellipsoid
