"""Shows a control loop of your own without Gymnasium: the estimate, your controller, and the input that is safe.

Takes about three seconds on one core.
"""

import numpy as np

from ncs_gym import Channel, Packet, truck_trailer
from shields import SafeLoop, synthesize

plant, channel = truck_trailer(mass=4000.0), Channel(loss=0.3, delay=1, quantization_step=0.05)
loop = SafeLoop(synthesize(plant), plant, channel)

rng = np.random.default_rng(0)
x = np.zeros(2)  # This simulation takes the place of the real plant.
loop.start(x + plant.initial_noise.sample(rng))
in_flight, overridden, worst = [], 0, 0.0
for step in range(1000):
    estimate = loop.receive(in_flight)  # What was sent one step ago arrives now, because the delay is one step.
    proposed = 2.2 if step % 50 < 25 else -2.2  # Your controller goes here; it may use the estimate.
    decision = loop.decide(proposed)
    overridden += decision.intervened
    y = plant.H @ x + plant.sensor_noise.sample(rng)
    # The sensor counts steps and episodes as the loop does: a packet of an earlier episode would be discarded.
    packet = Packet(stamp=loop.steps, measurement=channel.quantize(y), episode=loop.episode)
    in_flight = [] if rng.random() < channel.loss else [packet]
    x = plant.A @ x + plant.B @ decision.input + plant.process_noise.sample(rng)
    worst = max(worst, float(np.abs(plant.box @ x).max()))
print(f"overridden: {overridden} of 1000; closest to the limit: {worst:.3f} (violated above 1)")
print(f"proved to be safe: {loop.guaranteed}")
