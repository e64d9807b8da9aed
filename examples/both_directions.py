"""Balances a cart-pole over a radio that loses and delays samples and commands, against a reckless operator.

Takes about nine seconds on one core.
"""

import numpy as np

from ncs_gym import Actuator, Channel, ChannelContract, Packet, cart_pole, contract_of
from shields import SafeLoop, synthesize

# Both ways at most two losses in a row, and one step of delay. The newest sample is never older than three steps, and
# what is decided now can take effect three steps later whatever is lost: a certificate has to count both.
plant = cart_pole()
uplink = downlink = Channel(loss=0.4, delay=1, max_consecutive_losses=2)
ages = contract_of(uplink).max_age + contract_of(downlink).max_age
loop = SafeLoop(synthesize(plant, contract=ChannelContract(ages)), plant, uplink, downlink=downlink)
actuator = Actuator(loop.input_delay, plant.m, plant.largest_input)  # This would run next to the motor.


class Radio:
    """One direction of the radio: everything is one step late, if it arrives."""

    def __init__(self, channel, rng):
        self.channel, self.rng, self.lost, self.on_its_way = channel, rng, 0, []

    def send(self, packet):
        """Takes a packet, and returns those that arrive now."""
        arrived = self.on_its_way
        is_lost = self.lost < self.channel.max_consecutive_losses and self.rng.random() < self.channel.loss
        self.lost, self.on_its_way = (self.lost + 1, []) if is_lost else (0, [packet])
        return arrived


rng = np.random.default_rng(0)
up, down = Radio(uplink, rng), Radio(downlink, rng)
state = np.zeros(plant.n)  # This simulation takes the place of the real plant.
loop.start(state + plant.initial_noise.sample(rng))
actuator.start(loop.episode)
decided, as_decided, overridden, proved, worst = [np.zeros(plant.m)] * loop.input_delay, 0, 0, 0, 0.0
for step in range(3000):
    loop.receive(up.send(Packet(step, plant.H @ state + plant.sensor_noise.sample(rng), loop.episode)))
    proved += loop.guaranteed
    push = plant.largest_input * (1.0 if step % 200 < 100 else -1.0)  # Full force one way, then the other.
    decision = loop.decide(push)
    decided.append(decision.input)
    overridden += decision.intervened
    actuator.receive(down.send(loop.command()))
    applied = actuator.apply(step)
    as_decided += np.array_equal(applied, decided[step])  # Three steps ago; nobody acknowledged it.
    state = plant.A @ state + plant.B @ applied + plant.nominal_disturbance.sample_boundary(rng)
    worst = max(worst, float(np.abs(plant.box @ state).max()))
print(f"decided {loop.input_delay} steps ahead; applied as decided: {as_decided} of 3000")
print(f"overridden: {overridden} of 3000, closest to the limit: {worst:.3f} (violated above 1)")
print(f"proved: {proved} of 3000 steps")
