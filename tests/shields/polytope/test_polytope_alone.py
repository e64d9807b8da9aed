"""Certificates of a polytope alone, where no ellipsoid is found: proved and carried over."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.published import contract_of_plant, plant_of
from ncs_gym import ChannelContract
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.plants.library import batch_reactor
from shields import Infeasible
from shields.polytope import Polytope
from shields.synthesis import polytope_certificates
from shields.synthesis.invariant_polytope import share_in_polytope
from shields.synthesis.polytope_certificates import certified_polytope
from shields.synthesis.resting_point import at_operating_point
from shields.synthesis.tolerance import Tolerance, most_tolerated, regulators
from shields.verification import verify
from tests.certificates import certificate_of
from tests.plants import named, servo, with_radii
from tests.product import linear_plant, synthesize
from tests.verdicts import verified

AGE, BEARABLE = ChannelContract(3), servo(1.0)


@cache
def bearing(polytope):
    """What the gain bears that bears most of all that keep a polytope, or an ellipsoid, of the servo."""
    return most_tolerated(BEARABLE, AGE, polytope=polytope)


def found(name="servo"):
    """Certificate and plant."""
    plant, contract = named(name)
    return certificate_of(plant, contract, "polytope"), plant


def test_where_no_ellipsoid_is_found_a_polytope_is_and_both_verifiers_prove_it():
    _, plant = found()
    certificate = synthesize(plant, contract=AGE)
    assert isinstance(certificate.safe_set, Polytope)
    assert verified(certificate, plant).valid
    assert {proof.shares is None for proof in certificate.proofs} == {True}


def test_ellipsoid_that_is_asked_for_is_infeasible_where_only_a_polytope_is_found():
    with pytest.raises(Infeasible, match=r"\(I\) no invariant ellipsoid in the box"):
        synthesize(found("servo")[1], contract=AGE, safe_set="ellipsoid")


def tolerance_of(plant, contract):
    """What gains bear around the operating point of a plant, and its error sets."""
    errors = certified_error_set(plant, contract).promised
    return Tolerance(plant, errors, plant.disturbance.shape_matrix), errors


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 4))])
def test_margin_of_a_gain_is_what_errors_and_disturbances_reach_together(seed):
    """There are signals that reach the sum of supports; 0.99 times the margin certifies, 1.02 times does not."""
    rng, plant = np.random.default_rng(seed), BEARABLE
    tolerance, errors = tolerance_of(plant, AGE)
    K = bearing(polytope=False).K
    K = K * (1.0 + 0.1 * rng.standard_normal(K.shape))
    margin, D = tolerance.of(K).margin, plant.disturbance.shape_matrix
    closed_loop, reached = plant.A + plant.B @ K, []
    inputs = K / plant.input_half[:, None]
    for number, row in enumerate((*plant.box, *inputs)):
        x, pushes = np.zeros(2), [row]
        while np.abs(pushes[-1] / row.max()).max() > 1e-12:
            pushes.append(pushes[-1] @ closed_loop)
        for push in reversed(pushes[:-1]):  # each step pushes the row where it will end
            supports = [np.sqrt(push @ plant.B @ K @ S @ (push @ plant.B @ K)) for S in errors]
            S = errors[int(np.argmax(supports))]
            e = S @ (push @ plant.B @ K) / max(supports)
            d = D @ push / np.sqrt(push @ D @ push)
            x = closed_loop @ x + plant.B @ (K @ e) + d
        used = row @ x
        if number >= len(plant.box):
            used += max(np.sqrt(row @ S @ row) for S in errors)
        reached.append(used)
    assert 1.0 / max(reached) == pytest.approx(margin, rel=1e-6)
    rest = at_operating_point(plant)
    assert certified_polytope(with_radii(plant, 0.99 * margin), K, AGE, rest)
    with pytest.raises(Infeasible):
        certified_polytope(with_radii(plant, 1.02 * margin), K, AGE, rest)


@pytest.mark.parametrize("make", [lambda: servo(1.0), lambda: servo(1.0, between_samples=4), batch_reactor])
def test_derivatives_of_what_a_gain_needs_are_those_of_differences(make):
    plant, rng = make(), np.random.default_rng(0)
    tolerance, _ = tolerance_of(plant, ChannelContract(1))
    K = tolerance._scaled(regulators(plant)[2])
    step = 1e-6 * np.abs(K).max() * rng.standard_normal(K.shape)
    (_, slopes), *needs = (tolerance._needs_and_slopes(each) for each in (K, K + step, K - step))
    np.testing.assert_allclose(
        (slopes * step).sum(axis=(1, 2)), 0.5 * (needs[0][0] - needs[1][0]), rtol=1e-4, atol=1e-12
    )


def test_most_tolerant_gain_is_the_same_wherever_its_search_begins():
    plant, contract = plant_of("double_integrator"), contract_of_plant("double_integrator")
    tolerance, _ = tolerance_of(plant, contract)
    starts = regulators(plant)
    assert [tolerance.improved(K).margin for K in starts] == pytest.approx(len(starts) * [0.60752], abs=2e-5)


def test_polytope_that_fails_the_exact_check_is_sought_with_a_larger_margin(monkeypatch):
    plant, checked = BEARABLE, []

    def strict(certificate, plant):
        checked.append(certificate)
        return verify(certificate if len(checked) > 1 else replace(certificate, K=2.0 * certificate.K), plant)

    monkeypatch.setattr(polytope_certificates, "verify", strict)
    found = certified_polytope(plant, bearing(polytope=True).K, AGE, at_operating_point(plant))
    assert verified(found, plant).valid
    assert len(checked) == 2
    assert share_in_polytope(found.safe_set, plant) <= share_in_polytope(checked[0].safe_set, plant)


def test_polytope_bears_more_than_an_ellipsoid():
    margin = bearing(polytope=True).margin
    assert margin > 1.15 * bearing(polytope=False).margin
    assert isinstance(synthesize(with_radii(BEARABLE, 0.98 * margin), contract=AGE).safe_set, Polytope)


def test_a_state_that_no_input_moves_may_be_slow():
    model = {"A": [[1.02, 0.1], [0.0, 0.99]], "B": [[0.1], [0.0]], "dt": 0.1, "box": np.eye(2), "u_max": 1.0}
    plant = linear_plant(**model, disturbance_bound=1e-3, sensor_bound=1e-4, initial_bound=1e-3)
    assert synthesize(plant, contract=ChannelContract(2))
