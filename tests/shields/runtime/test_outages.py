"""What goes wrong in real loops: outages of the plant, wild commands."""

import pickle

import numpy as np
import pytest

from ncs_gym import Actuator, Channel, ChannelContract, Packet, cart_pole
from ncs_gym.network.downlink import Command
from shields.runtime.guard import (
    LATE_INPUT,
    NOT_CONFIRMED,
    OTHER_EPISODE,
    OTHER_INPUT,
)
from tests.certificates import certificate_of
from tests.product import safe_loop

PLANT = cart_pole()
UPLINK = Channel(loss=0.3, delay=1, max_consecutive_losses=1)
DOWNLINK = Channel(loss=0.3, delay=1, max_consecutive_losses=1)  # c = 2


def loop_with(echo_age=4, downlink=DOWNLINK, plant=PLANT, contract=4, **settings):
    certificate = certificate_of(plant, None if contract is None else ChannelContract(contract))
    return safe_loop(certificate, plant, UPLINK, downlink=downlink, echo_age=echo_age, **settings)


class World:
    """A plant with its actuator, which can be switched off: then it stays where it is, and sends nothing."""

    def __init__(self, loop, state=None, seed=0):
        self.loop, self.plant, self.rng = loop, loop.filter.plant, np.random.default_rng(seed)
        self.state = np.zeros(self.plant.n) if state is None else state
        self.actuator = Actuator(loop.input_delay, self.plant.m, self.plant.largest_input)
        self.packets, self.echoes, self.step = [], [], 0

    def start(self, **settings):
        plant = self.plant
        self.loop.start(self.state + plant.of_first_error.drawn(self.rng), **settings)
        self.actuator.start(self.loop.episode)
        self.packets, self.echoes, self.step = [], [], 0

    def move(self, proposed=0.0, *, is_on=True, is_heard=True):
        loop, plant = self.loop, self.plant
        loop.receive(self.packets, echoes=self.echoes)
        guaranteed = loop.guaranteed
        loop.decide(proposed)
        self.packets, self.echoes = [], []
        if is_on:
            if is_heard:
                self.actuator.receive([loop.command()])
            sample = plant.H @ self.state + plant.of_sensor.drawn(self.rng)
            self.packets = [Packet(self.step, sample, loop.episode)]
            u = self.actuator.apply(self.step)
            self.echoes = [self.actuator.echo]
            d = plant.nominal_disturbance.sample_boundary(self.rng)
            self.state = plant.A @ self.state + plant.B @ u + d
        self.step += 1
        return guaranteed


@pytest.mark.cases(4)
@pytest.mark.parametrize("length", [1, 2, 5, 10, 30])
@pytest.mark.parametrize("downlink", [None, DOWNLINK])
def test_outage_of_the_plant_ends_the_proof_for_the_episode(length, downlink):
    loop = loop_with(downlink=downlink)
    world = World(loop)
    world.start()
    before = [world.move() for _ in range(20)]
    for _ in range(length):
        world.move(is_on=False)
    world.move()
    after = [world.move() for _ in range(40)]
    assert all(before)
    assert not any(after)
    assert loop.reason == (OTHER_INPUT if downlink is None else LATE_INPUT)
    world.state = np.zeros(PLANT.n)
    world.start()
    assert world.move()


def test_a_single_input_that_was_not_applied_is_found_out_although_later_echoes_are_lost():
    loop = loop_with(echo_age=30)
    world = World(loop)
    world.start()
    for step in range(60):
        world.move(is_heard=not 20 <= step < 23)  # three commands in a row are lost: one input is missing
        if 20 <= step < 40:
            world.echoes = []
        assert (loop.reason == LATE_INPUT) is (step > 40)


def reasons_of(loop, echoes_at):
    """What the loop says in 40 steps; `echoes_at` returns what it hears back of the echoes of a step."""
    world, reasons = World(loop), []
    world.start()
    for step in range(40):
        world.move()
        reasons.append(loop.reason)
        world.echoes = echoes_at(step, world.echoes)
    return reasons


def test_silent_actuator_is_not_trusted_for_longer_than_asked_for():
    reasons = reasons_of(loop_with(echo_age=4), lambda step, echoes: [] if 10 <= step < 20 else echoes)
    assert reasons == [""] * 15 + [NOT_CONFIRMED] * 6 + [""] * 19


def test_echoes_of_another_episode_are_a_reason_of_their_own_while_they_come():
    loop = loop_with(echo_age=4)

    def strange_then_none(step, echoes):
        if 10 <= step < 20:
            return [each._replace(episode=loop.episode + 1) for each in echoes]
        return [] if 20 <= step < 30 else echoes

    reasons = reasons_of(loop, strange_then_none)
    assert reasons == [""] * 15 + [OTHER_EPISODE] * 10 + [NOT_CONFIRMED] * 6 + [""] * 9


@pytest.mark.parametrize("input_delay", [0, 2, 5])
def test_wild_stamps_and_inputs_do_not_stop_an_actuator(input_delay):
    actuator = Actuator(input_delay, 1, 10.0)
    inputs, size = np.ones((input_delay + 1, 1)), 0
    for step in range(100):
        wild = [Command(stamp, -inputs) for stamp in (10**9, 2**62, step + input_delay + 2, -(10**9))]
        wild += [Command(step, size * inputs) for size in (1e6, -10.001)]
        actuator.receive([*wild, Command(step, inputs), *wild])
        u = actuator.apply(step)
        assert u.tolist() == [1.0 if step >= input_delay else 0.0]
        size = len(pickle.dumps(actuator)) if step == 10 else size
    assert actuator.echo.missing == 0
    assert actuator.refused == 100 * 10
    assert len(pickle.dumps(actuator)) < 2 * size


def test_actuator_takes_commands_of_its_episode_alone_and_repeats_nothing():
    actuator = Actuator(2, 1)
    actuator.start(episode=1)
    actuator.receive([Command(2, np.full((3, 1), 9.0), 0), Command(2, np.ones((3, 1)), 1)])  # of steps 2, 3 and 4
    assert [actuator.apply(step).item() for step in range(6)] == [0.0, 0.0, 1.0, 1.0, 1.0, 0.0]
    assert actuator.missing


def test_actuator_counts_a_step_that_it_left_out():
    actuator = Actuator(0, 1)
    for step in (0, 2):
        actuator.receive([Command(step, np.ones((1, 1)))])
        assert actuator.apply(step).item() == 1.0
    assert actuator.echo.missing == 1


def test_actuator_whose_clock_goes_back_says_that_it_applied_something_else():
    actuator = Actuator(0, 1)
    actuator.receive([Command(step, np.full((1, 1), 1.0 + step)) for step in range(2)])
    for step in range(3):
        actuator.apply(step)
    echo = actuator.echo
    actuator.apply(2)  # once more
    assert actuator.echo == echo
    actuator.apply(1)
    assert actuator.echo.missing == echo.missing + 1
    assert actuator.echo.digest != echo.digest
