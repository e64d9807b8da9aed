"""The plants of the registered environments."""

from __future__ import annotations

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import DELTA, Ball, Bounds, Gaussian, Through
from ncs_gym.ellipsoid import truncation_energy
from ncs_gym.limits import Limits
from ncs_gym.model import Model
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import as_number


def truck_trailer(
    mass: float = 1000.0, stiffness: float = 4500.0, damping: float = 4600.0, dt: float = 0.5
) -> LinearPlant:
    """Returns the truck with a spring-damper-coupled trailer of Liu et al. Section 5.

    The exact zero-order hold of x1' = x2, x2' = -(stiffness/mass) x1 - (damping/mass) x2 + u, with x1
    the stretch of the coupling [m], x2 its rate [m/s] and u the truck's acceleration [m/s^2].
    Safe box |x1| <= 2 m, |x2| <= 2 m/s, |u| <= 4 m/s^2; gamma = 5e-4 and Q = P0 = 1e-4 I as in the paper, R = 1e-4 I
    (the paper prints none).

    Args:
        mass: Of the trailer [kg].
        stiffness: Of the coupling [N/m].
        damping: Of the coupling [N s/m].
        dt: Duration of a step [s].

    Raises:
        ValueError: If mass, stiffness or dt is not positive, or damping is negative.
    """
    mass = as_number(mass, "mass", low=0.0, low_open=True)
    stiffness = as_number(stiffness, "stiffness", low=0.0, low_open=True)
    damping = as_number(damping, "damping", low=0.0)
    coupling, push = np.array([[0.0, 1.0], [-stiffness / mass, -damping / mass]]), np.array([[0.0], [1.0]])
    noise = Gaussian(1e-4 * np.eye(2), 0.05)
    return LinearPlant(
        Model.sampled(coupling, push, None, dt),
        Limits(state=[2.0, 2.0], input=4.0),
        Bounds(disturbance=Ball(np.sqrt(5e-4)) + noise, sensor=noise, first_error=noise),
        {"states": {"coupling stretch": "m", "stretch rate": "m/s"}, "inputs": {"truck acceleration": "m/s^2"}},
    )


GRAVITY = 9.81


def cart_pole(
    cart_mass: float = 1.0,
    pole_mass: float = 0.1,
    length: float = 0.5,
    dt: float = 0.02,
    full_state: bool = True,
) -> LinearPlant:
    """Returns an inverted pendulum on a cart, linearized upright, by exact zero-order hold.

    x = (position [m], speed [m/s], angle [rad], angular rate [rad/s]), u the force on the cart [N], |u| <= 10. Safe
    box: 2.4 m, 3 m/s, 0.2 rad, 2 rad/s. The environment simulates the linear equations, which differ from those of a
    pendulum by less than 1 % of gravity's pull at the edge of the box (sin 0.2 = 0.1987).

    Args:
        cart_mass: Of the cart [kg].
        pole_mass: Of a point mass at the end of a light rod [kg].
        length: Of the rod [m].
        dt: Step [s].
        full_state: Measure all states; False measures position and angle.
    """
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1, 2] = -pole_mass * GRAVITY / cart_mass
    A[3, 2] = (cart_mass + pole_mass) * GRAVITY / (cart_mass * length)
    B = np.array([[0.0], [1.0 / cart_mass], [0.0], [-1.0 / (cart_mass * length)]])
    half_widths = np.array([2.4, 3.0, 0.2, 2.0])
    H = np.eye(4) if full_state else np.eye(4)[[0, 2]]
    return LinearPlant(
        Model.sampled(A, B, H, dt),
        Limits(state=half_widths, input=10.0),
        _noise_in_proportion(half_widths, H, 1.2e-3 if full_state else 0.4 * 1.2e-3, 1e-4),
        {
            "states": {"position": "m", "speed": "m/s", "angle": "rad", "angular rate": "rad/s"},
            "inputs": {"force": "N"},
        },
    )


# Bounds on disturbance and sensor noise as fractions of the half-widths of the box.


def batch_reactor(dt: float = 0.05) -> LinearPlant:
    """Returns the unstable batch reactor of the networked-control literature, by exact zero-order hold.

    Four states, two inputs, two outputs (x1 + x3 - x4 and x2), dimensionless; safe box |x_i| <= 1, |u_i| <= 2.

    Args:
        dt: Step [s].
    """
    A = np.array(
        [
            [1.38, -0.2077, 6.715, -5.676],
            [-0.5814, -4.29, 0.0, 0.675],
            [1.067, 4.273, -6.654, 5.893],
            [0.048, 4.273, 1.343, -2.104],
        ]
    )
    B = np.array([[0.0, 0.0], [5.679, 0.0], [1.136, -3.146], [1.136, 0.0]])
    H = np.array([[1.0, 0.0, 1.0, -1.0], [0.0, 1.0, 0.0, 0.0]])
    half_widths = np.ones(4)
    noise = _noise_in_proportion(half_widths, H, 5e-3, 1e-3)
    return LinearPlant(Model.sampled(A, B, H, dt), Limits(state=half_widths, input=2.0), noise)


def stirred_tank(dt: float = 3.0) -> LinearPlant:
    """Returns the continuous stirred-tank reactor of Seborg et al. at its unstable point, by exact zero-order hold.

    x = (concentration [cmol/L], temperature [K]) and u the temperature of the coolant [K], |u| <= 20, all in
    deviations from the operating point. An exothermic reaction heats what it is sped up by: left alone, deviations grow
    by a factor of 2.7 in 21 s (a pole at +2.83/min). Safe box 10 and 5 K. What comes in is up to 2 K/min too warm or
    too cold; both states are measured to within 0.02 of their units.

    Seborg et al. 2016 (docs/bibliography.md), the reactor of chapter 2.

    Args:
        dt: Step [s].
    """
    # Given per minute.
    reaction = np.array([[-2.0, -3.57], [2.092, 4.38]]) / 60.0
    coolant, feed = np.array([[0.0], [2.092]]) / 60.0, np.array([[0.0], [1.0]]) / 60.0
    model = Model.sampled(reaction, coolant, None, dt)
    return LinearPlant(
        model,
        Limits(state=[10.0, 5.0], input=20.0),
        Bounds(disturbance=Through(model.held(feed), 2.0), sensor=Ball(0.02), first_error=Ball(0.1)),
        {"states": {"concentration": "cmol/L", "temperature": "K"}, "inputs": {"coolant temperature": "K"}},
    )


def convoy(dt: float = 0.1, lag: float = 0.3) -> LinearPlant:
    """Returns a vehicle that follows another one at a wanted distance, by exact zero-order hold.

    e' = w - v, v' = (u - v)/lag. x = (e [m], v [m/s]): how much farther than wanted the leader is, and the follower's
    speed beyond the convoy's; u is the speed asked of its drive, |u| <= 2 m/s. Safe box: 1 m and 2 m/s. The leader's
    speed w is up to 0.45 m/s from the convoy's, and nobody tells the follower; both states are measured to within 1 mm
    and 1 mm/s.

    Args:
        dt: Step [s].
        lag: Time constant of the drive [s].
    """
    motion = np.array([[0.0, -1.0], [0.0, -1.0 / lag]])
    drive, leader = np.array([[0.0], [1.0 / lag]]), np.array([[1.0], [0.0]])
    model = Model.sampled(motion, drive, None, dt)
    return LinearPlant(
        model,
        Limits(state=[1.0, 2.0], input=2.0),
        Bounds(disturbance=Through(model.held(leader), 0.45), sensor=Ball(1e-3), first_error=Ball(0.02)),
        {"states": {"distance error": "m", "speed": "m/s"}, "inputs": {"speed asked for": "m/s"}},
    )


def lane_keeping(dt: float = 0.05, speed: float = 20.0) -> LinearPlant:
    """Returns a car that keeps its lane at constant speed, by exact zero-order hold.

    e' = speed psi + w, psi' = u. x = (e [m], psi [rad]): the offset from the middle of the lane and the heading; u is
    the yaw rate, |u| <= 0.4 rad/s. Safe box: 0.5 m and 0.1 rad. Side wind and the slope of the road push the car
    sideways by w, up to 0.4 m/s; offset and heading are measured to within 1 mm and 0.2 mrad.

    Args:
        dt: Step [s].
        speed: Of the car [m/s].
    """
    motion = np.array([[0.0, speed], [0.0, 0.0]])
    turn, push = np.array([[0.0], [1.0]]), np.array([[1.0], [0.0]])
    model = Model.sampled(motion, turn, None, dt)
    return LinearPlant(
        model,
        Limits(state=[0.5, 0.1], input=0.4),
        Bounds(disturbance=Through(model.held(push), 0.4), sensor=[1e-3, 2e-4], first_error=[1e-2, 2e-3]),
        {"states": {"offset": "m", "heading": "rad"}, "inputs": {"yaw rate": "rad/s"}},
    )


def _noise_in_proportion(half_widths: np.ndarray, H: np.ndarray, disturbance: float, sensor: float) -> Bounds:
    """Returns Gaussian noise, of which 95 % count, in proportion to half-widths of a safe box, shape (n,).

    Process noise is bounded by a fraction of them, sensor noise by one of what they allow outputs H x, and the first
    error by that of the smallest one.
    """
    outputs, smallest = exact.product(np.abs(H), half_widths), np.full(len(half_widths), half_widths.min())
    sizes = disturbance * half_widths, sensor * outputs, sensor * smallest
    return Bounds(*(Gaussian(np.diag(np.square(each)) / truncation_energy(DELTA, len(each)), DELTA) for each in sizes))
