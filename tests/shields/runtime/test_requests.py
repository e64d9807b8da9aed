"""Samples on request behind shields and in loops without Gymnasium: the same requests, the same guarantee."""

import numpy as np
import pytest

from ncs_gym import Actuator, Channel, ChannelContract, Packet, cart_pole, lane_keeping, truck_trailer
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


def test_loop_asks_in_every_step_while_the_state_is_not_known():
    plant = truck_trailer(mass=4000.0)
    loop = safe_loop(certificate_of(plant), plant, Channel(on_request=True), on_unproved="ignore")
    loop.start(np.zeros(2), known=False)
    asked = []
    for step in range(4):
        loop.receive([Packet(step, np.zeros(2))] if step else [])
        loop.decide(0.0)
        asked.append(loop.request)
    assert asked[0]
    assert not asked[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "contract"),
    [(PLANT, CONTRACT), pytest.param(lane_keeping(), ChannelContract(8, 1e-4), marks=pytest.mark.slow)],
)
def test_contract_is_kept_from_the_first_proof_of_an_unknown_start_on(plant, contract):
    late = Channel(0.5, delay=4, max_consecutive_losses=1, quantization_step=1e-4, on_request=True)
    loop = safe_loop(certificate_of(plant, contract), plant, late, on_unproved="ignore")
    rng, x, lost, packets, ages = np.random.default_rng(0), np.zeros(plant.n), False, {}, []
    loop.start(x, known=False)
    for step in range(60):
        loop.receive(packets.pop(step, []))
        if ages or loop.guaranteed:
            assert loop.guaranteed
            ages.append(loop.measurement_age)
        x = plant.A @ x + plant.B @ loop.decide(np.zeros(plant.m)).input
        if loop.request:
            lost = not lost and rng.random() < 0.5
            sample = Packet(step + 1, late.quantize(plant.H @ x), loop.episode)
            packets |= {} if lost else {step + 1 + late.delay: [sample]}
    assert max(ages) == contract.max_age
    assert len(ages) > 50


@pytest.mark.cases(1)
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
