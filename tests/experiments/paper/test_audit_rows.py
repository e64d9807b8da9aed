"""Rows of the audit by another route, and with other numbers: each verdict is a consequence."""

from dataclasses import replace
from fractions import Fraction

import cvxpy as cp
import numpy as np
import pytest

from experiments.paper.audit import (
    Verdict,
    box_is_invariant,
    demonstration,
    equivalence,
    farthest_without_input,
    least_contracting_gain,
    margin_at_one,
    optimum,
    simulated_error,
)
from experiments.paper.counterexample import ONLY_IF, contracts, worst_step
from experiments.paper.paper_example import PaperExample
from ncs_gym import BoxDisturbance, truck_trailer
from shields.paper.bounds import PaperModel
from shields.paper.optimization_problem import OptimizationProblem

CASE = PaperExample()


@pytest.fixture(autouse=True)
def _few_starts(monkeypatch):
    """In two dimensions ascents end alike, wherever they begin; all of them are in `test_counterexample.py`."""
    monkeypatch.setitem(worst_step.__kwdefaults__, "starts", 20)


# Clarabel stops at a relative gap of 1e-8, where a maximizer is known to its square root; the entries of K are about 2.
SOLVER = 2.0 * 1e-8**0.5


def semidefinite_optimum(u_max, quotient):
    """OP without (C2) and with U = quotient I, as a semidefinite program of its own; None drops the error."""
    plant = CASE.plant
    L, F = cp.Variable((2, 2), symmetric=True), cp.Variable((1, 2))
    closed, half = plant.A @ L + plant.B @ F, np.array([[u_max**2 / 2.0]])
    zero = np.zeros((2, 2))
    blocks = [[half, F], [F.T, L]]
    if quotient is not None:
        blocks = [[half, F, F], [F.T, L, zero], [F.T, zero, quotient * np.eye(2)]]
    constraints = [
        cp.bmat([[CASE.kappa * L, closed.T], [closed, L]]) >> 0,
        cp.bmat(blocks) >> 0,
        cp.diag(plant.box @ L @ plant.box.T) <= 1.0,
    ]
    tolerances = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-12)
    cp.Problem(cp.Maximize(cp.log_det(L)), constraints).solve(solver=cp.CLARABEL, **tolerances)
    return np.linalg.solve(L.value, F.value.T).T


@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
@pytest.mark.parametrize("u_max", [4.0, 6.0])
def test_optimum_without_the_margin_is_that_of_a_second_program(u_max):
    L, K = optimum(CASE, u_max)
    np.testing.assert_allclose(K, semidefinite_optimum(u_max, None), atol=SOLVER)
    assert (K @ L @ K.T).item() == pytest.approx(u_max**2 / 2, abs=1e-3)


@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
def test_printed_design_is_the_optimum_for_an_input_limit_of_six():
    L, K = optimum(CASE, 6.0, with_misread_margin=True)
    np.testing.assert_allclose(K, CASE.K, atol=5e-5)
    # The rounding of kappa moves the off-diagonal entry by 1.3e-5.
    np.testing.assert_allclose(np.linalg.inv(L), CASE.M, atol=1.3e-5)
    alpha = ((5e-4 + 0.0094**0.5) / (1.0 - 0.9029**0.5)) ** 2
    assert np.linalg.eigvalsh(L)[0] > alpha
    epsilon_up = 0.0094 / ((0.9029 * 1.01) ** 0.5 + np.linalg.norm(CASE.plant.A, 2)) ** 2
    np.testing.assert_allclose(K, semidefinite_optimum(6.0, alpha**2 / epsilon_up), atol=SOLVER)
    # With the alpha of Definition 4 in place of this one, the gain is another.
    right = ((5e-4**0.5 + 0.0094**0.5) / (1.0 - 0.9029**0.5)) ** 2
    assert np.abs(semidefinite_optimum(6.0, right**2 / epsilon_up) - CASE.K).max() > 3e-4


def test_tail_at_delta_makes_op_feasible_and_the_printed_tail_does_not():
    plant, point = truck_trailer(), (0.9, 1.035)
    tail = -2.0 * np.log(0.95)  # the chi-square quantile of two degrees of freedom in closed form
    problem = OptimizationProblem(plant)
    assert problem.solution(PaperModel(plant, quantile=tail).at(*point)) is not None
    assert problem.solution(PaperModel(plant).at(*point)) is None


def test_largest_error_is_undecided_exactly_between_the_two_readings():
    verdicts = []
    for largest in (2e-4, 0.0017, 0.0095):
        claim = simulated_error(replace(CASE, largest_error=largest))
        verdicts.append(claim.verdict)
    assert verdicts == [Verdict.HOLDS, Verdict.UNDECIDED, Verdict.FAILS]


def test_reduced_gain_contracts_exactly_and_no_smaller_one_does():
    factor = least_contracting_gain(CASE)
    assert contracts(CASE.A + factor * CASE.B @ CASE.K, CASE.M)
    assert not contracts(CASE.A + 0.999 * factor * CASE.B @ CASE.K, CASE.M)
    image = CASE.A + factor * CASE.B @ CASE.K
    levels = np.linalg.eigvals(np.linalg.solve(CASE.M, image.T @ CASE.M @ image)).real
    assert levels.max() == pytest.approx(1.0, abs=1e-9)


def test_margin_at_one_is_right_without_disturbance():
    assert margin_at_one(CASE).verdict == Verdict.FAILS
    claim = margin_at_one(replace(CASE, disturbance=BoxDisturbance((0.0, 0.0))))
    assert claim.verdict == Verdict.UNDECIDED


@pytest.mark.cases(1)
@pytest.mark.parametrize(
    ("change", "is_invariant", "breaks_condition"),
    [({}, True, True), ({"radius": Fraction(1, 40)}, False, True), ({"radius": Fraction(1, 500)}, True, False)],
)
def test_only_if_verdict_follows_the_example(change, is_invariant, breaks_condition):
    example = replace(ONLY_IF, **change)
    assert (example.is_invariant, example.breaks_condition) == (is_invariant, breaks_condition)
    expected = Verdict.FAILS if is_invariant and breaks_condition else Verdict.UNDECIDED
    assert equivalence(CASE, example).verdict == expected


def test_whole_box_is_invariant_without_input_and_a_wider_plant_leaves_it():
    assert box_is_invariant(CASE)
    rng = np.random.default_rng(0)
    states = 2.0 * np.sign(rng.standard_normal((2, 1000)))
    disturbances = CASE.plant.disturbance.sample_boundary(rng, 1000).T
    reached = np.abs(CASE.A @ states + disturbances).max(axis=1)
    bounds = farthest_without_input(CASE)
    assert (reached <= bounds).all()
    assert (reached > bounds - 0.01).all()
    wider = replace(CASE, A=1.15 * CASE.A)
    assert not box_is_invariant(wider)
    assert demonstration(wider).verdict == Verdict.UNDECIDED
