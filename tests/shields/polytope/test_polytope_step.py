"""The one-step test of a polytope: decisions judged by extreme points and by a conic solver."""

from __future__ import annotations

from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from scipy.optimize import nnls

from ncs_gym import Ellipsoid
from shields.runtime.projection import closest_between
from shields.runtime.safety_filter import MARGIN
from shields.runtime.starts import starts_inside
from tests.certificates import certificate_of
from tests.product import safety_filter
from tests.shields.runtime.batches import decided_alike

ALL = ("TruckTrailerCruise", "CartPole", "BatchReactor", "Pendulum", "CartPoleTwoWay")


@cache
def wide_certificate(name, kind="polytope"):
    env = gym.make(f"ncs_gym/{name}-v0").unwrapped
    return certificate_of(env.plant, env.certificate_contract, kind), env.plant


def situations(shield, count, seed=0):
    """Estimates in and a little out of the polytope, error shapes, and proposals: (count, n), (n, n), (count, m)."""
    rng = np.random.default_rng(seed)
    polytope, plant = shield.certificate.safe_set, shield.plant
    estimates = polytope.sample_boundary(rng, count) * rng.uniform(0.3, 1.15, (count, 1))
    return estimates, 0.5 * shield.certificate.Sigma, rng.uniform(-1.0, 1.0, (count, plant.m)) * plant.largest_input


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_closest_points_do_not_depend_on_units_and_bear_many_rows(unit):
    """Far outside nearly all of 150 rows in four dimensions: the optimality conditions hold, and so does every row."""
    rng = np.random.default_rng(1)
    effect, room = rng.standard_normal((150, 4)), rng.uniform(0.5, 1.0, (150, 20))
    wanted = rng.uniform(-30.0, 30.0, (4, 20))
    found = closest_between(unit * wanted, np.zeros((150, 20)), effect / unit, room) / unit
    values = effect @ found
    assert (np.abs(values) <= room * (1.0 + 1e-9)).all()
    for k in range(20):  # what is left to the wanted point is a nonnegative sum of the normals of active rows
        active = room[:, k] - np.abs(values[:, k]) < 1e-7
        normals = effect[active] * np.sign(values[active, k])[:, None]
        assert active.any()
        assert nnls(normals.T, (wanted - found)[:, k])[1] < 1e-6


@pytest.mark.cases(5)
@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("mode", ["project", "switch", "boundary", "monitor"])
def test_batches_decide_as_single_loops(name, mode):
    shield = safety_filter(*wide_certificate(name), mode)
    estimates, shape, proposals = situations(shield, 64)
    assert len(set(decided_alike(shield, estimates, np.tile(shape, (64, 1, 1)), proposals).reason)) > 1


def test_sums_in_another_order_stay_within_the_room_for_rounding():
    certificate, plant = wide_certificate("CartPole")
    shield = safety_filter(certificate, plant)
    estimates, _, proposals = situations(shield, 200)
    order = np.random.default_rng(1).permutation(plant.n)
    test = shield.test
    for estimate, u in zip(estimates, proposals, strict=True):
        again = (test.state_rows[:, order] * estimate[order]).cumsum(axis=1)[:, -1] + test.input_rows @ u
        moved = np.abs(again - (test.state_rows.dot(estimate) + test.input_rows.dot(u))).max()
        assert moved <= test.rounding * (test.columns @ np.abs(estimate) + test.pushed)
        assert moved < MARGIN


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_what_is_not_usable_ends_in_the_fallback(value):
    certificate, plant = wide_certificate("CartPole")
    shield = safety_filter(certificate, plant)
    shape = certificate.Sigma
    estimate = np.zeros(plant.n)
    decision = shield.decide(np.full(plant.n, value), shape, np.zeros(1))
    assert not decision.proved
    assert shield.decide(estimate, np.full_like(shape, value), np.zeros(1)).reason != "safe"
    assert shield.decide(estimate, shape, np.full(1, value)).reason == "invalid"
    assert shield.decide(estimate, -shape, np.zeros(1)).reason != "safe"
    assert not shield.knows_inside(np.full(plant.n, value), shape)
    assert shield.knows_inside(estimate, shape)


def test_starts_are_decided_exactly():
    certificate, _ = wide_certificate("BatchReactor")
    polytope = certificate.safe_set
    corner = polytope.sample_boundary(np.random.default_rng(0), 1)[0]
    assert starts_inside(certificate, (1.0 - 1e-12) * corner)
    assert not starts_inside(certificate, (1.0 + 1e-12) * corner)
    inside = wide_certificate("BatchReactor", "ellipsoid")[0].safe_set
    assert starts_inside(certificate, inside)
    assert not starts_inside(certificate, Ellipsoid(4.0 * inside.shape_matrix))
