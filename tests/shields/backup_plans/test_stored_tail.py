"""What is guaranteed while the rest of a plan is applied, after it ran out, and while the error is not certified."""

import numpy as np
import pytest

from ncs_gym import Packet
from shields.runtime.guard import NOT_KNOWN_INSIDE, OLD_SAMPLE
from tests.certificates import certificate_of
from tests.product import safe_loop
from tests.shields.attacks.cases import plan_case

NAMES = ("cruise", "cart-pole", "batch reactor")
CHANNEL = "constant delay"


class World:
    """A plant beside its loop, begun outside S with a plan of at least so many inputs; nature pushes outwards."""

    def __init__(self, name, seed, least=1):
        self.plant, horizon, channel, contract = plan_case(name, CHANNEL if name != "cruise" else "overtaking")
        self.safe = certificate_of(self.plant, contract).safe_set
        self.loop = safe_loop(certificate_of(self.plant, contract), self.plant, channel, "lookahead", horizon=horizon)
        self.contract, self.rng = contract, np.random.default_rng(seed)
        self.stored = 0
        while not (self.stored >= least and self.loop.guaranteed):
            self.x = self.rng.uniform(-0.95, 0.95, self.plant.n) * self.plant.half_widths
            if self.safe.gauge(self.x) > 1.0:
                error = self.plant.initial_noise.bound.sample_boundary(self.rng)
                self.loop.start(self.x + (1.0 - 1e-9) * error, initial_set=self.x)
                self.stored = self.loop.plan_length

    def step(self, heard=True):
        """A step in which the controller fails, so that what is stored is applied; returns the decision."""
        decision = self.loop.decide(None)
        nominal = self.plant.A @ self.x + self.plant.B @ decision.input
        row = self.plant.box[np.argmax(np.abs(self.plant.box @ nominal))]
        self.x = nominal + self.plant.nominal_disturbance.extreme_point(np.sign(row @ nominal) * row)
        noise = self.plant.sensor_noise.bound.sample_boundary(self.rng)
        sample = Packet(self.loop.steps + 1, self.plant.H @ self.x + (1.0 - 1e-9) * noise, self.loop.episode)
        self.loop.receive([sample] if heard else [])
        assert np.abs(self.plant.box @ self.x).max() <= 1.0
        return decision


@pytest.mark.parametrize("name", NAMES)
def test_after_its_last_input_the_state_is_in_the_safe_set_and_stays_guaranteed_without_a_plan(name):
    for seed in range(8):
        world = World(name, seed)
        for left in reversed(range(world.stored)):
            assert world.step().reason == "stored"
            assert world.loop.plan_length == left
            assert world.loop.guaranteed
        assert world.safe.gauge(world.x) <= 1.0
        for _ in range(12):
            decision = world.step()
            assert decision.fallback
            assert not decision.stored
            assert world.loop.plan_length == 0
            assert world.loop.guaranteed, world.loop.reason
            assert world.safe.gauge(world.x) <= 1.0


def test_a_stored_tail_keeps_the_box_in_silence_and_proves_again_once_the_error_is_certified():
    doubted = recovered = 0
    for seed in range(6):
        world = World("cart-pole", seed, least=world_age() + 3)
        for k in range(world.stored - 1):
            heard = k > world_age() + 1
            world.step(heard)
            too_old = world.loop.measurement_age > world_age()
            assert world.loop.guaranteed is not too_old
            assert world.loop.reason == (OLD_SAMPLE if too_old else "")
            doubted += too_old
            recovered += heard
        assert world.loop.plan_length == 1
    assert doubted > 0
    assert recovered > 0


def world_age():
    """Largest age of a measurement under the contract of the cart-pole."""
    return plan_case("cart-pole", CHANNEL)[3].max_age


def test_a_tail_that_ends_in_silence_ends_in_the_safe_set_and_the_fallback_proves_nothing_more():
    proved = set()
    for seed in range(10):
        world = World("cart-pole", seed, least=world_age() + 1)
        for _ in range(world.stored):
            world.step(heard=False)
        assert world.safe.gauge(world.x) <= 1.0
        assert world.loop.reason == OLD_SAMPLE
        for _ in range(8):
            decision, loop = world.step(heard=False), world.loop
            assert decision.fallback
            is_known = bool(decision.proved or loop.filter.knows_inside(loop.estimate, loop.error_shape))
            assert loop.reason == (OLD_SAMPLE if is_known else NOT_KNOWN_INSIDE)
            proved.add(is_known)
    assert False in proved
