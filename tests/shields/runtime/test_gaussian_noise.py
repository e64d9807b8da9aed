"""The shield under noise that may leave every bound: what it still does, and how often the safe set is left."""

import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, cart_pole, truck_trailer
from shields.runtime.guard import ALARM
from shields.runtime.safety_filter import MODES
from tests.certificates import certificate_of
from tests.product import library_plant, vector_env, vector_shield
from tests.shields.attacks.adversary import gauges

# So large a delta that draws leave their ellipsoids all the time.
WILD = 0.97
LATE = Channel(loss=0.6, max_consecutive_losses=2, jitter=2)
LOOPS = {
    "truck": (library_plant(truck_trailer, mass=4000.0, delta=WILD), None, Channel(loss=0.3, send_period=2, delay=2)),
    "cart-pole": (library_plant(cart_pole, delta=WILD), ChannelContract(4), LATE),
}


@pytest.mark.cases(1)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", ["truck", pytest.param("cart-pole", marks=pytest.mark.slow)])
def test_shield_goes_on_when_draws_leave_their_ellipsoids(name, mode):
    plant, contract, channel = LOOPS[name]
    settings = {"channel": channel, "contract": contract, "noise": "gaussian", "max_episode_steps": 60}
    shield = vector_shield(vector_env(20, plant=plant, **settings), certificate_of(plant, contract), mode=mode)
    shield.reset(seed=0)
    escaped, alarms, reasons, rng = False, 0, set(), np.random.default_rng(0)
    for _ in range(80):
        *_, info = shield.step(rng.uniform(-1.0, 1.0, shield.action_space.shape).astype(np.float32))
        escaped |= bool((gauges(info["error_shape"], info["estimation_error"].T) > 1.0).any())
        alarms += int(info["assumption_violated"].sum())
        reasons |= set(info["shield_reason"].tolist())
        # An alarm ends the proof at once; without one the flag cannot know what no packet showed.
        assert not (info["shield_guaranteed"] & info["assumption_violated"]).any()
        assert (np.abs(info["input"]) <= plant.largest_input).all()
    assert escaped
    assert alarms > 0
    assert ALARM in reasons
