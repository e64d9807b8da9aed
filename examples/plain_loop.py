"""Shows estimator and shield without Gymnasium, as plain functions in a control loop of your own."""

import numpy as np

from ncs_gym import Channel, Estimator, Packet, truck_trailer
from shields import SafetyFilter, synthesize

plant, channel = truck_trailer(mass=4000.0), Channel(loss=0.3, delay=1, quantization_step=0.05)
shield = SafetyFilter(synthesize(plant), plant, mode="project")
estimator = Estimator(plant, channel)

rng = np.random.default_rng(0)
x = np.zeros(2)  # This simulation takes the place of the real plant.
estimator.reset(x + plant.initial_noise.sample(rng))
in_flight, overridden, worst = [], 0, 0.0
for step in range(1000):
    proposed = np.array([2.2 if step % 50 < 25 else -2.2])  # Your controller goes here.
    decision = shield.decide(estimator.belief.mean, estimator.belief.shape, proposed)
    overridden += decision.intervened
    x = plant.A @ x + plant.B @ decision.input + plant.process_noise.sample(rng)
    arrived = in_flight  # What was sent one step ago arrives now, because the delay is one step.
    y = plant.H @ x + plant.sensor_noise.sample(rng)
    y = channel.quantization_step * np.round(y / channel.quantization_step)
    in_flight = [] if rng.random() < channel.loss else [Packet(stamp=step + 1, measurement=y)]
    estimator.advance(decision.input, arrived)
    worst = max(worst, float(np.abs(plant.C @ x).max()))
print(f"overridden: {overridden} of 1000; closest to the limit: {worst:.3f} (violated above 1)")
