"""Published plants under attack: limits with two ends and limits of rates, and what share of a box could be kept."""

from collections import Counter
from fractions import Fraction

import numpy as np
import pytest

from benchmarks import published as script
from experiments.commands.attack import attacked, worst_case
from ncs_gym import Bounds, Box, ChannelContract, Limits, LinearPlant, Model, Through
from ncs_gym.estimation.error_bound import certified_error_set
from shields import Infeasible
from shields.synthesis.resting_point import farthest_equilibrium
from tests.certificates import certificate_of
from tests.product import altered, synthesize, vector_env, vector_shield
from tests.shields.polytope.limits import CHANNEL, CONTRACT, PLANTS


@pytest.mark.parametrize(
    "name", ["rates", *(pytest.param(name, marks=pytest.mark.slow) for name in ("angle", "coupled"))]
)
def test_no_limit_is_broken_under_attack_and_all_are_without_the_shield(name):
    plant, certificate = PLANTS[name], certificate_of(PLANTS[name], CONTRACT, "polytope")

    def counts_of(mode):
        settings = {"plant": plant, "contract": CONTRACT, "channel": CHANNEL} | worst_case(certificate)
        shield = vector_shield(vector_env(40, **settings), certificate, mode, on_unproved="ignore")
        return sum(attacked(shield, np.random.default_rng(0)), Counter())

    counts = counts_of("project")
    assert counts["steps"] == 8_000
    assert counts["outside S"] == counts["outside box"] == counts["no claim"] == 0
    assert counts["overridden"] > 400
    assert counts_of("monitor")["outside box"] > 400


def test_no_controller_bears_what_noise_hides_and_a_certificate_bears_less():
    """x+ = x + u + d, |d| <= .2, |v| <= .1 under |x| <= 1: two steps after a sample x is known to .1 + 2 (.2)."""

    def bounded_by(scale):
        bounds = Bounds(Through(np.eye(1), Box([-0.2 * scale], [0.2 * scale])), [0.1 * scale], [0.1 * scale])
        return LinearPlant(Model([[1.0]], [[1.0]], [[1.0]], 0.1), Limits([1.0], [10.0]), bounds)

    most = script.impossible_beyond(bounded_by(1.0), np.array([0.1]), 2)
    assert isinstance(most, Fraction)
    assert float(most) == pytest.approx(2.0, rel=1e-9)
    assert synthesize(bounded_by(1.8), contract=ChannelContract(1))
    with pytest.raises(Infeasible):
        synthesize(bounded_by(2.01), contract=ChannelContract(1))


def test_no_controller_bears_a_constant_disturbance_that_no_equilibrium_balances():
    """x+ = .5 x + .1 u + d of two states, one with an end at -1 alone, rests within |x|, |u| <= 1 if |d| <= .6."""

    def bounded_by(scale, E=((1.0,), (-1.0,))):
        limits = Limits(([-1.0, -1.0], [1.0, np.inf]), [1.0])
        bounds = Bounds(Through(E, Box([-0.2 * scale], [0.2 * scale])), [1e-3] * 2, [1e-3] * 2)
        return LinearPlant(Model(0.5 * np.eye(2), [[0.1], [0.0]], np.eye(2), 0.1), limits, bounds)

    most = script.impossible_beyond(bounded_by(1.0), np.full(2, 1e-3), 2)
    assert isinstance(most, Fraction)
    assert float(most) == pytest.approx(2.5, rel=1e-9)  # the other state, which no input moves, needs |d| <= .5
    assert float(script.impossible_beyond(bounded_by(1.0, [[1.0], [0.0]]), np.zeros(2), 2)) == pytest.approx(3.0)


@pytest.mark.slow
def test_plant_has_a_certificate_with_another_ellipsoid_around_its_first_error():
    """The smallest one around the box of first errors leaves nothing of the limits of the ball and plate."""
    plant, p = script.plant_of("bap_gepoc"), script.published()["bap_gepoc"]
    box = np.array(p["first_error_half_widths"])
    assert np.square(box / np.array(p["first_error_half_axes"])).sum() <= 1.0
    assert script.certified("bap_gepoc", plant)
    with pytest.raises(Infeasible, match=r"shrink to 74\.5%"):
        script.certified("bap_gepoc", altered(plant, initial_bound=box))


@pytest.mark.cases(1)
@pytest.mark.parametrize("name", ["heli_tondel", "spacecraft", "tvc_rocket", "propofol"])
def test_error_sets_are_found_where_steps_are_short_or_inputs_weak(name):
    """A regulator that had to decay by a quarter in every step weighed errors by 1e8 to 1e11 here."""
    plant, contract = script.plant_of(name), script.contract_of_plant(name)
    assert certified_error_set(plant, contract).contract == contract


def test_resting_point_is_near_the_operating_point_where_no_limit_sees_it():
    """Of a drone whose position is free: 20 km away the rounding of rest was more than error sets have room for."""
    rest = farthest_equilibrium(script.plant_of("quad12_osqp")).rest
    assert np.abs(rest.state).max() < 1.0
