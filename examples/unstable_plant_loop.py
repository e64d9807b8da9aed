"""Balances a cart-pole over a network with a contract; a reckless operator proposes the inputs.

Takes about three seconds on one core.
"""

import numpy as np

from ncs_gym import Channel, ChannelContract, Packet, cart_pole, contract_of
from shields import SafeLoop, synthesize

# The pole falls without samples, so the network has to promise something: at most three losses in a row, at most one
# step of delay. The newest sample is never older than four steps then.
plant = cart_pole()
channel = Channel(loss=0.4, max_consecutive_losses=3, delay=1)
contract = contract_of(channel)
assert contract == ChannelContract(max_age=4)
loop = SafeLoop(synthesize(plant, contract=contract), plant, channel)

rng = np.random.default_rng(0)
state = np.zeros(plant.n)  # This simulation takes the place of the real plant.
loop.start(state + plant.initial_noise.sample(rng))
in_flight, lost, overridden, proved, oldest, worst = [], 0, 0, 0, 0, 0.0
for step in range(5000):
    loop.receive(in_flight)
    proved, oldest = proved + loop.guaranteed, max(oldest, loop.measurement_age)
    push = plant.largest_input * (1.0 if step % 200 < 100 else -1.0)  # Full force one way, then the other.
    decision = loop.decide(push)
    overridden += decision.intervened
    is_lost = lost < channel.max_consecutive_losses and rng.random() < channel.loss
    lost, in_flight = (lost + 1, []) if is_lost else (0, None)
    if in_flight is None:
        y = plant.H @ state + plant.sensor_noise.sample(rng)
        in_flight = [Packet(loop.steps, y, loop.episode)]
    disturbance = plant.nominal_disturbance.sample_boundary(rng)
    state = plant.A @ state + plant.B @ decision.input + disturbance
    worst = max(worst, float(np.abs(plant.box @ state).max()))
print(f"oldest sample in use: {oldest} steps, allowed: {loop.contract.max_age}")
print(f"overridden: {overridden} of 5000, closest to the limit: {worst:.5f} (violated above 1)")
print(f"proved: {proved} of 5000 steps")
