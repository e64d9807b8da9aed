"""How long one step of a `SafeLoop` takes, receive and decide together: median, 99.9 % and worst case.

    python benchmarks/safe_loop.py [--steps 20000]

"first" is an episode of a new loop, which works out what each arrival pattern needs when it meets it; "again" the same
steps once more. Times are the thread's own on the processor; "on the clock" is the worst case with everything else that
the machine does. The garbage collector is off, as it should be in a real-time loop.
"""

from __future__ import annotations

import argparse
import gc
import time

import numpy as np

from ncs_gym import Channel, ChannelContract, LinearPlant, batch_reactor, cart_pole, truck_trailer
from ncs_gym.network.packet_transmission import ChannelState
from shields import SafeLoop, synthesize

CASES = {
    "truck-trailer": (
        truck_trailer(mass=4000.0),
        None,
        Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2),
    ),
    "cart-pole, contract": (cart_pole(), ChannelContract(4), Channel(loss=0.4, max_consecutive_losses=2, jitter=2)),
    "batch reactor, contract": (
        batch_reactor(),
        ChannelContract(3),
        Channel(loss=0.4, max_consecutive_losses=2, jitter=1),
    ),
}
# "switch" is timed where the projection takes long, on more than one input.
MODES = dict.fromkeys(CASES, ("project",)) | {"batch reactor, contract": ("project", "switch")}


def seconds_per_step(loop: SafeLoop, plant: LinearPlant, channel: Channel, steps: int) -> np.ndarray:
    """Runs an episode under random proposals; returns the duration of each step, processor and clock, (2, steps)."""
    rng, x, seconds = np.random.default_rng(0), np.zeros(plant.n), np.zeros((2, steps))
    state, packets = ChannelState(channel, rng), []
    proposals = rng.uniform(-1.0, 1.0, (steps, plant.m)) * plant.u_max
    loop.start(x)
    for step, proposed in enumerate(proposals):
        clock, start = time.perf_counter(), time.thread_time()
        decision = loop.step(proposed, packets)
        seconds[:, step] = time.thread_time() - start, time.perf_counter() - clock
        x = plant.A @ x + plant.B @ decision.input + plant.process_noise.sample(rng)
        y = plant.H @ x + plant.sensor_noise.sample(rng)
        packets = state.exchange(rng, step + 1, y if state.sends_at(step + 1) else None, loop.episode)
    assert loop.guaranteed, loop.reason
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=20_000)
    options = parser.parse_args()
    gc.disable()
    print(f"{'plant':26s}{'mode':10s}{'run':7s}{'median':>9s}{'99.9 %':>9s}{'max':>9s}{'on the clock':>14s}  [us]")
    for name, (plant, contract, channel) in CASES.items():
        certificate = synthesize(plant, contract=contract, safe_set="ellipsoid")
        for mode in MODES[name]:
            loop = SafeLoop(certificate, plant, channel, mode)
            for run in ("first", "again"):
                spent, passed = 1e6 * seconds_per_step(loop, plant, channel, options.steps)
                figures = np.median(spent), np.quantile(spent, 0.999), spent.max()
                row = "".join(f"{each:9.0f}" for each in figures)
                print(f"{name:26s}{mode:10s}{run:7s}{row}{passed.max():14.0f}", flush=True)


if __name__ == "__main__":
    main()
