"""Under which contracts a plant is certifiable: every one has a proof, and more room is never less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ncs_gym import ChannelContract
from ncs_gym.processes.gym_pendulum import pendulum
from shields import Infeasible, requirements, verify
from shields.synthesis import network_requirements
from shields.synthesis.certification import carried_over, nearby_certificate
from shields.synthesis.network_requirements import share_of
from tests import plants
from tests.product import altered, linear_plant, synthesize
from tests.shields.polytope.limits import certificate as limited


def servo(**changes):
    """The servo at steps of 10 ms."""
    return plants.servo(1.0, **{"dt": 0.01, "disturbance_bound": [0.0, 0.5]} | changes)


@pytest.fixture(scope="module")
def found():
    return requirements(servo(), ages=[9, 0, 1], resolutions=[2e-3, 0.0])


def shares(found):
    """The shares of a table, 0 where no certificate was found."""
    return np.array([[share_of(each)[1] if each else 0.0 for each in row] for row in found.certificates])


def test_every_contract_with_a_certificate_has_one_that_verifies(found):
    assert (found.ages, found.resolutions) == ((0, 1, 9), (0.0, 2e-3))
    for age in found.ages:
        for step in found.resolutions:
            certificate = found.certificate(age, step)
            assert (certificate is None) == (age > found.largest_age(step))
            if certificate is not None:
                assert certificate.contract.follows_from(ChannelContract(age, step))
                assert verify(certificate, servo()).valid


def test_more_room_is_never_less_and_something_is_refused(found):
    table = shares(found)
    assert (np.diff(table, axis=0) <= 0.0).all()
    assert (np.diff(table, axis=1) <= 0.0).all()
    assert (table[-1] == 0.0).all()
    assert (table[0] > 0.5).all()
    assert found.largest_age() == 1
    with pytest.raises(ValueError, match="were asked about"):
        found.certificate(5)


def test_less_than_what_was_refused_is_not_tried_and_more_than_what_is_certified_is_certified(monkeypatch):
    plant, tried = servo(), []
    found = nearby_certificate(plant, ChannelContract(0))
    small, large = (replace(found, provenance={"share_of_box": each}) for each in (0.2, 0.5))

    def nearby(plant, contract, last):
        tried.append((contract.max_age, contract.quantization_step))
        if contract.max_age > 2 - contract.quantization_step:
            return None
        return large if tried[-1] == (1, 1.0) else small

    monkeypatch.setattr(network_requirements, "nearby_certificate", nearby)
    found = requirements(plant, ages=range(5), resolutions=[0.0, 1.0, 2.0])
    assert tried == [(0, 0.0), (1, 0.0), (2, 0.0), (3, 0.0), (0, 1.0), (1, 1.0), (2, 1.0), (0, 2.0), (1, 2.0)]
    assert shares(found).tolist() == [[0.5, 0.5, 0.2], [0.5, 0.5, 0.0], [0.2, 0.0, 0.0], [0.0] * 3, [0.0] * 3]
    assert [found.largest_age(each) for each in found.resolutions] == [2, 1, 0]


@pytest.mark.slow
def test_known_age_of_the_pendulum():
    assert requirements(pendulum(), ages=[8]).largest_age() == 8


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(6))])
def test_certificate_of_a_tighter_problem_is_carried_over_to_a_looser_one(seed):
    """Random pairs of input limits, boxes and bounds of a stable plant."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2, 2))
    plant = linear_plant(
        A=0.9 * A / np.abs(np.linalg.eigvals(A)).max(),
        B=rng.normal(size=(2, 1)),
        box=rng.uniform(0.5, 2.0, 2),
        u_max=rng.uniform(0.2, 2.0),
        dt=1.0,
        disturbance_bound=rng.uniform(0.005, 0.03),
        sensor_bound=0.01,
        initial_bound=0.01,
    )
    try:
        tight = synthesize(plant, safe_set="ellipsoid")
    except Infeasible:
        pytest.skip("the tighter problem has no certificate")
    looser = altered(plant, u_max=plant.u_max * rng.uniform(1.0, 20.0), disturbance_bound=0.7 * 0.005)
    loose = carried_over(tight, looser, None)
    assert loose is not None
    assert loose.fingerprint == looser.fingerprint
    assert np.linalg.slogdet(loose.L)[1] >= np.linalg.slogdet(tight.L)[1] - 1e-12
    assert verify(loose, looser).valid


def test_certificate_of_a_looser_problem_is_not_carried_over_to_a_tighter_one():
    plant = servo()
    loose = nearby_certificate(plant, ChannelContract(0))
    assert loose is not None
    assert carried_over(loose, plant, ChannelContract(1)) is None
    assert carried_over(loose, plant, None) is None
    assert carried_over(loose, plants.with_radii(plant, 50.0), ChannelContract(0)) is None


@pytest.mark.slow
def test_shares_for_limits_with_two_ends_are_nearly_those_that_synthesis_keeps():
    plant = plants.servo(1.0, box=None, state_limits=([-0.1, -4.0], [0.3, 4.0]))
    found = requirements(plant, ages=[0, 4])
    for age in found.ages:
        kept = synthesize(plant, contract=ChannelContract(age)).provenance["polytope_share_of_box"]
        assert share_of(found.certificate(age))[1] == pytest.approx(kept, abs=0.02)


def test_share_is_that_of_what_shields_keep_and_of_open_boxes_none():
    kept = limited("angle")
    assert share_of(kept) == ("polytope", kept.provenance["polytope_share_of_box"])
    assert share_of(replace(kept, provenance={})) == ("certificate", 1.0)
