"""Runs a model predictive controller in a loop without Gymnasium, alone and behind a SafeLoop, under packet loss.

Takes about four seconds on one core.
"""

import cvxpy as cp
import numpy as np

from ncs_gym import Channel, Packet, truck_trailer
from shields import SafeLoop, synthesize

plant, channel = truck_trailer(mass=4000.0), Channel(quantization_step=0.05, delay=1)
certificate = synthesize(plant)

# The controller: ten steps ahead on the model without disturbances, limits softened so that a solution always exists.
HORIZON = 10
x = cp.Variable((plant.n, HORIZON + 1))
u = cp.Variable((plant.m, HORIZON))
slack = cp.Variable(HORIZON, nonneg=True)
start, target = cp.Parameter(plant.n), cp.Parameter()
constraints = [x[:, 0] == start, x[:, 1:] == plant.A @ x[:, :-1] + plant.B @ u, cp.abs(u) <= plant.largest_input[0]]
constraints += [cp.abs(plant.box[i] @ x[:, 1:]) <= 1.0 + slack for i in range(len(plant.box))]
cost = cp.sum_squares(x[0, 1:] - target) + 1e-3 * cp.sum_squares(u) + 100.0 * cp.sum(slack)
problem = cp.Problem(cp.Minimize(cost), constraints)


def controller(estimate: np.ndarray, step: int) -> np.ndarray | None:
    """Pulls the coupling from one side to the other; None where the solver fails, which is for the loop to handle."""
    start.value, target.value = estimate, 1.6 if step % 40 < 20 else -1.6
    try:
        problem.solve(solver=cp.CLARABEL)
    except cp.SolverError:
        return None
    return None if u.value is None else u.value[:, 0]


def run(mode: str, steps: int = 300) -> None:
    """Simulates the plant, which takes the place of the real one, and its network, which loses 40 % of the samples."""
    rng, state = np.random.default_rng(0), np.zeros(plant.n)
    loop = SafeLoop(certificate, plant, channel, mode, on_unproved="ignore")  # How often it is proved is counted below.
    loop.start(state + plant.initial_noise.sample(rng))
    in_flight, overridden, violations, proved = [], 0, 0, 0
    for step in range(steps):
        estimate = loop.receive(in_flight)  # What was sent one step ago arrives now, because the delay is one step.
        decision = loop.decide(controller(estimate, step))
        overridden, proved = overridden + decision.intervened, proved + loop.guaranteed
        in_flight = []
        if rng.random() > 0.4:
            y = plant.H @ state + plant.sensor_noise.sample(rng)
            in_flight = [Packet(loop.steps, channel.quantize(y), loop.episode)]
        disturbance = plant.nominal_disturbance.sample_boundary(rng)
        state = plant.A @ state + plant.B @ decision.input + disturbance
        violations += bool((plant.constraint_values(state) > 0.0).any())
    print(f"{mode}: outside the box in {violations} steps, {overridden} interventions, proved in {proved} of {steps}")


run("monitor")  # Applies what the controller proposes, and counts what it would have overridden.
run("project")
