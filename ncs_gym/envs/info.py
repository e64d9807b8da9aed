"""What a step reports: the keys of `info`, written once for one environment and for many."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ncs_gym.estimation.estimator import Estimator
from ncs_gym.estimation.vector_estimator import VectorEstimator
from ncs_gym.network.contract import ChannelContract
from ncs_gym.network.downlink import Inputs
from ncs_gym.network.requests import Requested


class Known(NamedTuple):
    """What is known where decisions are made, of now; of N environments, arrays whose last axis is the environment.

    A shield takes what it decides on from here, never from an `info`, into which wrappers may have written.

    Attributes:
        estimate: x_hat of the time at which the next decision takes effect, shape (n,) or (n, N).
        error_shape: Sigma_k of the same time, shape (n, n) or (N, n, n).
        age: Steps since the newest sample used was taken, an int or shape (N,).
        alarm: Whether an assumption was seen to be violated, a bool or shape (N,).
        applied: The input applied in the last step, shape (m,) or (m, N) [physical units]; zeros at a reset.
        committed: The input decided in the last step, of the same shape.
    """

    estimate: np.ndarray
    error_shape: np.ndarray
    age: Any
    alarm: Any
    applied: np.ndarray
    committed: np.ndarray


class Constraints(NamedTuple):
    """How the safe box is kept; of N environments arrays whose last axis is the environment.

    Attributes:
        values: |c_j x| - 1 now, shape (k,) or (k, N).
        worst: The largest since the last step, of the same shape.
        cost: 1.0 if one of these is positive, else 0.0, a float or shape (N,).
        violations: The sum of costs in the episode, a float or shape (N,).
    """

    values: np.ndarray
    worst: np.ndarray
    cost: Any
    violations: Any


def loop_info(
    estimator: Estimator | VectorEstimator,
    predicted: tuple[np.ndarray, np.ndarray],
    contract: ChannelContract | None,
    state: np.ndarray,
    inputs: Inputs,
    arrived: Any,
    constraints: Constraints,
    alarm: Any,
    sampled: Requested,
) -> dict[str, Any]:
    """Returns `info`, every array a fresh copy; the environment is the first axis of what it holds for many.

    Args:
        estimator: Gives the present estimate, and age.
        predicted: Estimate, shape (n,) or (n, N), and error shape, (n, n) or as a fresh array (N, n, n), of the time at
            which the next input takes effect.
        contract: What the channel guarantees, if anything.
        state: x, shape (n,) or (n, N).
        inputs: What was applied and what was committed in the step.
        arrived: Whether a packet arrived at this step, a bool or a fresh array of shape (N,).
        constraints: How the safe box is kept.
        alarm: Whether an assumption was seen to be violated, a bool or a fresh array of shape (N,).
        sampled: What was requested in the step.
    """
    values, worst, cost, violations = constraints
    age: Any = estimator.age
    applied, committed, missing = inputs
    estimate, error_shape = predicted
    many = state.ndim > 1
    broken = age > contract.max_age if contract is not None else np.zeros(age.shape, np.bool_) if many else False
    return {
        "state": state.copy().T if many else state.copy(),
        "estimate": estimate.copy().T if many else estimate.copy(),
        "estimation_error": (estimator.mean - state).T if many else estimator.mean - state,
        "error_shape": error_shape if many else error_shape.copy(),
        "input": applied.copy().T if many else applied.copy(),
        "input_committed": committed.copy().T if many else committed.copy(),
        "constraint_values": values.T if many else values,
        "worst_constraint_values": worst.copy().T if many else worst.copy(),
        "cost": cost,
        "measurement_age": age.copy() if many else age,
        "packet_arrived": arrived,
        "assumption_violated": alarm,
        "episode_violations": violations,
        "is_success": (violations == 0.0) * 1.0,
        "contract_broken": broken,
        "downlink_broken": np.array(missing) if many else missing,
        "requested": np.array(sampled.requested) if many else sampled.requested,
        "request_forced": np.array(sampled.forced) if many else sampled.forced,
        "packets": np.array(sampled.packets) if many else sampled.packets,
    }
