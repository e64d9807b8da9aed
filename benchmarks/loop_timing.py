"""How long a step of a controller node takes, by mode: decode what arrived, receive, decide, encode what is sent.

    python benchmarks/loop_timing.py [--steps 100000]

In real time, whatever else the machine does: median, 99.9 % and worst case in microseconds, and by how much the
resident memory has grown since a tenth of the steps. "cold" is a loop that meets every arrival history for the first
time, "rehearsed" another one that runs through the same steps again; the garbage collector is frozen and off.
"""

from __future__ import annotations

import argparse
import gc
import os
import time
from pathlib import Path

import numpy as np

from ncs_gym import Actuator, Channel, ChannelContract, batch_reactor, cart_pole
from ncs_gym.network.packet_transmission import ChannelState
from ncs_gym.network.wire import Kind, Message, Wire
from shields import SafeLoop, synthesize

CHANNEL = Channel(loss=0.2, delay=1, jitter=1, max_consecutive_losses=2)
DOWNLINK = Channel(loss=0.2, delay=1, max_consecutive_losses=1)
PLANTS = {"cart-pole": cart_pole(), "batch reactor": batch_reactor()}
MODES = ("project", "switch", "boundary", "lookahead", "monitor")


def resident() -> float:
    """Resident memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def run(loop: SafeLoop, steps: int) -> tuple[np.ndarray, float]:
    """Microseconds of each step, and the growth of memory [MB]."""
    plant, rng = loop.filter.plant, np.random.default_rng(0)
    wire, channel, actuator = (
        Wire(plant, loop.lead, bytes(32)),
        ChannelState(CHANNEL, rng),
        Actuator(loop.lead, plant.m),
    )
    state, taken, arrived, began = np.zeros(plant.n), np.empty(steps), [], 0.0
    loop.start(state)
    for step in range(steps):
        if step == steps // 10:
            began = resident()
        proposed = plant.u_max * (1.0 if step // 50 % 2 else -1.0)
        start = time.perf_counter()
        messages = [wire.decode(data) for data in arrived]
        loop.receive([(each.stamp, each.values) for each in messages])
        loop.decide(proposed)
        command = loop.command()
        wire.encode(Message(kind=Kind.COMMAND, episode=1, stamp=step, values=command.inputs))
        wire.encode(Message(kind=Kind.BEACON, episode=1, stamp=step))
        taken[step] = time.perf_counter() - start
        actuator.receive([command])
        y = plant.H @ state + plant.sensor_noise.bound.sample_boundary(rng)
        arrived = channel.carry(rng, step, wire.encode(Message(kind=Kind.SAMPLE, episode=1, stamp=step, values=y)))
        u = actuator.apply(step)
        state = plant.A @ state + plant.B @ u + plant.nominal_disturbance.sample_boundary(rng)
    return 1e6 * taken, resident() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100_000)
    steps = parser.parse_args().steps
    gc.disable()
    print(f"{steps:,} steps, microseconds{'':<22}{'median':>10}{'99.9 %':>10}{'max':>10}{'memory [MB]':>14}")
    for name, plant in PLANTS.items():
        certificate = synthesize(plant, contract=ChannelContract(6))
        for mode in MODES:
            settings = {"downlink": DOWNLINK, "on_unproved": "ignore"}
            gc.collect()
            gc.freeze()
            for row in ("cold", "rehearsed"):
                loop = SafeLoop(certificate, plant, CHANNEL, mode, 6 if mode == "lookahead" else None, **settings)
                taken, grown = run(loop, steps)
                quantiles = np.quantile(taken, [0.5, 0.999, 1.0])
                print(f"{name:<16}{mode:<12}{row:<18}" + "".join(f"{q:10.0f}" for q in quantiles) + f"{grown:14.1f}")


if __name__ == "__main__":
    main()
