"""Samples on request behind shields and in loops without Gymnasium: the same requests, the same guarantee."""

import numpy as np
import pytest

from ncs_gym import Actuator, Channel, ChannelContract, cart_pole, truck_trailer
from tests.certificates import certificate_of
from tests.product import safe_loop, vector_env, vector_shield

PLANT = cart_pole()
CHANNEL = Channel(0.5, delay=1, jitter=1, max_consecutive_losses=2, quantization_step=1e-4, on_request=True)
CONTRACT = ChannelContract(9, 1e-4)
DOWNLINK = Channel(0.5, delay=1, max_consecutive_losses=1)


def test_commands_carry_requests_to_the_actuator():
    plant = truck_trailer(mass=4000.0)
    downlink = Channel(delay=1, loss=0.3, max_consecutive_losses=1)
    loop = safe_loop(certificate_of(plant), plant, Channel(0.2, on_request=True), downlink=downlink)
    actuator, requested = Actuator(loop.input_delay, 1), []
    assert actuator.requested  # nothing was heard
    loop.start(np.zeros(2))
    for step in range(7):
        loop.receive()
        loop.decide(0.0, ask=step in (1, 3))
        command = loop.command()
        assert len(command.requests) == loop.input_delay + 1 == 3
        actuator.receive([] if step == 1 else [command])
        actuator.apply(step)
        requested.append((loop.request, actuator.requested))
    assert requested == [(each, each) for each in (True, True, False, True, False, True, False)]
    actuator.apply(9)  # commands up to there were lost
    assert actuator.requested


@pytest.mark.parametrize("downlink", [None, DOWNLINK])
def test_shield_keeps_its_set_whatever_is_asked_for(downlink):
    env = vector_env(40, plant=PLANT, channel=CHANNEL, contract=CONTRACT, downlink=downlink, disturbance="sphere")
    shield, rng = vector_shield(env, certificate_of(PLANT, env.certificate_contract)), np.random.default_rng(0)
    shield.reset(seed=0)
    packets = 0
    for _ in range(150):
        env.request(rng.random(40) < 0.05)
        *_, info = shield.step(rng.uniform(-1.0, 1.0, (40, 1)))
        packets = info["packets"].mean()
        assert info["shield_guaranteed"].all()
        assert info["episode_violations"].sum() == 0
    assert packets < 100
