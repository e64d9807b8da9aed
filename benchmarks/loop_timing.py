"""How long a step of a controller node takes, by mode: decode what arrived, receive, decide, encode what is sent.

    python benchmarks/loop_timing.py [--steps 100000] [--plants cart-pole] [--modes project lookahead]

Median, 99.9 % and worst case in microseconds, of the thread's own time on the processor and, whatever else the machine
does, on the clock; and by how much the resident memory has grown since a tenth of the steps. The loop meets every
arrival history for the first time; the row below is about its second half, when most have been met. The garbage
collector is frozen and off.
"""

from __future__ import annotations

import argparse
import gc
import os
import time
from pathlib import Path

import numpy as np

from ncs_gym import Actuator, Channel, ChannelContract, Echo, batch_reactor, cart_pole, truck_trailer
from ncs_gym.network.packet_loss_and_delay import ChannelState
from ncs_gym.network.wire import Kind, Message, Wire
from shields import SafeLoop, synthesize

CHANNEL = Channel(loss=0.2, delay=1, jitter=1, max_consecutive_losses=2)
ON_AIR = Channel(loss=0.2, jitter=1, max_consecutive_losses=2)  # what arrives is received at the next step
DOWNLINK = Channel(loss=0.2, delay=1, max_consecutive_losses=1)
PLANTS = {"truck-trailer": truck_trailer(mass=4000.0), "cart-pole": cart_pole(), "batch reactor": batch_reactor()}
MODES = ("project", "switch", "boundary", "lookahead", "monitor")


def resident() -> float:
    """Resident memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def run(loop: SafeLoop, steps: int) -> tuple[np.ndarray, float]:
    """Microseconds of each step on the processor and on the clock, shape (2, steps), and the growth of memory [MB]."""
    plant, rng = loop.filter.plant, np.random.default_rng(0)
    wire, actuator = Wire(plant, loop.input_delay, bytes(32)), Actuator(loop.input_delay, plant.m)
    ways = ChannelState(ON_AIR, rng), ChannelState(ON_AIR, rng)
    state, taken, arrived, began = np.zeros(plant.n), np.zeros((2, steps)), [], 0.0
    taken += 1.0  # in memory from now on
    loop.start(state)
    for step in range(steps):
        if step == steps // 10:
            began = resident()
        proposed = plant.u_max * (1.0 if step // 50 % 2 else -1.0)
        if loop.filter.mode == "monitor":  # which lets it pass: it must not lead out of the box
            proposed = loop.filter.certificate.K @ loop.estimate
        start = np.array([time.thread_time(), time.perf_counter()])
        messages = [wire.decode(data) for data in arrived]
        echoes = [Echo(each.stamp, each.missing, each.digest) for each in messages if each.kind is Kind.ECHO]
        loop.receive([(each.stamp, each.values) for each in messages if each.kind is Kind.SAMPLE], echoes=echoes)
        loop.decide(proposed)
        command = loop.command()
        wire.encode(Message(kind=Kind.COMMAND, episode=1, stamp=step, values=command.inputs))
        requests = (True,) * len(command.inputs)
        wire.encode(Message(kind=Kind.BEACON, episode=1, stamp=step, requests=requests))
        taken[:, step] = np.array([time.thread_time(), time.perf_counter()]) - start
        actuator.receive([command])
        y = plant.H @ state + plant.sensor_noise.bound.sample_boundary(rng)
        u, said = actuator.apply(step), actuator.echo
        echo = Message(kind=Kind.ECHO, episode=1, stamp=said.steps, missing=said.missing, digest=said.digest)
        sample = Message(kind=Kind.SAMPLE, episode=1, stamp=step, values=y)
        sent = zip(ways, (sample, echo), strict=True)
        arrived = [data for way, each in sent for data in way.carry(rng, step, wire.encode(each))]
        state = plant.A @ state + plant.B @ u + plant.nominal_disturbance.sample_boundary(rng)
    assert loop.guaranteed, loop.reason
    grown = resident() - began
    return 1e6 * taken, grown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--plants", nargs="+", choices=PLANTS, default=[*PLANTS])
    parser.add_argument("--modes", nargs="+", choices=MODES, default=[*MODES])
    options = parser.parse_args()
    steps = options.steps
    gc.disable()
    print(f"{steps:,} steps, microseconds{'':<16}{'processor':<30}{'clock':<24}{'memory [MB]':>11}")
    for name in options.plants:
        plant = PLANTS[name]
        certificate = synthesize(plant, contract=ChannelContract(6))
        for mode in options.modes:
            settings = {"downlink": DOWNLINK, "echo_age": 10, "on_unproved": "ignore"}
            gc.collect()
            gc.freeze()
            loop = SafeLoop(certificate, plant, CHANNEL, mode, 6 if mode == "lookahead" else None, **settings)
            taken, grown = run(loop, steps)
            for row, part in (("all", taken), ("second half", taken[:, steps // 2 :])):
                quantiles = np.quantile(part, [0.5, 0.999, 1.0], axis=1).T.ravel()
                figures = "".join(f"{q:9.0f}" for q in quantiles)
                print(f"{name:<16}{mode:<12}{row:<18}{figures}{grown:10.1f}", flush=True)


if __name__ == "__main__":
    main()
