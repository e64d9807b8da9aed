"""Models in continuous time and from elsewhere: sampled exactly."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym import exact
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
            "the system must be a state-space model of python-control (control.ss(...)) or scipy.signal, or a tuple "
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
