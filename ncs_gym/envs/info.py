"""What a step reports: the keys of `info`, written once for one environment and for many."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.estimation.estimator import Estimator
from ncs_gym.estimation.vector_estimator import VectorEstimator
from ncs_gym.network.contract import ChannelContract


def loop_info(
    estimator: Estimator | VectorEstimator,
    contract: ChannelContract | None,
    state: np.ndarray,
    u: np.ndarray,
    error_shape: np.ndarray,
    arrived: Any,
    constraints: tuple[np.ndarray, Any, Any],
    alarm: Any,
) -> dict[str, Any]:
    """Returns `info`, every array a fresh copy; the environment is the first axis of what it holds for many.

    Args:
        estimator: Gives estimate and age.
        contract: What the channel guarantees, if anything.
        state: x, shape (n,) or (n, N).
        u: Applied input, shape (m,) or (m, N).
        error_shape: Sigma_k as a fresh array, shape (n, n) or (N, n, n).
        arrived: Whether a packet arrived at this step, a bool or a fresh array of shape (N,).
        constraints: Constraint values, shape (k,) or (k, N), the cost, and the sum of costs in the episode.
        alarm: Whether an assumption was seen to be violated, a bool or a fresh array of shape (N,).
    """
    values, cost, violations = constraints
    age: Any = estimator.age
    many = state.ndim > 1
    broken = age > contract.max_age if contract is not None else np.zeros(age.shape, np.bool_) if many else False
    return {
        "state": state.copy().T,
        "estimate": estimator.mean.copy().T,
        "estimation_error": (estimator.mean - state).T,
        "error_shape": error_shape,
        "input": u.copy().T,
        "constraint_values": values.T,
        "cost": cost,
        "measurement_age": age.copy() if many else age,
        "packet_arrived": arrived,
        "assumption_violated": alarm,
        "episode_violations": violations,
        "is_success": (violations == 0.0) * 1.0,
        "contract_broken": broken,
    }
