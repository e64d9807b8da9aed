"""Under attack errors stay in their running ellipsoid, and that in the certified set of its age."""

import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, batch_reactor, cart_pole, truck_trailer
from shields.verification.rational_matrix import is_positive_semidefinite, rational, subtract
from tests.ncs_gym.estimation.adversary import Attack
from tests.plants import random_plant

CASES = {
    "case study": (truck_trailer(), Channel(quantization_step=0.05, jitter=4), None),
    "cruise": (truck_trailer(mass=4000.0), Channel(jitter=6), None),
    "position only": (truck_trailer(mass=4000.0, H=[[1.0, 0.0]]), Channel(quantization_step=0.02, jitter=5), None),
    "three states, one output": (random_plant(5, 3, 2, p=1), Channel(jitter=2), None),
    "stable with a contract": (truck_trailer(), Channel(quantization_step=0.05, jitter=5), ChannelContract(5, 0.05)),
    "cart-pole": (cart_pole(), Channel(jitter=6), ChannelContract(4)),
    "position and angle": (cart_pole(full_state=False), Channel(jitter=3), ChannelContract(3)),
    "reactor": (batch_reactor(), Channel(jitter=5, quantization_step=1e-3), ChannelContract(3, 1e-3)),
}


def attack(name, count, steps, seed):
    attacked = Attack(*CASES[name], count, seed)
    for _ in range(steps):
        attacked.advance()
    # Shapes are few: each is compared with the certified set of its age in exact arithmetic.
    for shape, age in attacked.seen:
        certified = attacked.error_set.shape_at(age)
        assert certified is not None, age
        running = np.frombuffer(shape).reshape(certified.shape)
        assert is_positive_semidefinite(subtract(rational(certified), rational(running)))
    return attacked


@pytest.mark.parametrize("name", CASES)
def test_errors_stay_in_their_ellipsoids_whatever_arrives_when(name):
    attacked = attack(name, 100, 100, seed=0)
    assert attacked.largest > 0.9  # the adversary comes close
    ages = {age for _, age in attacked.seen}
    contract = CASES[name][2]
    assert min(ages) == 0
    assert max(ages) > 8 if contract is None else max(ages) == contract.max_age


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", CASES)
def test_errors_stay_in_their_ellipsoids_for_long(name, seed):
    assert attack(name, 500, 2000, seed=1 + seed).largest > 0.9
