"""The plant of the case study: a truck that pulls a trailer on a spring-damper coupling."""

from __future__ import annotations

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.plants.sampling import zero_order_hold
from ncs_gym.validation import as_matrix, as_number


def truck_trailer(
    mass: float = 1000.0,
    stiffness: float = 4500.0,
    damping: float = 4600.0,
    dt: float = 0.5,
    *,
    u_max: float = 4.0,
    gamma: float = 5e-4,
    process_noise_cov: np.ndarray | None = None,
    measurement_noise_cov: np.ndarray | None = None,
    initial_cov: np.ndarray | None = None,
    delta: float = 0.05,
    C: np.ndarray | None = None,
    H: np.ndarray | None = None,
) -> LinearPlant:
    """Returns the truck with a spring-damper-coupled trailer of Liu et al. Section 5.

    The exact zero-order hold of x1' = x2, x2' = -(stiffness/mass) x1 - (damping/mass) x2 + u, with x1
    the stretch of the coupling [m], x2 its rate [m/s] and u the truck's acceleration [m/s^2].

    Args:
        mass: Of the trailer [kg].
        stiffness: Of the coupling [N/m].
        damping: Of the coupling [N s/m].
        dt: Duration of a step [s].
        u_max: Limit of the acceleration [m/s^2].
        gamma: Squared radius of the disturbance.
        process_noise_cov: Q, shape (2, 2); 1e-4 I by default, as in the paper.
        measurement_noise_cov: R, shape (p, p); 1e-4 I by default (the paper prints none).
        initial_cov: P0, shape (2, 2); 1e-4 I by default, as in the paper.
        delta: Probability mass removed by each truncation.
        C: Rows of the safe box, shape (k, 2); |x1| <= 2 m and |x2| <= 2 m/s by default.
        H: Output matrix, shape (p, 2); both states by default.

    Raises:
        ValueError: If mass, stiffness or dt is not positive, damping is negative, or a bound is wrong.
    """
    mass = as_number(mass, "mass", low=0.0, low_open=True)
    stiffness = as_number(stiffness, "stiffness", low=0.0, low_open=True)
    damping = as_number(damping, "damping", low=0.0)
    dt = as_number(dt, "dt", low=0.0, low_open=True)
    A, B = zero_order_hold(np.array([[0.0, 1.0], [-stiffness / mass, -damping / mass]]), np.array([[0.0], [1.0]]), dt)
    p = 2 if H is None else len(as_matrix(H, (None, 2), "H"))
    return LinearPlant(
        A=A,
        B=B,
        C=np.eye(2) / 2.0 if C is None else C,
        H=H,
        u_max=u_max,
        dt=dt,
        gamma=gamma,
        process_noise_cov=1e-4 * np.eye(2) if process_noise_cov is None else process_noise_cov,
        measurement_noise_cov=1e-4 * np.eye(p) if measurement_noise_cov is None else measurement_noise_cov,
        initial_cov=1e-4 * np.eye(2) if initial_cov is None else initial_cov,
        delta=delta,
        state_names=("coupling stretch", "stretch rate"),
        state_units=("m", "m/s"),
        input_names=("truck acceleration",),
        input_units=("m/s^2",),
    )
