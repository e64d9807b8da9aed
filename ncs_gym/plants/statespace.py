"""Models in continuous time and from elsewhere: sampled exactly, as arguments of `LinearPlant`."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym import exact
from ncs_gym.uncertainty.truncated_gaussian import truncation_energy
from ncs_gym.validation import shown

# Durations of steps that differ by less than this are the same.
SAME_STEP = 1e-9


def zero_order_hold(A: np.ndarray, B: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the matrices of x+ = A x + B u for x' = A x + B u with u held constant over each step.

    Every entry is rounded once, so that it is the same on every machine.

    Args:
        A: Continuous-time state matrix, shape (n, n) [1/s].
        B: Continuous-time input matrix, shape (n, m).
        dt: Duration of a step [s].

    Raises:
        ValueError: If an entry is too large for a float64.
    """
    n, m = B.shape
    try:
        sampled = exact.exponential(np.block([[A, B], [np.zeros((m, n + m))]]), dt)
    except OverflowError as error:
        raise ValueError(f"the model grows beyond all numbers within a step of {dt:g} s: give a smaller dt") from error
    return sampled[:n, :n], sampled[:n, n:]


def sampled_model(A: np.ndarray, B: np.ndarray, dt: float) -> dict[str, Any]:
    """Returns A, B, dt and continuous_model of `LinearPlant` for a model in continuous time, A (n, n) and B (n, m)."""
    sampled_A, sampled_B = zero_order_hold(A, B, dt)
    return {"A": sampled_A, "B": sampled_B, "dt": dt, "continuous_model": np.concatenate([A, B], axis=1)}


def noise_in_proportion(
    half_widths: np.ndarray, H: np.ndarray, disturbance: float, sensor: float, delta: float = 0.05
) -> dict[str, Any]:
    """Returns covariances of `LinearPlant` whose truncated noise is in proportion to the safe box.

    Args:
        half_widths: Of the safe box, shape (n,).
        H: Output matrix, shape (p, n).
        disturbance: Bound of process noise, as a fraction of the half-widths.
        sensor: Bound of sensor noise, as a fraction of what the box allows the outputs.
        delta: Probability mass that the truncation of each Gaussian removes.
    """
    n = len(half_widths)
    outputs, smallest = exact.product(np.abs(H), half_widths), np.full(n, half_widths.min())
    return {
        "process_noise_cov": np.diag(np.square(disturbance * half_widths)) / truncation_energy(delta, n),
        "measurement_noise_cov": np.diag(np.square(sensor * outputs)) / truncation_energy(delta, len(H)),
        "initial_cov": np.diag(np.square(sensor * smallest)) / truncation_energy(delta, n),
    }


def matrices_of(sys: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Returns A, B, C, D and the sampling time of a model: 0 in continuous time, True if it is unknown."""
    if isinstance(sys, (tuple, list)) and len(sys) in (4, 5):
        A, B, C, D, own = (*sys, 0)[:5]
        return A, B, C, D, _sampling_time(sys, own)
    model: Any = sys
    if not hasattr(model, "A") and (hasattr(model, "to_ss") or hasattr(model, "num")):
        raise ValueError(
            f"{shown(sys)} is a transfer function, whose states would be nobody's: limits and names are of states, so "
            "give a state-space model with states of yours"
        )
    if not all(hasattr(model, name) for name in "ABCD"):
        raise ValueError(
            "sys must be a state-space model of python-control (control.ss(...)) or scipy.signal, or a tuple "
            f"(A, B, C, D) or (A, B, C, D, dt), got {shown(sys)}"
        )
    return model.A, model.B, model.C, model.D, _sampling_time(model, getattr(model, "dt", None))


def _sampling_time(model: Any, own: Any) -> Any:
    """Returns the sampling time of a model; raises ValueError if it leaves open whether there is one."""
    if own is None:
        from scipy.signal import lti  # takes long to import, and is there if the model is scipy's

        if isinstance(model, lti):
            return 0
        raise ValueError(
            "the model has dt=None, which does not say whether it is in continuous or discrete time: make it with dt=0 "
            "or with its sampling time in seconds"
        )
    return own
