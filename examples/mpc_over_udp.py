"""A servo of python-control's and a model predictive controller in cvxpy, kept safe over UDP by nodes of this project.

Sensor and actuator share a board and a clock, the controller has its own; here they are tasks of one program, on three
machines they would be three programs. Without python-control the same matrices are used.

Takes about ten seconds on one core.
"""

import asyncio
import os

import cvxpy as cp
import numpy as np

from ncs_gym import Actuator, Channel, LinearPlant
from ncs_gym.network.wire import Wire
from shields import ActuatorNode, ControllerNode, SafeLoop, SensorNode, synthesize
from shields.nodes import StepClock, UdpTransport, run_controller, run_plant_side

# A servo: angle [rad] and speed [rad/s], driven by a voltage [V].
MATRICES = [[0.0, 1.0], [-4.0, -2.5]], [[0.0], [6.0]], [[1.0, 0.0], [0.0, 1.0]], [[0.0], [0.0]]
try:
    import control

    model = control.ss(*MATRICES)
except ImportError:
    model = MATRICES
plant = LinearPlant.from_statespace(
    model,
    dt=0.05,
    box=[0.5, 2.0],
    u_max=3.0,
    disturbance_bound=[2e-3, 2e-2],
    sensor_bound=[1e-3, 1e-2],
    initial_bound=[1e-3, 1e-2],
)
STEPS, ROOM = 120, 6  # What a busy machine may be late by, in steps of 50 ms.
network = Channel(delay=1, jitter=ROOM)
loop = SafeLoop(synthesize(plant), plant, network, downlink=network, echo_age=2 * ROOM, on_unproved="ignore")

# The controller: eight steps ahead on the model; it follows a target that lies outside the box, and ignores the box.
u, target = cp.Variable((plant.m, 8)), cp.Parameter()
x0, x, cost = cp.Parameter(plant.n), None, 0.0
for k in range(8):
    x = plant.A @ (x0 if x is None else x) + plant.B @ u[:, k]
    cost += cp.square(x[0] - target) + 1e-3 * cp.sum_squares(u[:, k])
problem = cp.Problem(cp.Minimize(cost), [cp.abs(u) <= plant.u_max[0]])
calls = 0


def mpc(estimate):
    """Returns the first input of the plan; what takes longer than half a step is not waited for."""
    global calls
    calls += 1
    x0.value, target.value = estimate, 0.8 if calls // 40 % 2 == 0 else -0.8
    problem.solve(solver=cp.CLARABEL)
    return u.value[:, 0]


async def main():
    """Runs plant and controller side by side, over sockets of this machine."""
    key = os.urandom(32)  # On three machines: one file for all, that nobody else can read.
    wire, rng = Wire(plant, loop.input_delay, key), np.random.default_rng(0)
    at_controller = await UdpTransport.open(local=("127.0.0.1", 0))
    node = ControllerNode(loop, wire, at_controller, StepClock(plant.dt), np.zeros(plant.n), known=True)
    clock, board = StepClock(plant.dt), Actuator(loop.input_delay, plant.m, plant.largest_input)
    sensor = SensorNode(wire, await UdpTransport.open(peer=at_controller.address), clock)
    actuator = ActuatorNode(wire, await UdpTransport.open(peer=at_controller.address), clock, board)
    state, worst, overridden, proved, last = np.zeros(plant.n), 0.0, 0, 0, -1

    def act(step):  # This simulation takes the place of the servo, which does not wait for a busy computer.
        nonlocal state, worst, last
        for each in range(min(last + 1, step), step + 1):
            sensor.send(each, plant.H @ state + plant.nominal_sensor_error.sample_boundary(rng))
            applied = actuator.apply(each)
            if each < 0:
                continue
            last = each
            state = plant.A @ state + plant.B @ applied + plant.nominal_disturbance.sample_boundary(rng)
            worst = max(worst, float(np.abs(plant.box_rows @ state).max()))

    def note(node, proposed):
        nonlocal overridden, proved
        overridden, proved = overridden + node.decision.intervened, proved + node.loop.guaranteed

    ended = lambda: node.step >= STEPS  # noqa: E731
    await asyncio.gather(run_controller(node, mpc, note, ended), run_plant_side([sensor, actuator], act, ended))
    print(
        f"closest to the limit: {worst:.3f} (violated above 1); overridden: {overridden}, proved: {proved} of {STEPS}"
    )
    print(f"proved now: {loop.guaranteed} {loop.reason}")
    print(f"inputs that did not arrive in time: {node.missing}; steps decided too late: {node.skipped}")


asyncio.run(main())
