"""The same loop over real sockets of two kinds, judged by what holds however busy the machine is."""

import asyncio
import concurrent.futures.thread
import itertools
import os
import socket
import threading

import numpy as np
import pytest

from ncs_gym import Actuator, Channel, truck_trailer
from ncs_gym.network.wire import Wire
from shields import ActuatorNode, ControllerNode, SafeLoop, SensorNode
from shields.nodes import StepClock, UdpTransport, run_controller, run_plant_side
from tests.certificates import certificate_of

PLANT = truck_trailer(mass=4000.0)
# What a busy machine may do to steps of 20 ms, without an impairment: hardly ever more.
LATE = Channel(delay=1, jitter=8)
DT, STEPS = 0.02, 60


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as each:
        each.bind(("127.0.0.1", 0))
        return each.getsockname()[1]


async def over_udp():
    port = free_port()
    controller = await UdpTransport.open(local=("127.0.0.1", port))
    return controller, [await UdpTransport.open(peer=("127.0.0.1", port)) for _ in range(2)]


async def over_zeromq():
    zeromq = pytest.importorskip("shields.nodes.zeromq", reason="the extra [zmq] is not installed")
    address = f"tcp://127.0.0.1:{free_port()}"
    key = bytes(range(32))
    return zeromq.ZmqTransport(key, bind=address), [zeromq.ZmqTransport(key, connect=address) for _ in range(2)]


async def run(opened, controller, budget=None):
    """Runs the loop until the controller has made its steps, and returns node, states and inputs that were missing."""
    at_controller, (at_sensor, at_actuator) = await opened()
    loop = SafeLoop(certificate_of(PLANT), PLANT, LATE, downlink=LATE, echo_age=50, on_unproved="ignore")
    wire, rng = Wire(PLANT, loop.input_delay, os.urandom(32)), np.random.default_rng(0)
    node = ControllerNode(loop, wire, at_controller, StepClock(DT), np.zeros(2), known=True)
    clock, board = StepClock(DT), Actuator(loop.input_delay, PLANT.m, PLANT.u_max)
    sensor = SensorNode(wire, at_sensor, clock)
    actuator = ActuatorNode(wire, at_actuator, clock, board)
    state, last, history, reasons = np.zeros(2), itertools.count(), [], []

    def act(step):
        nonlocal state
        sensor.send(step, PLANT.H @ state)
        u = actuator.apply(step)
        if step >= 0:
            history.append((board.echo.missing, float(np.abs(PLANT.box_rows @ state).max())))
            state = PLANT.A @ state + PLANT.B @ u + PLANT.nominal_disturbance.sample_boundary(rng)

    ended = lambda: len(reasons) >= STEPS or next(last) > 100_000  # noqa: E731
    note = lambda node, proposed: reasons.append(node.loop.reason)  # noqa: E731
    await asyncio.gather(
        run_controller(node, controller, note, ended, budget), run_plant_side([sensor, actuator], act, ended)
    )
    for each in (at_controller, at_sensor, at_actuator):
        each.close()
    return node, history, reasons


def full_throttle(estimate):
    return PLANT.u_max


@pytest.mark.parametrize("opened", [over_udp, over_zeromq])
def test_loop_over_sockets_keeps_the_box_while_its_inputs_arrive(opened):
    node, history, reasons = asyncio.run(run(opened, full_throttle))
    assert len(reasons) == STEPS
    assert max(level for missing, level in history if not missing) <= 1.0
    assert any(not missing for missing, _ in history)
    assert node.refused["tag"] == 0
    assert reasons[0] == ""


@pytest.mark.parametrize("last_step", [None, -20, 20], ids=["no controller", "gives up before it starts", "starts"])
def test_steps_are_below_0_until_an_episode_has_started(last_step):
    """A simulated plant that moves before would not start where the controller is told that it does."""
    starts = last_step == 20

    async def numbers():
        at_controller, ways = await over_udp()
        loop = SafeLoop(certificate_of(PLANT), PLANT, LATE, downlink=LATE, echo_age=50, on_unproved="ignore")
        wire, clock = Wire(PLANT, loop.input_delay, bytes(32)), StepClock(DT)
        node = ControllerNode(loop, wire, at_controller, StepClock(DT), np.zeros(2), known=True)
        actuator = ActuatorNode(wire, ways[1], clock, Actuator(loop.input_delay, PLANT.m, PLANT.u_max))
        sensor, steps, joined = SensorNode(wire, ways[0], clock), [], []

        def act(step):
            steps.append(step)
            joined.append(sensor.episode != 0)
            sensor.send(step, np.zeros(PLANT.p))
            actuator.apply(step)

        # Long enough for nodes that have joined to notice that nobody is there, and to count on beyond step 0.
        ended = lambda: node.step >= (last_step or 0)  # noqa: E731
        waiting = [run_plant_side([sensor, actuator], act, ended if starts else lambda: len(steps) >= 140)]
        waiting += [] if last_step is None else [run_controller(node, full_throttle, is_over=ended)]
        await asyncio.gather(*waiting)
        for each in (at_controller, *ways):
            each.close()
        return steps, joined

    steps, joined = asyncio.run(numbers())
    first = joined.index(True) if last_step is not None else len(steps)
    assert steps[:first] == sorted(set(steps[:first]))
    assert all(step < 0 for step in steps[:first])
    assert any(step >= 0 for step in steps) == starts


def test_a_controller_that_fails_is_replaced_by_the_fallback():
    def broken(estimate):
        raise ZeroDivisionError

    node, _, reasons = asyncio.run(run(over_udp, broken))
    assert len(reasons) == STEPS
    assert node.decision.reason == "invalid"


def test_neither_the_loop_nor_the_end_of_the_process_waits_for_a_controller_that_does_not_return():
    """What Python joins at its end are threads that are no daemons, and those of executors."""
    release, threads = threading.Event(), []

    def stuck(estimate):
        threads.append(threading.current_thread())
        release.wait(60.0)

    node, history, reasons = asyncio.run(run(over_udp, stuck, budget=0.001))
    assert len(reasons) == STEPS
    assert node.decision.reason == "invalid"  # what was not proposed is replaced by the fallback
    assert max(level for missing, level in history if not missing) <= 1.0
    (thread,) = threads
    assert thread.is_alive()
    assert thread.daemon
    assert thread not in concurrent.futures.thread._threads_queues
    release.set()
    thread.join(10.0)
    assert not thread.is_alive()
