"""The second verifier: its own arithmetic, and that a slip in either verifier is noticed by the other."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flint import fmpq, fmpq_mat
from hypothesis import given, settings
from hypothesis import strategies as st

from ncs_gym import truck_trailer
from ncs_gym.ellipsoid import TruncatedGaussian, truncation_energy
from shields import verify
from shields.verification.rational_matrix import is_positive_semidefinite, rational
from tests.certificates import certificate_of
from tests.plants import named
from tests.product import library_plant, paper_synthesis
from tests.second_verifier import verify as second_verifier
from tests.second_verifier.bounds import keeps_enough
from tests.second_verifier.exact import at_least_zero, definite, is_semidefinite, matrix
from tests.second_verifier.verify import verify_again
from tests.shields.verification.test_mutations import replaced, with_multipliers
from tests.shields.verification.test_rational_matrix import minors_say_semidefinite
from tests.verdicts import verified

# The record of a verdict, and what a certificate and a plant consist of.
MAY_IMPORT = {
    "ncs_gym",
    "ncs_gym.ellipsoid",
    "ncs_gym.validation",
    "shields",
    "shields.certificate",
    "shields.paper",
    "shields.polytope",
    "shields.verification.rational_matrix",
}


@given(st.integers(0, 100_000), st.integers(1, 4))
@settings(max_examples=300, deadline=None)
def test_semidefiniteness_agrees_with_all_principal_minors_and_the_first_verifier(seed, n):
    rng = np.random.default_rng(seed)
    factor = rng.integers(-2, 3, (n, rng.integers(1, n + 1)))
    symmetric = factor @ factor.T  # semidefinite, often singular
    if rng.random() < 0.6:
        i, j = rng.integers(n, size=2)
        symmetric[i, j] = symmetric[j, i] = symmetric[i, j] + rng.integers(-1, 2)
    assert is_semidefinite(matrix(symmetric)) == minors_say_semidefinite(symmetric)
    for strictly in (False, True):
        expected = is_positive_semidefinite(rational(symmetric), strict=strictly)
        assert is_semidefinite(matrix(symmetric), strictly=strictly) == expected


def test_no_tolerance_at_the_boundary():
    for size in (fmpq(1), fmpq(10) ** 20, 1 / fmpq(10) ** 20):
        for tiny in (fmpq(0), 1 / fmpq(10) ** 40, -1 / fmpq(10) ** 40):
            condition = definite("(M)", size * fmpq_mat([[fmpq(1, 9), fmpq(1, 3)], [fmpq(1, 3), 1 + tiny]]))
            assert condition.holds == (tiny >= 0)
            assert (condition.margin >= 0.0) == (tiny >= 0)
            assert at_least_zero("(S)", size * tiny).holds == (tiny >= 0)
    edge = fmpq_mat([[1, 1], [1, 1]])
    assert is_semidefinite(edge)
    assert not is_semidefinite(edge, strictly=True)
    assert not is_semidefinite(matrix(np.array([[1.0, 1e-300], [0.0, 1.0]])))


def test_margins_beyond_any_float_keep_their_sign():
    huge = fmpq(10) ** 400
    assert [at_least_zero("(S)", slack).margin for slack in (huge, -huge)] == [np.inf, -np.inf]
    assert [definite("(M)", fmpq_mat([[slack]])).margin for slack in (huge, -huge)] == [np.inf, -np.inf]
    assert at_least_zero("(S)", -1 / huge).margin < 0.0


def test_margins_are_those_of_the_first_verifier(certificate, loaded):
    spring, contract = named("oscillator")
    for each, plant in ((certificate, loaded), (certificate_of(spring, contract, "polytope"), spring)):
        first, second = (judge(each, plant) for judge in (verify, verify_again))
        margins = {condition.name: condition.margin for condition in second.conditions}
        for condition in first.conditions:
            assert margins[condition.name] == pytest.approx(condition.margin, rel=1e-6, abs=1e-15), condition.name


def test_the_verifiers_have_no_code_in_common():
    folder = Path(second_verifier.__file__).parent
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            module = node.module if isinstance(node, ast.ImportFrom) else None
            if module is not None and module.startswith(("ncs_gym", "shields")):
                assert module in MAY_IMPORT, (path.name, module)
                if module == "shields.verification.rational_matrix":
                    assert [alias.name for alias in node.names] == ["Condition"], path.name


@pytest.mark.parametrize(
    "slip",
    ["shields.verification.rational_matrix.is_positive_semidefinite", "tests.second_verifier.exact.is_semidefinite"],
)
def test_a_slip_in_one_verifier_is_noticed_by_the_other(slip, certificate, loaded, monkeypatch):
    wrong = with_multipliers(certificate, error=1e-320)
    assert not verified(wrong, loaded).valid
    monkeypatch.setattr(slip, lambda *args, **settings: True)
    with pytest.raises(AssertionError):
        verified(wrong, loaded)


@pytest.mark.parametrize("delta", [1e-12, 1e-9, 1e-7, 1e-6, 1e-5, 1e-3, 0.05, 0.5, 0.999])
def test_no_truncation_removes_more_than_delta(delta):
    """1 - delta as a float may be smaller than the number, which once made quantiles of small delta too small."""
    for factor in (1.0, 1.1, 1.3, 1.7, 1.9):
        plant = library_plant(truck_trailer, delta=min(delta * factor, 0.999))
        for noise in (plant.process_noise, plant.sensor_noise, plant.initial_noise):
            assert keeps_enough("chi-square", noise, plant).holds


def test_quantile_a_hair_too_small_is_noticed_by_the_second_verifier(certificate, loaded):
    noise = loaded.process_noise
    for factor, holds in ((1.0, True), (1.0 - 1e-9, False)):
        changed = TruncatedGaussian(noise.covariance, factor * truncation_energy(loaded.delta, loaded.n))
        report = verify_again(certificate, replaced(loaded, process_noise=changed))
        broken = [condition.name for condition in report.conditions if not condition.holds]
        assert broken == ([] if holds else ["chi-square: no more than delta of the process noise is truncated"])


def test_paper_certificate_is_judged_by_both_up_to_its_boundary():
    plant = library_plant(truck_trailer, gamma=1e-6, process_noise_cov=1e-6 * np.eye(2))
    paper = paper_synthesis(plant)
    assert verified(paper, plant).valid
    for factor in np.geomspace(0.3, 1.1, 40):
        verified(replace(paper, L=factor * paper.L), plant)
        verified(replace(paper, L=paper.L @ np.diag([1.0, factor])), plant)
        verified(replace(paper, K=factor / 0.5 * paper.K), plant)
