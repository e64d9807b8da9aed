"""Remote tube MPC against an LQR behind the shield, on its cart-pole: `python -m benchmarks.remote_tube CLONE`.

CLONE is one of github.com/EricssonResearch/Robust-Tracking-MPC-over-Lossy-Networks (Umsonst and Barbosa 2024), whose
package is imported from there, and needs polytope and control. Plant, limits, weights, horizon, reference and set W of
disturbances are those of its `results_linear_system.py`. Disturbances are uniform in W, or the vertex that pushes the
pendulum on to where it falls; they and losses are the same for all.

Their plant has a computer that knows the true state and runs an ancillary controller, so that no number of losses
breaks a limit. Our shield "at the plant" has the same information; the LQR is there, too, or sends inputs for the next
steps, as theirs. A "remote shield" has less, only the network: nothing is proved once two packets in a row are lost.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from importlib import import_module
from itertools import product
from typing import Any

import numpy as np
import tyro

from benchmarks.commands import table
from ncs_gym import Actuator, Bounds, Channel, ChannelContract, Ellipsoid, Limits, LinearPlant, Model, Packet
from ncs_gym.plants.lqr import lqr_gain
from shields import Certificate, SafeLoop, synthesize

# Half-widths of W, and how an ellipsoid around it is shared among them: most for the rate of the pendulum.
W, PARTS = np.array([0.0001, 0.0027, 0.0003, 0.043]), np.array([0.005, 0.05, 0.03, 0.915])
Q, R, HORIZON, STEPS = np.diag([100.0, 10.0, 100.0, 10.0]), 0.1 * np.eye(1), 20, 250
REFERENCE = np.array([0.5, 0.0, 0.0, 0.0])
UPLINK, DOWNLINK = (Channel(loss=0.4, delay=delay, max_consecutive_losses=1) for delay in (1, 0))
Arm = Callable[[int, np.ndarray, bool, bool], np.ndarray]  # of step, state, and if command and answer arrive


def cart_pole_of_the_paper() -> LinearPlant:
    """The linear cart-pole (position, speed, angle, rate), whose state is measured without noise and known at first."""
    cart, pole, inertia, half, g = 1.0, 0.1, 0.001, 0.5, 9.8  # [kg], [kg], [kg m^2], [m], [m/s^2]
    p, arm = inertia * (cart + pole) + cart * pole * half**2, pole * half
    A = [[0, 1, 0, 0], [0, 0, -(arm**2) * g / p, 0], [0, 0, 0, 1], [0, 0, arm * g * (cart + pole) / p, 0]]
    model = Model.sampled(A, [[0], [(inertia + arm * half) / p], [0], [-arm / p]], None, 0.02)
    bounds = Bounds(Ellipsoid(np.diag(W**2 / PARTS)), 0, 0)
    return LinearPlant(model, Limits(state=[5.0, 5.0, 0.3, 2.0], input=10.0), bounds)


def shield_at_plant(plant: LinearPlant, certificate: Certificate, *, local: bool) -> Arm:
    """A shield that knows the state, and an LQR that does, too, or sends it inputs for the next steps."""
    gain, newest, x_hat = np.asarray(lqr_gain(plant.A, plant.B, Q, R)), np.zeros((0, 1)), np.zeros(plant.n)
    loop = SafeLoop(certificate, plant, Channel())
    loop.start(x_hat)

    def act(step: int, x: np.ndarray, down: bool, up: bool) -> np.ndarray:
        nonlocal newest, x_hat
        plan, z = [], x_hat
        for _ in range(HORIZON):
            plan.append(np.clip(gain @ (z - REFERENCE), *plant.input_ends))
            z = plant.A @ z + plant.B @ plan[-1]
        newest = np.array(plan) if down else newest[1:]
        proposed = gain @ (x - REFERENCE) if local else newest[0] if len(newest) else None
        loop.receive([Packet(step, x, loop.episode)])
        u = loop.decide(proposed).input
        x_hat = plant.A @ x + plant.B @ u if up else plant.A @ x_hat + plant.B @ plan[0]
        return u

    return act


def remote_shield(plant: LinearPlant, certificate: Certificate) -> Arm:
    """An LQR and its shield on the far side of the network."""
    gain, sent, actuator = np.asarray(lqr_gain(plant.A, plant.B, Q, R)), [], Actuator(1, plant.m)
    loop = SafeLoop(certificate, plant, UPLINK, downlink=DOWNLINK, on_unproved="ignore")
    loop.start(np.zeros(plant.n))

    def act(step: int, x: np.ndarray, down: bool, up: bool) -> np.ndarray:
        nonlocal sent
        loop.decide(gain @ (loop.receive(sent) - REFERENCE))
        actuator.receive([loop.command()] if down else [])
        sent = [Packet(step, x, loop.episode)] if up else []
        return actuator.apply(step)

    return act


def tube_mpc(clone: str, plant: LinearPlant) -> Any:
    """Their controller; its sets take about a minute."""
    sys.path.insert(0, f"{clone}/src")
    polytope, tube = import_module("polytope"), import_module("LinearMPCOverNetworks.TubeTrackingMPC")
    mpc, both = tube.TubeTrackingMPC(plant.A, plant.B, Q, R, HORIZON), np.vstack([np.eye(plant.n), -np.eye(plant.n)])
    mpc.set_input_constraints(polytope.Polytope(np.array([[1.0], [-1.0]]), np.tile(plant.largest_input, 2)[:, None]))
    mpc.set_state_constraints(polytope.Polytope(both, np.tile(plant.half_widths, 2)[:, None]))
    mpc.setup_optimization(polytope.Polytope(both, np.tile(W, 2)), fixed_initial_state=True, rpi_method=1)
    return mpc


def tube_arm(mpc: Any, plant: LinearPlant) -> Arm:
    """Their controller with their estimator, actuator and ancillary controller."""
    K = mpc.get_steady_state_controller_gain()  # which is the ancillary controller's, too
    modules = [import_module(f"LinearMPCOverNetworks.{name}") for name in ("Estimator", "SmartActuator")]
    estimator = modules[0].Estimator(plant.A, plant.B, K, np.zeros((4, 1)), HORIZON)
    actuator = modules[1].ConsistentActuator(plant.A, plant.B, K, K, np.zeros((4, 1)))

    def act(step: int, x: np.ndarray, down: bool, up: bool) -> np.ndarray:
        packet = mpc.determine_packet(estimator.get_estimate(), REFERENCE.copy(), estimator.get_qt())
        estimator.store_sent_control_sequence(packet["U_t"])
        u, answer = actuator.process_packet(packet, x[:, None].copy(), int(down))
        estimator.update_estimate(answer, int(up))
        return u[:, 0]

    return act


def episode(arm: Arm, plant: LinearPlant, loss: float, most: int, seed: int, *, worst: bool) -> float:
    """The mean distance to the reference [cm], nan if a limit was violated; at most `most` losses in a row."""
    rng, (values, vectors), x, errors = np.random.default_rng(seed), np.linalg.eig(plant.A.T), np.zeros(plant.n), []
    pushes, arrived = rng.uniform(-W, W, (STEPS, plant.n)), rng.random((STEPS, 2)) >= loss
    outward = np.real(vectors[:, np.abs(values).argmax()])
    for k in range(STEPS):
        arrived[k] |= ~arrived[max(k - most, 0) : k].any(axis=0)
        u = arm(k, x, bool(arrived[k, 0]), bool(arrived[k, 1]))
        if not (abs(x) <= 1.000001 * plant.half_widths).all() or not (abs(u) <= 1.000001 * plant.largest_input).all():
            return np.nan
        errors.append(100.0 * abs(x - REFERENCE)[0])
        x = plant.A @ x + plant.B @ u + (W * np.sign(outward * (outward @ x or 1.0)) if worst else pushes[k])
    return float(np.mean(errors))


def compare(clone: tyro.conf.Positional[str], episodes: int = 3) -> None:
    """Prints violating episodes [%], and the mean error of the others [cm], of each arm, disturbance and network."""
    plant, networks = cart_pole_of_the_paper(), {"1 in a row": (0.4, 1), "40 %": (0.4, STEPS), "80 %": (0.8, STEPS)}
    mpc, near, far = tube_mpc(clone, plant), *(synthesize(plant, contract=ChannelContract(age)) for age in (0, 3))
    arms = {
        "remote tube MPC": lambda: tube_arm(mpc, plant),
        "LQR, shield at the plant": lambda: shield_at_plant(plant, near, local=False),
        "LQR and shield at the plant": lambda: shield_at_plant(plant, near, local=True),
        "LQR, remote shield": lambda: remote_shield(plant, far),
    }
    show = table("violating [%], error [cm]", *networks, "step [ms]", first=38, width=12)
    for (name, make), worst in product(arms.items(), (False, True)):
        cells, began = [], time.process_time()
        for loss, most in networks.values():
            errors = np.array([episode(make(), plant, loss, most, seed, worst=worst) for seed in range(episodes)])
            kept = errors[np.isfinite(errors)]
            cells.append(f"{100 - 100 * len(kept) / episodes:.0f}, {kept.mean() if len(kept) else np.nan:.2f}")
        took = 1e3 * (time.process_time() - began) / STEPS / episodes / len(networks)
        show(f"{name}, {'worst' if worst else 'uniform'}", *cells, f"{took:.1f}")


if __name__ == "__main__":
    tyro.cli(compare, description=__doc__)
