"""Polytopes that the certified gain keeps in the box: found, proved by both verifiers, and refused when changed."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ncs_gym import Ellipsoid, cart_pole
from ncs_gym.network.channel import ChannelContract, contract_of
from ncs_gym.registration import CART_POLE_CHANNEL
from shields.errors import Infeasible
from shields.synthesis import invariant_polytope as search
from shields.synthesis.polytope_certificates import with_polytope
from shields.verification.polytope_conditions import half_widths, root_above
from tests.certificates import certificate_of
from tests.plants import random_plant
from tests.product import linear_plant, synthesize
from tests.verdicts import verified

IDS = {"TruckTrailerCruise": 0.93, "CartPole": 0.43, "BatchReactor": 0.75, "Pendulum": 0.71}


@cache
def found(name):
    """Certificates of a registered environment, with a polytope and of the ellipsoid alone, and its plant."""
    env = gym.make(f"ncs_gym/{name}-v0").unwrapped
    return *(certificate_of(env.plant, env.certificate_contract, kind) for kind in ("polytope", "ellipsoid")), env.plant


@pytest.mark.parametrize("name", ["TruckTrailerCruise", *(pytest.param(name, marks=pytest.mark.slow) for name in IDS)])
def test_polytopes_fill_much_more_of_the_box_and_both_verifiers_prove_them(name):
    _, certificate, plant = found(name)
    wide = with_polytope(certificate, plant)
    assert wide.provenance["share_of_box"] >= IDS[name] > certificate.provenance["share_of_box"]
    assert verified(wide, plant).valid
    # The ellipsoid lies inside: it is invariant under the same gain, and the polytope is the largest such set.
    points = certificate.safe_set.sample_boundary(np.random.default_rng(0), 2000)
    assert wide.safe_set.gauge(points).max() <= 1.0 + 1e-5


@pytest.mark.parametrize("name", IDS)
def test_share_that_a_gain_keeps_is_that_of_its_polytope(name):
    wide, certificate, plant = found(name)
    points = search.points_of_box(plant, 12)
    inside = wide.safe_set.gauge(points) <= 1.0
    feedback = search.feedback_of(certificate)
    assert search.share_of_points(feedback, plant, points) == pytest.approx(inside.mean(), abs=2.0 / len(points))
    unstable = feedback._replace(K=-1e3 * certificate.K)
    assert search.share_of_points(unstable, plant, points) == 0.0


def test_without_a_polytope_within_the_limits_the_certificate_says_why(monkeypatch):
    plant = cart_pole()
    certificate = certificate_of(plant, contract_of(CART_POLE_CHANNEL))
    monkeypatch.setattr(search, "MOST_ROWS", 50)
    narrow = with_polytope(certificate, plant)
    assert isinstance(narrow.safe_set, Ellipsoid)
    text = " ".join(str(narrow).split())
    assert (
        "more than 50 rows, fewer with longer steps or less disturbance; shields keep the state in the ellipsoid"
        in text
    )
    monkeypatch.setattr(search, "MOST_ROWS", 1)
    assert "the safe box alone has" in with_polytope(certificate, plant).provenance["no_polytope"]
    monkeypatch.setattr(search, "MOST_ROWS", 400)
    monkeypatch.setattr(search, "MOST_FOLLOWED", 10)
    assert "follows more than 10 rows" in with_polytope(certificate, plant).provenance["no_polytope"]


def test_state_that_no_limit_sees_is_limited_so_that_a_polytope_has_an_end():
    plant = linear_plant(
        A=[[0.9, 0.0], [0.0, 0.8]], B=[[0.1], [0.0]], dt=0.1, state_limits=([-1.0, -np.inf], [1.0, np.inf]), u_max=1.0,
        disturbance_bound=1e-3, sensor_bound=1e-3, initial_bound=1e-3,
    )  # fmt: skip
    found = synthesize(plant, contract=ChannelContract(1))
    assert verified(found, plant).valid
    # Disturbances of 1e-3 alone take the second state to 5e-3.
    np.testing.assert_array_less([0.999, 0.01], found.safe_set.support(np.eye(2)))


def test_errors_that_leave_a_face_alone_leave_no_polytope():
    plant = random_plant(3, 2, 1)
    certificate = certificate_of(plant)
    wide = replace(certificate, proofs=(replace(certificate.proofs[0], Sigma=1e4 * certificate.Sigma),))
    with pytest.raises(Infeasible):
        search.invariant_polytope(search.feedback_of(wide), plant, search.MARGINS[0])


def test_search_for_a_polytope_that_is_ended_leaves_the_ellipsoid():
    plant = random_plant(3, 2, 1)

    def late(line):
        if line.startswith("polytope"):
            raise TimeoutError

    found = synthesize(plant, time_limit=1e6, progress=late)
    assert isinstance(found.safe_set, Ellipsoid)
    assert found.provenance["interrupted_at"].startswith("polytope, when the time_limit")
    np.testing.assert_array_equal(
        found.safe_set.shape_matrix, synthesize(plant, safe_set="ellipsoid").safe_set.shape_matrix
    )


@pytest.mark.cases(1)
@pytest.mark.parametrize(("seed", "n", "m"), [(0, 2, 1), (5, 2, 2)])
def test_random_plants_have_polytopes_that_verify_and_hold_under_extreme_points(seed, n, m):
    assert_polytope_holds(seed, n, m)


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 3), st.integers(1, 2))
def test_many_random_plants_have_polytopes_that_verify_and_hold_under_extreme_points(seed, n, m):
    assert_polytope_holds(seed, n, m)


def assert_polytope_holds(seed, n, m):
    plant = random_plant(seed, n, m, gamma=1e-4)
    try:
        wide = synthesize(plant, safe_set="polytope")
    except Infeasible:
        return
    assert (isinstance(wide.safe_set, Ellipsoid)) == ("no_polytope" in wide.provenance)
    if isinstance(wide.safe_set, Ellipsoid):
        return
    assert verified(wide, plant).valid
    rng = np.random.default_rng(seed)
    x = wide.safe_set.sample_boundary(rng, 300)
    error, push = wide.error_set.sample_boundary(rng, 300), plant.disturbance.sample_boundary(rng, 300)
    u = (x + error) @ wide.K.T
    assert (np.abs(u) <= plant.largest_input).all()
    assert wide.safe_set.gauge(x @ plant.A.T + u @ plant.B.T + push).max() <= 1.0
    # By another route: for every row the farthest state, error and disturbance.
    for row in wide.safe_set.rows:
        image = wide.safe_set.support(row @ (plant.A + plant.B @ wide.K))
        assert image + wide.error_set.support(row @ plant.B @ wide.K) + plant.disturbance.support(row) <= 1.0


def test_half_widths_and_roots_are_upper_bounds():
    rng = np.random.default_rng(0)
    for n in (1, 2, 4):
        rows = rng.standard_normal((n + 2, n)).round(3)
        exact_rows = [[Fraction(float(x)) for x in row] for row in rows]
        widths = np.array([float(width) for width in half_widths(exact_rows)])
        points = rng.standard_normal((5000, n))
        points /= np.abs(points @ rows.T).max(axis=1)[:, None]
        assert (np.abs(points).max(axis=0) <= widths * (1 + 1e-12)).all()
    assert half_widths([[Fraction(1), Fraction(1)], [Fraction(2), Fraction(2)]]) is None
    for square in (Fraction(2), Fraction(1, 3), Fraction(0), Fraction(10) ** -40, Fraction(10) ** 30):
        root = root_above(square)
        assert root * root >= square
        assert root - Fraction(1, 2**127) <= 0 or (root - Fraction(1, 2**127)) ** 2 <= square
