"""Under which contracts a plant is certifiable: every one has a proof, and more room is never less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ncs_gym import ChannelContract
from shields import Infeasible, requirements, verify
from shields.synthesis import network_requirements
from shields.synthesis.certification import Search, first_certificate
from shields.synthesis.network_requirements import share_of
from tests import plants
from tests.shields.polytope.limits import certificate as limited


def servo(**changes):
    """The servo at steps of 10 ms."""
    return plants.servo(1.0, **{"dt": 0.01, "disturbance_bound": [0.0, 0.5]} | changes)


@pytest.fixture(scope="module")
def found():
    return requirements(servo(), ages=[9, 0], resolutions=[2e-3, 0.0])


def shares(found):
    """The shares of a table, 0 where no certificate was found."""
    return np.array([[(share_of(each) or 1.0) if each else 0.0 for each in row] for row in found.certificates])


def test_every_contract_with_a_certificate_has_one_that_verifies(found):
    assert (found.ages, found.resolutions) == ((0, 9), (0.0, 2e-3))
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
    assert found.largest_age() == 0
    with pytest.raises(ValueError, match="were asked about"):
        found.certificate(5)


def test_less_than_what_was_refused_is_not_tried_and_more_than_what_is_certified_is_certified(monkeypatch):
    plant, tried = servo(), []
    found = first_certificate(plant, ChannelContract(0), Search())
    small, large = (replace(found, provenance={"share_of_box": each}) for each in (0.2, 0.5))

    def sought(plant, contract, search):
        tried.append((contract.max_age, contract.quantization_step))
        if contract.max_age > 2 - min(contract.quantization_step, 1.0):
            raise Infeasible("none", "I", 1.0)
        return large if tried[-1] == (1, 1.0) else small

    monkeypatch.setattr(network_requirements, "first_certificate", sought)
    found = requirements(plant, ages=range(5), resolutions=[0.0, 1.0, 2.0])
    assert tried == [(0, 0.0), (1, 0.0), (2, 0.0), (3, 0.0), (0, 1.0), (1, 1.0), (2, 1.0), (0, 2.0), (1, 2.0)]
    assert shares(found).tolist() == [[0.5, 0.5, 0.2], [0.5, 0.5, 0.2], [0.2, 0.0, 0.0], [0.0] * 3, [0.0] * 3]
    assert [found.largest_age(each) for each in found.resolutions] == [2, 1, 1]


def test_share_is_that_of_what_shields_keep_and_of_open_boxes_none():
    kept = limited("angle")
    assert share_of(kept) == kept.provenance["share_of_box"]
    assert share_of(replace(kept, provenance={})) is None
