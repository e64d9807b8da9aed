"""What verification reports: the verdict, and margins that agree with floating point."""

import re
from dataclasses import replace

import numpy as np
import pytest

from ncs_gym import truck_trailer
from shields.verification import Condition, Report
from tests.certificates import certificate_of
from tests.plants import random_plant
from tests.product import altered, library_plant
from tests.shields.verification.test_mutations import with_multipliers
from tests.verdicts import broken, verified


def test_margins_of_several_inputs_agree_with_floating_point():
    # Large limits and a small multiplier s, so that the rounding of actions counts in (I) and in (U).
    plant = altered(random_plant(3, 3, 2), u_max=[1e3, 2e3])
    certificate = with_multipliers(certificate_of(plant), rounding=1e-9)
    c, (lx, le, ld) = certificate, certificate.proofs[0].shares
    margins = {condition.name.split(" stays")[0]: condition.margin for condition in verified(c, plant).conditions}
    closed, gain = plant.A + plant.B @ c.K, plant.B @ c.K
    spread = 2 * plant.B @ np.diag((plant.u_max * 2.0**-24) ** 2) @ plant.B.T
    D_u = (1 + c.rounding) * c.D + (1 + 1 / c.rounding) * spread
    grown = closed @ c.L @ closed.T / lx + gain @ c.Sigma @ gain.T / le + D_u / ld
    invariance = next(value for name, value in margins.items() if name.startswith("(I)"))
    assert invariance == pytest.approx(np.linalg.eigvalsh(c.L - grown)[0], rel=1e-6)
    for i, mu in enumerate(c.proofs[0].inputs):
        used = c.K[i] @ c.L @ c.K[i] / mu + c.K[i] @ c.Sigma @ c.K[i] / (1 - mu)
        limit = (plant.u_max[i] * (1 - 2.0**-24)) ** 2
        assert used > 1e-3 * c.K[i] @ c.L @ c.K[i]
        assert margins[f"(U) input {i + 1}"] == pytest.approx(limit - used, rel=1e-12)


def unfolded(report):
    """The lines of a report, each condition on one; all are at most 80 columns wide."""
    assert max(map(len, str(report).splitlines())) <= 80
    return re.sub(r"\n {10,}", " ", str(report)).splitlines()


def test_report_prints_the_verdict_and_one_line_per_condition(certificate, loaded):
    report = verified(certificate, loaded)
    verdict, *lines = unfolded(report)
    assert verdict == f"valid: {len(lines)} of {len(lines)} conditions hold in exact arithmetic"
    assert [line.split("  ")[-1] for line in lines] == [condition.name for condition in report.conditions]
    report = verified(replace(certificate, K=certificate.K + 4.0), loaded)
    verdict, *lines = unfolded(report)
    names = [condition.name for condition in report.conditions if not condition.holds]
    assert verdict == f"not valid: {len(names)} of {len(lines)} conditions broken"
    assert [line.split("  ")[-1] for line in lines if line.startswith("BROKEN")] == names
    assert any(line.startswith("BROKEN") and "(U)" in line for line in lines)
    assert any(line.startswith("holds") and "(E1)" in line for line in lines)


def test_report_prints_conditions_that_differ_in_the_age_alone_once_and_every_broken_one():
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


def test_only_positive_definiteness_excludes_a_flat_set():
    # Without L > 0 the point set {0} would be "invariant": only a plant without any disturbance could have it.
    noise = dict.fromkeys(("process_noise_cov", "initial_cov"), np.zeros((2, 2))) | {"measurement_noise_cov": np.eye(2)}
    plant = library_plant(truck_trailer, gamma=0.0, **noise)
    certificate = certificate_of(plant)
    flat = replace(certificate, L=np.zeros((2, 2)), K=np.zeros((1, 2)))
    found = broken(flat, plant)
    assert any("L > 0" in name for name in found)
