import re
from dataclasses import replace

import numpy as np
import pytest

from ncs_gym import Ellipsoid, truck_trailer
from shields import CertificateError, synthesize
from shields.verification import require_valid
from tests.certificates import certificate_of, with_proof
from tests.plants import random_plant
from tests.verdicts import verified


def broken(certificate, plant) -> list[str]:
    return [condition.name for condition in verified(certificate, plant).conditions if not condition.holds]


def with_multipliers(certificate, **change):
    moved = replace(certificate.multipliers, **change)
    shares = moved.state, moved.estimate, moved.disturbance
    changed = with_proof(certificate, rate=moved.error, shares=shares, inputs=moved.inputs)
    return replace(changed, rounding=moved.rounding)


def of_three_states(certificate):
    proofs = (replace(certificate.proofs[0], Sigma=np.eye(3)),)
    return replace(certificate, L=np.eye(3), K=np.ones((1, 3)), D=np.eye(3), proofs=proofs)


def test_synthesized_certificate_is_valid(certificate, loaded):
    report = verified(certificate, loaded)
    assert report.valid
    assert all(condition.margin >= 0.0 for condition in report.conditions)
    names = " ".join(condition.name for condition in report.conditions)
    assert all(mark in names for mark in ("(E0)", "(E1)", "(I)", "(S) c_1", "(S) c_2", "(U)", "D:", "N:", "r0:"))


MUTATIONS = {
    "shrunken M": (lambda c: replace(c, L=1.01 * c.L), ["(S)"]),
    "slightly enlarged L": (lambda c: replace(c, L=(1 + 1e-5) * c.L), ["(S)"]),
    "shrunken L": (lambda c: replace(c, L=0.002 * c.L), ["(I)"]),
    "wrong sign of K": (lambda c: replace(c, K=-40.0 * c.K - 1.0), ["(I)", "(U)"]),
    "large K": (lambda c: replace(c, K=c.K + 4.0), ["(I)", "(U)"]),
    "shrunken Sigma": (lambda c: with_proof(c, Sigma=0.5 * c.Sigma), ["(E1)"]),
    "tiny Sigma": (lambda c: with_proof(c, Sigma=1e-4 * c.Sigma), ["(E0)", "(E1)"]),
    "small D": (lambda c: replace(c, D=0.9 * c.D), ["D:"]),
    "D a hair too small": (lambda c: replace(c, D=(1 - 1.1e-9) * c.D), ["D: the certificate's"]),
    "denormal multiplier": (lambda c: with_multipliers(c, state=1e-320), ["(I)"]),
    "denormal rate": (lambda c: with_multipliers(c, error=1e-320), ["(E1)"]),
    "swapped multipliers": (
        lambda c: with_multipliers(c, state=c.multipliers.disturbance, disturbance=c.multipliers.state),
        ["(I)"],
    ),
    "wrong rate": (lambda c: with_multipliers(c, error=0.999), ["(E1)"]),
    "multipliers above one": (lambda c: with_multipliers(c, state=0.99, estimate=0.5), ["lx + le + ld"]),
    "negative multiplier": (lambda c: with_multipliers(c, estimate=-0.1), ["lx, le, ld, s > 0"]),
    "zero multiplier": (lambda c: with_multipliers(c, disturbance=0.0), ["lx, le, ld, s > 0"]),
    # With a rate or multiplier below zero the sums of (E1) and (U) have terms of the wrong sign, and hold.
    "negative rate": (lambda c: with_multipliers(c, error=-0.5), ["0 < lam_e < 1"]),
    "negative input multiplier": (lambda c: with_multipliers(c, inputs=(-0.5,)), ["0 < mu_i < 1"]),
    "rate of zero": (lambda c: with_multipliers(c, error=0.0), ["0 < lam_e < 1"]),
    "rate of one": (lambda c: with_multipliers(c, error=1.0), ["0 < lam_e < 1"]),
    "input multiplier of one": (lambda c: with_multipliers(c, inputs=(1.0,)), ["0 < lam_e < 1"]),
    "no input multiplier": (lambda c: with_multipliers(c, inputs=()), ["shapes"]),
    "infinite multiplier": (lambda c: with_multipliers(c, rounding=float("inf")), ["finite"]),
    "NaN multiplier": (lambda c: with_multipliers(c, state=float("nan")), ["finite"]),
    "lopsided L": (lambda c: replace(c, L=c.L + 1e-12 * np.eye(2, k=1)), ["L > 0", "(I)"]),
    "flat L": (lambda c: replace(c, L=np.diag([3.9, 0.0])), ["L > 0", "(I)"]),
    "negative L": (lambda c: replace(c, L=-c.L), ["L > 0", "(I)"]),
    "other plant": (lambda c: replace(c, fingerprint="0" * 64), ["plant"]),
    "other size": (lambda c: of_three_states(c), ["shapes"]),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_mutation_is_rejected_for_the_right_condition(name, certificate, loaded):
    mutate, expected = MUTATIONS[name]
    found = broken(mutate(certificate), loaded)
    assert len(found) >= 1
    for mark in expected:
        assert any(mark in condition for condition in found), (mark, found)
    # It names the first that is broken; another plant in words.
    name = "another plant" if found[0].startswith("plant") else re.escape(found[0])
    with pytest.raises(CertificateError, match=name):
        require_valid(mutate(certificate), loaded)


def test_a_valid_certificate_passes_as_required(certificate, loaded):
    require_valid(certificate, loaded)


def test_failed_conditions_have_a_negative_margin(certificate, loaded):
    for mutate, _ in MUTATIONS.values():
        assert all(c.margin < 0.0 for c in verified(mutate(certificate), loaded).conditions if not c.holds)


def test_float32_rounding_of_actions_is_part_of_the_condition():
    # Without slack for it a certificate that is tight in (I) would pass; the exact D_u must reject it.
    plant = random_plant(3, 2, 1)
    certificate = certificate_of(plant)
    assert verified(certificate, plant).valid
    assert broken(with_multipliers(certificate, rounding=1e-30), plant) != []


def test_plant_with_a_looser_bound_rejects_the_certificate(certificate, loaded):
    looser = truck_trailer(mass=4000.0, gamma=6e-4)
    assert not verified(replace(certificate, fingerprint=looser.fingerprint), looser).valid
    worse_start = truck_trailer(mass=4000.0, initial_cov=0.1 * np.eye(2))
    found = broken(replace(certificate, fingerprint=worse_start.fingerprint), worse_start)
    assert any("(E0)" in name for name in found)


@pytest.mark.parametrize("change", [{"error": "x"}, {"inputs": 0.5}, {"inputs": None}, {"state": None}])
def test_multipliers_that_are_not_numbers_are_refused(certificate, change):
    with pytest.raises(CertificateError):
        with_multipliers(certificate, **change)


def test_margins_agree_with_floating_point(certificate, loaded):
    margins = {condition.name.split()[0]: condition.margin for condition in verified(certificate, loaded).conditions}
    c, p, multipliers = certificate, loaded, certificate.multipliers
    grown = p.A @ c.Sigma @ p.A.T / multipliers.error + c.D / (1 - multipliers.error)
    assert margins["(E1)"] == pytest.approx(np.linalg.eigvalsh(c.Sigma - grown)[0], rel=1e-6)
    closed, gain = p.A + p.B @ c.K, p.B @ c.K
    grown = closed @ c.L @ closed.T / multipliers.state + gain @ c.Sigma @ gain.T / multipliers.estimate
    D_u = (1 + multipliers.rounding) * c.D + (1 + 1 / multipliers.rounding) * p.B @ p.B.T * (4.0 * 2**-24) ** 2
    assert margins["(I)"] == pytest.approx(np.linalg.eigvalsh(c.L - grown - D_u / multipliers.disturbance)[0], rel=1e-5)


def test_margins_of_several_inputs_agree_with_floating_point():
    # Large limits and a small multiplier s, so that the rounding of actions counts in (I) and in (U).
    plant = replace(random_plant(3, 3, 2), u_max=[1e3, 2e3])
    certificate = with_multipliers(synthesize(plant), rounding=1e-9)
    c, s = certificate, certificate.multipliers
    margins = {condition.name.split(" stays")[0]: condition.margin for condition in verified(c, plant).conditions}
    closed, gain = plant.A + plant.B @ c.K, plant.B @ c.K
    spread = 2 * plant.B @ np.diag((plant.u_max * 2.0**-24) ** 2) @ plant.B.T
    D_u = (1 + s.rounding) * c.D + (1 + 1 / s.rounding) * spread
    grown = closed @ c.L @ closed.T / s.state + gain @ c.Sigma @ gain.T / s.estimate + D_u / s.disturbance
    invariance = next(value for name, value in margins.items() if name.startswith("(I)"))
    assert invariance == pytest.approx(np.linalg.eigvalsh(c.L - grown)[0], rel=1e-6)
    for i, mu in enumerate(s.inputs):
        used = c.K[i] @ c.L @ c.K[i] / mu + c.K[i] @ c.Sigma @ c.K[i] / (1 - mu)
        limit = (plant.u_max[i] * (1 - 2.0**-24)) ** 2
        assert used > 1e-3 * c.K[i] @ c.L @ c.K[i]
        assert margins[f"(U) input {i + 1}"] == pytest.approx(limit - used, rel=1e-12)


def test_report_prints_the_verdict_and_one_line_per_condition(certificate, loaded):
    report = verified(certificate, loaded)
    verdict, *lines = str(report).splitlines()
    assert verdict == f"valid: {len(lines)} of {len(lines)} conditions hold in exact arithmetic"
    assert [line.split("  ")[-1] for line in lines] == [condition.name for condition in report.conditions]
    report = verified(replace(certificate, K=certificate.K + 4.0), loaded)
    verdict, *lines = str(report).splitlines()
    broken = [condition.name for condition in report.conditions if not condition.holds]
    assert verdict == f"not valid: {len(broken)} of {len(lines)} conditions broken"
    assert [line.split("  ")[-1] for line in lines if line.startswith("BROKEN")] == broken
    assert any(line.startswith("BROKEN") and "(U)" in line for line in lines)
    assert any(line.startswith("holds") and "(E1)" in line for line in lines)


def test_report_prints_conditions_that_differ_in_the_age_alone_once_and_every_broken_one():
    from shields.verification import Condition, Report

    held = [Condition(f"(I) of Sigma at age {age}", margin, True) for age, margin in enumerate((3.0, 1.0, 2.0))]
    others = [Condition("(C0) of Sigma_0", 0.5, True), Condition("(S) c_1", 0.1, True), Condition("(S) c_2", 0.2, True)]
    verdict, *lines = str(Report((*held, *others))).splitlines()
    assert verdict == "valid: 6 of 6 conditions hold in exact arithmetic"
    assert lines == [
        "holds   +1.000e+00  (I) of Sigma at age 1 (the least of 3)",
        "holds   +5.000e-01  (C0) of Sigma_0",
        "holds   +1.000e-01  (S) c_1",
        "holds   +2.000e-01  (S) c_2",
    ]
    broken = [replace(condition, holds=False) for condition in held[1:]]
    assert str(Report((held[0], *broken))).splitlines() == [
        "not valid: 2 of 3 conditions broken",
        "holds   +3.000e+00  (I) of Sigma at age 0",
        "BROKEN  +1.000e+00  (I) of Sigma at age 1",
        "BROKEN  +2.000e+00  (I) of Sigma at age 2",
    ]


def replaced(plant, **values):
    """The plant with numbers or derived bounds replaced and nothing derived anew, as a faulty derivation leaves it."""
    assert plant.fingerprint
    assert plant.disturbance.dim == plant.initial_error.dim
    faulty = object.__new__(type(plant))
    faulty.__dict__.update(plant.__dict__ | values)
    return faulty


# Each breaks one condition and no other: a verifier without it would accept. (certificate, plant) -> the same, broken.
ALONE = {
    "plant": lambda c, p: (replace(c, fingerprint="0" * 64), p),
    "shapes": lambda c, p: (with_multipliers(c, inputs=(0.5, 0.5)), p),
    "finite": lambda c, p: (with_multipliers(c, rounding=float("inf")), p),
    "0 < lam_e < 1": lambda c, p: (with_multipliers(c, error=1.5), p),
    "lx, le, ld, s > 0": lambda c, p: (with_multipliers(c, estimate=-1e-9), p),
    "lx + le + ld": lambda c, p: (with_multipliers(c, estimate=c.multipliers.estimate + 1e-9), p),
    "D: the plant's": lambda c, p: (
        c,
        replaced(p, disturbance=Ellipsoid((1 - 1e-6) * p.nominal_disturbance.shape_matrix)),
    ),
    "D: the certificate's": lambda c, p: (c, replaced(p, disturbance=Ellipsoid((1 + 2e-9) * c.D))),
    "N:": lambda c, p: (c, replaced(p, sensor_error=Ellipsoid(0.99 * p.sensor_noise.bound.shape_matrix))),
    "r0:": lambda c, p: (c, replaced(p, initial_error=Ellipsoid(0.99 * p.initial_noise.bound.shape_matrix))),
    "(E0)": lambda c, p: (c, replaced(p, initial_error=Ellipsoid(1.01 * np.diag(c.Sigma).max() * np.eye(p.n)))),
    "(E1)": lambda c, p: (with_multipliers(c, error=min(1.0 - 1e-3, c.multipliers.error * 1.2)), p),
    "(I)": lambda c, p: (with_multipliers(c, disturbance=1e-6), p),
    "(S) c_1": lambda c, p: (c, replaced(p, box_rows=p.box_rows * [[1.0 + 1e-5], [1.0]])),
    "(S) c_2": lambda c, p: (c, replaced(p, box_rows=p.box_rows * [[1.0], [1.0 + 1e-5]])),
    "(U) input 1": lambda c, p: (with_multipliers(c, inputs=(1e-9,)), p),
}


@pytest.mark.parametrize("name", ALONE)
def test_each_condition_alone_makes_a_certificate_invalid(name, certificate, loaded):
    if name == "(U) input 1":  # a certificate that uses its inputs
        loaded = random_plant(3, 2, 1)
        certificate = synthesize(loaded)
    assert broken(certificate, loaded) == []
    found = broken(*ALONE[name](certificate, loaded))
    assert len(found) == 1, found
    assert name in found[0]


def test_only_positive_definiteness_excludes_a_flat_set():
    # Without L > 0 the point set {0} would be "invariant": only a plant without any disturbance could have it.
    plant = truck_trailer(
        gamma=0.0, process_noise_cov=np.zeros((2, 2)), initial_cov=np.zeros((2, 2)), measurement_noise_cov=np.eye(2)
    )
    certificate = certificate_of(plant)
    flat = replace(certificate, L=np.zeros((2, 2)), K=np.zeros((1, 2)))
    found = broken(flat, plant)
    assert any("L > 0" in name for name in found)


def test_every_condition_has_been_broken_alone(certificate, loaded):
    names = [condition.name for condition in verified(certificate, loaded).conditions]
    untested = [name for name in names if not any(mark in name for mark in (*ALONE, "L > 0"))]
    assert untested == []


@pytest.mark.parametrize("change", [{"process_noise_cov": np.zeros((2, 2))}, {"gamma": 0.0}])
def test_disturbance_of_one_part_only_is_verified(change):
    plant = truck_trailer(**change)
    assert verified(synthesize(plant), plant).valid
