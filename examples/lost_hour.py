"""Loses every packet for an hour: a proof for any silence goes on, one under a contract ends until packets return.

Takes about nine seconds on one core.
"""

import numpy as np

from ncs_gym import Channel, ChannelContract, Packet, truck_trailer
from shields import SafeLoop, synthesize

plant, channel = truck_trailer(mass=4000.0), Channel(quantization_step=0.05)
hour = int(3600 / plant.dt)


def run(contract: ChannelContract | None) -> None:
    """Simulates ten minutes with packets, an hour without, and ten minutes with packets again."""
    # Whether the proof holds is counted here, so that a warning would say nothing new.
    loop = SafeLoop(synthesize(plant, contract=contract), plant, channel, on_unproved="ignore")
    rng, state = np.random.default_rng(0), np.zeros(plant.n)
    loop.start(state + plant.initial_noise.sample(rng))
    packets, proved, violations, reason = [], 0, 0, ""
    for step in range(hour // 6 + hour + hour // 6):
        loop.receive(packets)
        # Your controller goes here; this one is reckless.
        decision = loop.decide(plant.largest_input if step % 40 < 20 else -plant.largest_input)
        proved, reason = proved + loop.guaranteed, loop.reason or reason
        state = plant.A @ state + plant.B @ decision.input + plant.nominal_disturbance.sample_boundary(rng)
        violations += bool((plant.constraint_values(state) > 0.0).any())
        connected = not hour // 6 <= step < hour // 6 + hour
        y = plant.H @ state + plant.sensor_noise.sample(rng)
        packets = [Packet(loop.steps + 1, channel.quantize(y), loop.episode)] if connected else []
    print(f"proved in {proved} of {step + 1} steps, outside the box in {violations}; now: {loop.guaranteed}")
    if reason:
        print(f"where it was not proved: {reason}")


run(None)
run(ChannelContract(max_age=4, quantization_step=0.05))  # smaller error sets, for samples at most four steps old
