"""Keeps a servo safe over UDP for seven seconds: plant and controller exchange datagrams, and the network is cut.

All of it is one program here. On two machines both count steps by clocks that agree (PTP), and datagrams of others have
to be kept out (a VPN, DTLS). Another transport (ROS 2, DDS, CAN, Zenoh) takes the place of the sockets alone.
"""

import asyncio
import json

import numpy as np

from ncs_gym import Actuator, Bounds, Channel, Echo, Limits, LinearPlant, Model, Packet
from shields import SafeLoop, synthesize

plant = LinearPlant(  # angle [rad] and speed by a voltage [V]
    Model.sampled([[0.0, 1.0], [-4.0, -2.5]], [[0.0], [6.0]], None, dt=0.05),
    Limits(state=[0.5, 2.0], input=3.0),
    Bounds(disturbance=[2e-3, 2e-2], sensor=[1e-3, 1e-2], first_error=[1e-3, 1e-2]),
)
# The contract of both ways: of two datagrams in a row one arrives, a step later, or up to seven on a busy computer.
network = Channel(loss=0.25, delay=1, jitter=6, max_consecutive_losses=1)
loop = SafeLoop(synthesize(plant), plant, network, downlink=network, echo_age=9, on_unproved="ignore")
STEPS, CUT = 140, range(80, 105)


class Socket(asyncio.DatagramProtocol, list):
    """What arrived and waits for its step: messages, which begin with a stamp."""

    def datagram_received(self, data, addr):
        """Is called by asyncio."""
        self.append(json.loads(data))

    def due(self, step):
        """Returns the messages that are not stamped ahead of a step."""
        due = [message for message in self if message[0] <= step]
        self[:] = [message for message in self if message[0] > step]
        return due


async def opened():
    """Returns a socket, and a function that sends to it over the bad network."""
    clock, rng = asyncio.get_running_loop(), np.random.default_rng(0)
    address, socket = await clock.create_datagram_endpoint(Socket, local_addr=("127.0.0.1", 0))
    sender, _ = await clock.create_datagram_endpoint(Socket, remote_addr=address.get_extra_info("sockname"))

    def send(*message):
        if message[0] % 4 and message[0] not in CUT:
            clock.call_later(rng.uniform(0.0, plant.dt), sender.sendto, json.dumps(message).encode())

    return socket, send


async def run_plant(wait_for, commands, send):
    """Simulates the servo, which applies at each step what was committed for it, or 0; prints how it went."""
    rng, x, worst, actuator = np.random.default_rng(0), np.zeros(plant.n), 0.0, Actuator(loop.input_delay, plant.m)
    for step in range(STEPS):
        await wait_for(step)
        y, echo = plant.H @ x + plant.nominal_sensor_error.sample_boundary(rng), actuator.echo
        send(step, y.tolist(), echo.steps, echo.missing, echo.digest.hex())
        actuator.receive(commands.due(step))
        x = plant.A @ x + plant.B @ actuator.apply(step) + plant.nominal_disturbance.sample_boundary(rng)
        worst = max(worst, float(np.abs(plant.box @ x).max()))
    print(f"closest to the limit: {worst:.3f} (violated above 1); no command in time: {actuator.echo.missing} steps")


async def run_controller(wait_for, samples, send):
    """Decides at each step, and prints in how many the state was proved to be safe."""
    proved = 0
    loop.start(np.zeros(plant.n))
    for step in range(STEPS):
        await wait_for(step)
        heard = samples.due(step)
        echoes = [Echo(steps, missing, bytes.fromhex(digest)) for *_, steps, missing, digest in heard]
        estimate = loop.receive([Packet(stamp, y) for stamp, y, *_ in heard], echoes=echoes)
        loop.decide(10.0 * ((0.8 if step // 40 % 2 else -0.8) - estimate[:1]))  # yours; this target is outside the box
        send(step, loop.command().inputs.tolist())
        proved += loop.guaranteed
    print(f"proved: {proved} of {STEPS} steps; now: {loop.guaranteed}, {loop.reason}")


async def main():
    """Runs plant and controller side by side."""
    (commands, to_plant), (samples, to_controller) = await opened(), await opened()
    clock = asyncio.get_running_loop()
    start = clock.time()
    wait_for = lambda step: asyncio.sleep(start + step * plant.dt - clock.time())  # noqa: E731
    await asyncio.gather(run_plant(wait_for, commands, to_controller), run_controller(wait_for, samples, to_plant))


asyncio.run(main())
