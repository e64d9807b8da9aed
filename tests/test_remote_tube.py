"""The arms of the comparison with remote tube MPC that need no clone."""

import numpy as np
import pytest

from benchmarks.remote_tube import STEPS, cart_pole_of_the_paper, episode, remote_shield, shield_at_plant
from ncs_gym import ChannelContract
from tests.product import synthesize


@pytest.fixture(scope="module")
def plant():
    return cart_pole_of_the_paper()


@pytest.mark.slow
def test_a_shield_at_the_plant_keeps_the_limits_whatever_is_lost(plant):
    certificate = synthesize(plant, contract=ChannelContract(0))
    by_packets, local = (shield_at_plant(plant, certificate, local=each) for each in (False, True))
    errors = [episode(arm, plant, 0.8, STEPS, 0, worst=True) for arm in (by_packets, local)]
    assert np.isfinite(errors).all()
    assert errors[1] < 15.0 < errors[0]
    assert np.isnan(episode(lambda *_: np.zeros(1), plant, 0.8, STEPS, 0, worst=True))


@pytest.mark.slow
def test_a_remote_shield_keeps_the_limits_within_its_contract_and_not_beyond(plant):
    certificate = synthesize(plant, contract=ChannelContract(3))
    assert episode(remote_shield(plant, certificate), plant, 0.9, 1, 0, worst=True) < 20.0
    assert np.isnan(episode(remote_shield(plant, certificate), plant, 0.9, STEPS, 0, worst=True))
