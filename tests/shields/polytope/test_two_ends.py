"""Limits with two ends: certificates around a resting point, what changes of them are refused, and what plants say."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.optimize import linprog

from ncs_gym import ChannelContract, Ellipsoid
from ncs_gym.limits import MovedOperatingPointWarning
from shields import CertificateError, Infeasible
from tests.certificates import certificate_of
from tests.product import altered, linear_plant, loop_env, safety_shield, synthesize
from tests.shields.polytope.limits import ANGLE, ASYMMETRIC, CONTRACT, PLANTS, QUIET, certificate
from tests.verdicts import broken, verified


@pytest.mark.parametrize("name", ASYMMETRIC)
def test_polytope_has_the_plants_ends_and_its_rest_is_an_equilibrium(name):
    plant, found = PLANTS[name], certificate(name)
    P, k = found.safe_set, len(plant.box)
    np.testing.assert_array_equal(P.rows[:k], plant.box)
    np.testing.assert_array_equal([P.low[:k], P.high[:k]], plant.box_ends)
    x, u = found.resting_state, found.resting_input
    np.testing.assert_allclose(plant.A @ x + plant.B @ u, x, atol=1e-9)
    assert (plant.constraint_values(x) < 0.0).all()
    assert ((plant.input_ends[0] < u) & (u < plant.input_ends[1])).all()
    np.testing.assert_array_equal(P.center, x)


def test_limit_with_one_end_alone_is_kept():
    """The other end of the only state's range follows from the input's."""
    room = linear_plant(
        A=[[0.98]], B=[[0.05]], dt=60.0, operating_state=22.0, operating_input=8.0,
        state_limits=(20.0, np.inf), input_limits=(0.0, 12.0), disturbance_bound=0.1, **QUIET,
    )  # fmt: skip
    found = certificate_of(room, CONTRACT, "polytope")
    assert verified(found, room).valid
    assert found.safe_set.high[0] == np.inf
    reached = found.safe_set.rows[1:] @ np.array([1e6])
    assert ((reached > found.safe_set.high[1:]) | (reached < found.safe_set.low[1:])).any()


def test_state_without_a_limit_is_bounded_by_what_the_others_allow():
    model = {"A": [[1.0, 0.1], [0.0, 0.95]], "B": [[0.0], [0.1]], "dt": 0.1, "u_max": 1.0} | QUIET
    plant = linear_plant(**model, state_limits=([-1.0, -np.inf], [2.0, np.inf]), disturbance_bound=[0.001, 0.01])
    found = certificate_of(plant, ChannelContract(max_age=2), "polytope")
    assert verified(found, plant).valid
    assert np.isfinite(found.safe_set.widths).all()


def test_disturbance_around_which_nothing_rests_is_refused():
    settings = {"A": [[0.9]], "B": [[0.0]], "dt": 1.0, "box": 1.0, "u_max": 1.0} | QUIET
    with pytest.raises(ValueError, match="no state stays where it is"):
        linear_plant(**settings | {"A": [[1.0]]}, disturbance_bound=([[1.0]], [0.0], [0.1]))
    with pytest.raises(ValueError, match="not strictly within the limits"):
        linear_plant(**settings, disturbance_bound=([[1.0]], [0.0], [0.9]))


def test_an_input_may_rest_at_an_end_and_a_state_may_not():
    """A heater that is off where the room is as cold as outside."""
    described = {"A": [[0.99]], "B": [[0.1]], "dt": 60.0, "operating_state": 0.0, "operating_input": 0.0}
    heater = linear_plant(
        **described, state_limits=(-0.5, 8.0), input_limits=(0.0, 1.0), disturbance_bound=5e-3, **QUIET
    )
    found = certificate_of(heater, CONTRACT, "polytope")
    assert verified(found, heater).valid
    assert 0.0 < found.resting_input < 1.0
    shield = safety_shield(loop_env(heater, contract=CONTRACT), found)
    shield.reset(seed=0)
    for proposed in np.random.default_rng(0).choice([-1.0, 1.0], 200):
        info = shield.step(np.full(1, proposed, np.float32))[4]
        assert info["shield_guaranteed"]
        assert 0.0 <= info["input"][0] <= 1.0
    late = loop_env(altered(heater, input_delay=1), contract=CONTRACT)
    assert late.reset(seed=0)[1]["state"][1] == 0.0  # the past input
    for limits in ({"state_limits": (0.0, 8.0), "input_limits": (0.0, 1.0)}, {"input_limits": (0.1, 1.0)}):
        with pytest.raises(ValueError, match="the operating point"):
            linear_plant(**described, **{"state_limits": (-0.5, 8.0)} | limits, disturbance_bound=5e-3, **QUIET)


@pytest.mark.parametrize("name", ASYMMETRIC)
def test_printed_resting_point_has_nothing_that_is_left_of_rounding(name):
    text = " ".join(str(certificate(name)).split())
    assert ("u = u_c + K (x_hat - x_c), with x_c =" in text) == certificate(name).resting_state.any()
    assert "e-1" not in text.partition("fallback")[2].partition("contract")[0]  # what is left of rounding


def changed(found, **fields):
    return replace(found, safe_set=replace(found.safe_set, **fields))


def moved(array, index, by):
    other = array.copy()
    other[index] += by
    return other


def mutants(name):
    """What a certificate that is changed a little claims falsely, or can no longer prove."""
    found, plant = certificate(name), PLANTS[name]
    P = found.safe_set
    for j in range(len(P.rows)):
        if np.isfinite(P.high[j]):
            yield f"upper end {j}", changed(found, high=moved(P.high, j, 0.01))
            active = np.abs(P.multipliers[j]).argmax()
            yield f"multiplier {j}", changed(found, multipliers=moved(P.multipliers, (j, active), 0.05))
        if np.isfinite(P.low[j]):
            yield f"lower end {j}", changed(found, low=moved(P.low, j, -0.01))
            active = np.abs(P.lower_multipliers[j]).argmax()
            yield (
                f"lower multiplier {j}",
                changed(found, lower_multipliers=moved(P.lower_multipliers, (j, active), 0.05)),
            )
    yield "resting input", replace(found, resting_input=found.resting_input + 0.02 * plant.input_half)
    shifted = found.resting_state + 0.02 * plant.half_widths
    yield "center", replace(found, resting_state=shifted, safe_set=replace(P, center=shifted))


@pytest.mark.cases(1)
@pytest.mark.parametrize("name", ASYMMETRIC)
def test_changed_certificate_is_refused_by_both_engines(name):
    plant, count, refused = PLANTS[name], 0, 0
    for what, each in mutants(name):
        is_valid = verified(each, plant).valid
        count, refused = count + 1, refused + (not is_valid)
        if what in ("resting input", "center") or what.startswith(("upper end", "lower end")):
            assert not is_valid or is_invariant(each, plant), what
    assert refused >= 0.6 * count


def is_invariant(found, plant):
    """Whether the polytope is kept for sure, by linear programs of our own: then a changed end claims nothing false."""
    P = found.safe_set
    rows, ends = [], []
    for g, low, high in zip(P.rows, P.low, P.high, strict=True):
        rows += [g] * np.isfinite(high) + [-g] * np.isfinite(low)
        ends += [high] * np.isfinite(high) + [-low] * np.isfinite(low)
    k = len(plant.box)
    if (P.low[:k] < plant.box_ends[0]).any() or (P.high[:k] > plant.box_ends[1]).any():
        return False
    closed = plant.A + plant.B @ found.K
    constant = plant.B @ (found.resting_input - found.K @ found.resting_state)
    errors = max(found.error_shapes, key=np.trace)
    for f, end in zip(rows, ends, strict=True):
        reach = np.sqrt(f @ plant.B @ found.K @ errors @ found.K.T @ plant.B.T @ f)
        reach += float(plant.disturbance.support(np.asarray(f)))
        best = linprog(-(f @ closed), A_ub=np.array(rows), b_ub=np.array(ends), bounds=(None, None))
        if best.status != 0 or -best.fun + f @ constant + reach > end + 1e-9:
            return False
    return True


def within_symmetric(plant):
    """The plant with the largest symmetric limits inside its own."""
    rows = plant.box / np.abs(plant.box_ends).min(axis=0)[:, None]
    return altered(plant, box=rows, u_max=np.abs(plant.input_ends).min(axis=0))


def test_ellipsoid_is_not_kept_around_a_resting_point():
    plant = within_symmetric(ANGLE)
    found = certificate_of(plant, CONTRACT)
    assert isinstance(found.safe_set, Ellipsoid)
    for other, claims in (
        (replace(found, resting_input=[1e-9]), plant),
        (replace(found, fingerprint=ANGLE.fingerprint), ANGLE),
    ):
        assert broken(other, claims) == ["S: an ellipsoid is kept only around zero, within symmetric limits"]


def test_center_that_is_not_inside_and_ends_the_wrong_way_are_no_certificate():
    P = certificate("angle").safe_set
    for fields in ({"center": [5.0, 0.0]}, {"low": P.high, "high": P.low}, {"low": np.full(len(P.rows), np.nan)}):
        with pytest.raises(CertificateError):
            replace(P, **fields)


def test_bound_of_a_disturbance_with_two_ends_holds_all_of_it_in_rational_numbers():
    """x+ = A x + B u + E w, told from the old point, is z+ = A z + B v + d with d in E(D), told from the new one."""
    E, low, high = np.array([[1.0, 0.3], [0.2, -0.5]]), np.array([-0.3, 0.0]), np.array([0.1, 0.2])
    model = {"A": [[0.9, 0.1], [0.0, 0.7]], "B": [[0.1], [0.4]], "dt": 1.0} | QUIET
    limits = {"state_limits": ([-5.0, -5.0], [6.0, 4.0]), "input_limits": (-3.0, 4.0)}
    with pytest.warns(MovedOperatingPointWarning):
        plant = linear_plant(**model, **limits, disturbance_bound=(E, low, high))
    x, u = plant.operating_state, plant.operating_input  # deviations of the new point from the old one, (0, 0)
    assert np.abs(x).max() > 0.01
    rows = [[Fraction(float(entry)) for entry in row] for row in np.hstack([plant.A, plant.B, E])]
    D = plant.disturbance.shape_matrix
    for corner in ((a, b) for a in (low[0], high[0]) for b in (low[1], high[1])):
        there = [Fraction(float(entry)) for entry in (*x, *u, *corner)]
        d = [sum(a * b for a, b in zip(row, there, strict=True)) - Fraction(float(x[i])) for i, row in enumerate(rows)]
        assert float(np.array(d, dtype=float) @ np.linalg.solve(D, np.array(d, dtype=float))) <= 1.0
    absolute = linear_plant(**model, **limits, disturbance_bound=0.0)
    np.testing.assert_allclose(plant.box_ends + plant.box @ x, absolute.box_ends, atol=1e-12)
    np.testing.assert_allclose(plant.input_ends + u, absolute.input_ends, atol=1e-12)


@pytest.mark.parametrize("name", ASYMMETRIC)
def test_first_rows_of_a_polytope_have_the_ends_of_the_box(name):
    """A plan ends in the polytope if it passes the box's own ends in these rows: closer ones would not be tested."""
    plant, P = PLANTS[name], certificate(name).safe_set
    for field, by in (("low", 1e-6), ("high", -1e-6)):
        ends = moved(getattr(P, field), 0, by)
        if not np.isfinite(ends[0]):
            continue
        forged = changed(certificate(name), **{field: ends})
        assert "polytope: its first rows are those of the safe box" in broken(forged, plant)


def test_what_a_library_says_of_numbers_is_told_as_their_being_out_of_reach(monkeypatch):
    def failing(*arguments):
        raise np.linalg.LinAlgError("Matrix is not positive definite")

    monkeypatch.setattr("shields.synthesis.polytope_certificates.certified_polytope", failing)
    said = r"out of reach of float64 \(Matrix is not positive definite\): give states units"
    with pytest.raises(Infeasible, match=said):
        synthesize(ANGLE, contract=CONTRACT)
