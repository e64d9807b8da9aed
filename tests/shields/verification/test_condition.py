"""What conditions, verdicts and reports say."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from ncs_gym import Ellipsoid, truck_trailer
from shields.verification import Condition, Report
from shields.verification.rational_matrix import matrix_condition, scalar_condition
from tests.certificates import certificate_of
from tests.product import altered, library_plant, paper_synthesis
from tests.shields.verification.test_mutations import replaced
from tests.verdicts import broken, verified

BEYOND_FLOATS = Fraction(10) ** 400


@pytest.mark.parametrize("slack", [0, 1, Fraction(1, 3), 1 / BEYOND_FLOATS, BEYOND_FLOATS])
def test_scalar_conditions_hold_from_zero_on_and_not_below(slack):
    slack = Fraction(slack)
    assert scalar_condition("(S)", slack).holds
    assert scalar_condition("(S)", slack).margin >= 0.0
    assert scalar_condition("(S)", -slack).holds == (slack == 0)
    assert scalar_condition("(S)", -slack).margin <= 0.0


def test_slacks_beyond_any_float_keep_their_sign():
    assert [scalar_condition("(S)", slack).margin for slack in (BEYOND_FLOATS, -BEYOND_FLOATS)] == [np.inf, -np.inf]
    for factor, margin in ((1, np.inf), (-1, -np.inf)):
        condition = matrix_condition("(M)", [[factor * BEYOND_FLOATS]])
        assert condition.margin == margin
        assert condition.holds == (factor > 0)


def test_singular_matrices_pass_unless_the_condition_is_strict():
    singular = [[Fraction(1), Fraction(1)], [Fraction(1), Fraction(1)]]
    assert matrix_condition("(M)", singular).holds
    assert matrix_condition("(M)", singular).margin >= 0.0
    strict = matrix_condition("(M)", singular, strict=True)
    assert not strict.holds
    assert strict.margin < 0.0


@pytest.mark.parametrize("size", [Fraction(1), Fraction(10) ** 20, 1 / Fraction(10) ** 20])
def test_margins_have_the_sign_of_the_exact_verdict(size):
    # Singular but for a fraction of 1e-40, which no float shows.
    for tiny in (Fraction(1, 10**40), -Fraction(1, 10**40)):
        matrix = [[size * Fraction(1, 9), size * Fraction(1, 3)], [size * Fraction(1, 3), size * (1 + tiny)]]
        condition = matrix_condition("(M)", matrix)
        assert condition.holds == (tiny > 0)
        assert (condition.margin >= 0.0) == (tiny > 0)


def test_report_prints_conditions_that_differ_in_the_age_alone_once_and_every_broken_one():
    held = [Condition(f"(I) of Sigma at age {age}", margin, True) for age, margin in enumerate((3.0, 1.0, 2.0))]
    others = [Condition("(C0) of Sigma_0", 0.5, True), Condition("(S) c_1", 0.1, True), Condition("(S) c_2", 0.2, True)]
    verdict, *lines = str(Report((*held, *others))).splitlines()
    assert verdict == "valid: 6 of 6 conditions hold in exact arithmetic"
    assert lines[0] == "holds   +1.000e+00  (I) of Sigma at age 1 (the least of 3)"
    assert len(lines) == 4
    broken = [replace(condition, holds=False) for condition in held[1:]]
    printed = str(Report((held[0], *broken))).splitlines()
    assert [line.split()[0] for line in printed] == ["not", "holds", "BROKEN", "BROKEN"]


def test_first_error_that_misses_a_bound_declared_beside_a_covariance_makes_a_certificate_invalid():
    plant = library_plant(truck_trailer, 4000.0, initial_cov=np.diag([1e-4, 0.0]), initial_bound=([[1.0], [0.3]], 0.02))
    certificate = certificate_of(plant)
    assert verified(certificate, plant).valid
    larger = replaced(plant, initial_bound=Ellipsoid(1.001 * plant.of_first_error.bound.shape_matrix))
    assert [name[:3] for name in broken(certificate, larger)] == ["X0:"]


def test_paper_certificate_proves_nothing_of_bounds_that_its_theorems_do_not_know():
    small = library_plant(truck_trailer, gamma=1e-6, process_noise_cov=1e-6 * np.eye(2))
    paper = paper_synthesis(small)
    assert verified(paper, small).valid
    for name in ("disturbance_bound", "sensor_bound", "initial_bound"):
        plant = altered(small, **{name: 1e-4})
        assert not verified(replace(paper, fingerprint=plant.fingerprint), plant).valid
