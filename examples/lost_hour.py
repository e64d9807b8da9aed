"""Loses every packet for an hour: what goes on being proved with a bound for any silence, and with a contract."""

import numpy as np

from ncs_gym import Channel, ChannelContract, Ellipsoid, Packet, truck_trailer
from shields import SafeLoop, synthesize

plant, channel = truck_trailer(mass=4000.0), Channel(quantization_step=0.05)
hour = int(3600 / plant.dt)


def run(contract: ChannelContract | None) -> None:
    """Simulates ten minutes with packets, an hour without, and ten minutes with packets again."""
    loop = SafeLoop(synthesize(plant, contract=contract), plant, channel)
    rng, state = np.random.default_rng(0), np.zeros(plant.n)
    loop.start(state + plant.initial_noise.sample(rng))
    print(f"contract: {contract}")
    for name, steps, connected in (("before", hour // 6, True), ("silence", hour, False), ("after", hour // 6, True)):
        packets, violations, reasons = [], 0, {}
        for step in range(steps):
            decision = loop.step(plant.u_max if step % 40 < 20 else -plant.u_max, packets)
            reasons[loop.reason] = reasons.get(loop.reason, 0) + 1
            disturbance = plant.nominal_disturbance.sample_boundary(rng)
            state = plant.A @ state + plant.B @ decision.input + disturbance
            y = plant.H @ state + plant.sensor_noise.sample(rng)
            packets = [Packet(loop.steps + 1, channel.quantize(y))] if connected else []
            violations += bool((plant.constraint_values(state) > 0.0).any())
        doubts = ", ".join(f"{why} ({count} steps)" for why, count in reasons.items() if why)
        error = Ellipsoid(loop.error_shape).support(np.array([1.0, 0.0]))
        print(
            f"{name:8s}error up to {error:.2f} m, outside: {violations}, "
            f"proved: {reasons.get('', 0)} of {steps} {doubts}"
        )


run(None)
run(ChannelContract(max_age=4, quantization_step=0.05))
