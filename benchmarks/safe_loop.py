"""How long one step of a `SafeLoop` takes, receive and decide together: median, 99.9 % and worst case.

    python benchmarks/safe_loop.py [--steps 20000] [--cases "motor"] [--once]

"first" is an episode of a new loop, which works out what each arrival pattern needs when it meets it; "again" the same
steps once more. Times are the thread's own on the processor; "on the clock" is the worst case with everything else that
the machine does. The garbage collector is off, as it should be in a real-time loop. The last two columns say by how
much the resident memory has grown since the loop was made, after a tenth of the steps and after all of them.
"""

from __future__ import annotations

import argparse
import gc
import os
import time
from pathlib import Path

import numpy as np

from ncs_gym import Channel, ChannelContract, LinearPlant, batch_reactor, cart_pole, truck_trailer
from ncs_gym.network.packet_loss_and_delay import ChannelState
from ncs_gym.plants.statespace import zero_order_hold
from shields import SafeLoop, synthesize


def motor(spring: float = 0.0) -> LinearPlant:
    """A motor, behind a spring or not: angle [rad], speed [rad/s] and current [A], of which the speed is not measured.

    What its sensors say is worth averaging over many samples, so that arrival histories hardly recur.
    """
    A, B = zero_order_hold(
        np.array([[0.0, 1.0, 0.0], [-spring, -2.0, 20.0], [0.0, -0.5, -10.0]]), np.array([[0.0], [0.0], [10.0]]), 0.01
    )
    bounds = {
        "disturbance_bound": [5e-4, 5e-3, 5e-3],
        "sensor_bound": [2e-3, 0.01],
        "initial_bound": [2e-3, 0.01, 0.01],
    }
    return LinearPlant(
        A=A, B=B, H=[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], box=[1.0, 5.0, 3.0], u_max=5.0, dt=0.01, **bounds
    )


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
    "motor, contract": (motor(), ChannelContract(2), Channel(loss=0.2, max_consecutive_losses=2)),
    "motor, late, contract": (motor(), ChannelContract(4), Channel(loss=0.2, max_consecutive_losses=2, jitter=2)),
    "motor with spring": (motor(20.0), None, Channel(loss=0.2)),
}
# "switch" is timed where the projection takes long, on more than one input.
MODES = dict.fromkeys(CASES, ("project",)) | {"batch reactor, contract": ("project", "switch")}


def resident() -> float:
    """Resident memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def seconds_per_step(
    loop: SafeLoop, plant: LinearPlant, channel: Channel, steps: int
) -> tuple[np.ndarray, tuple[float, float]]:
    """Runs an episode under random proposals; returns the duration of each step, processor and clock, (2, steps).

    And the growth of memory after a tenth and after all of the steps [MB].
    """
    rng, x, seconds = np.random.default_rng(0), np.zeros(plant.n), np.full((2, steps), np.nan)
    state, packets = ChannelState(channel, rng), []
    proposals = rng.uniform(-1.0, 1.0, (steps, plant.m)) * plant.u_max
    loop.start(x)
    first = tenth = resident()
    for step, proposed in enumerate(proposals):
        clock, start = time.perf_counter(), time.thread_time()
        decision = loop.step(proposed, packets)
        seconds[:, step] = time.thread_time() - start, time.perf_counter() - clock
        if step == steps // 10:
            tenth = resident()
        x = plant.A @ x + plant.B @ decision.input + plant.process_noise.sample(rng)
        y = plant.H @ x + plant.sensor_noise.sample(rng)
        packets = state.exchange(rng, step + 1, y if state.sends_at(step + 1) else None, loop.episode)
    assert loop.guaranteed, loop.reason
    return seconds, (tenth - first, resident() - first)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=[*CASES])
    parser.add_argument("--once", action="store_true", help="leave the same steps once more out")
    options = parser.parse_args()
    gc.disable()
    times = "".join(f"{each:>9s}" for each in ("median", "99.9 %", "max"))
    print(f"{'plant':26s}{'mode':10s}{'run':7s}{times}{'on the clock':>14s}  [us]{'[MB]':>9s}")
    for name in options.cases:
        plant, contract, channel = CASES[name]
        certificate = synthesize(plant, contract=contract, safe_set="ellipsoid")
        for mode in MODES[name]:
            loop = SafeLoop(certificate, plant, channel, mode)
            for run in ("first",) if options.once else ("first", "again"):
                taken, (tenth, end) = seconds_per_step(loop, plant, channel, options.steps)
                spent, passed = 1e6 * taken
                figures = np.median(spent), np.quantile(spent, 0.999), spent.max()
                row = "".join(f"{each:9.0f}" for each in figures)
                print(f"{name:26s}{mode:10s}{run:7s}{row}{passed.max():14.0f}{tenth:9.1f}{end:6.1f}", flush=True)


if __name__ == "__main__":
    main()
