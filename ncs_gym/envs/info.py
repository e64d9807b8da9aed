"""What a step reports: the keys of `info`, written once for one environment and for many."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ncs_gym.estimation.error_table import ErrorTable
from ncs_gym.network.requests import Requested

# What is a number in the info of one environment, and of many an array that the environments go on using.
SHARED = (
    *("measurement_age", "assumption_violated", "downlink_broken", "requested", "request_forced", "packets"),
    "episode_steps",
)


class Known(NamedTuple):
    """What is known where decisions are made, of now; of N environments, arrays whose last axis is the environment.

    A shield takes what it decides on from here, never from an `info`, into which wrappers may have written. Nobody
    writes into the arrays.

    Attributes:
        estimate: x_hat of the time at which the next decision takes effect, shape (n,) or (n, N).
        error_shape: Sigma_k of the same time, shape (n, n) or (N, n, n).
        age: Steps since the newest sample used was taken, an int or shape (N,).
        alarm: Whether an assumption was seen to be violated, a bool or shape (N,).
        damaged: Whether one was because a sample was no finite numbers, a bool or shape (N,).
        applied: The input applied in the last step, shape (m,) or (m, N) [physical units]; zeros at a reset.
        committed: The input decided in the last step, of the same shape.
        table: What holds Sigma_k by its number; another one after shapes were forgotten.
        number: That number, an int or shape (N,), by which everything that follows from Sigma_k is found again.
        outside: Whether `alarm` is also about a step of the process outside E(D), a bool or shape (N,).
    """

    estimate: np.ndarray
    error_shape: np.ndarray
    age: Any
    alarm: Any
    damaged: Any
    applied: np.ndarray
    committed: np.ndarray
    table: ErrorTable
    number: Any
    outside: Any


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
    known: Known,
    mean: np.ndarray,
    state: np.ndarray,
    steps: Any,
    missing: Any,
    arrived: Any,
    oldest: float,
    constraints: Constraints,
    sampled: Requested,
    network: dict[str, Any],
    actions: tuple[np.ndarray, np.ndarray],
) -> dict[str, Any]:
    """Returns `info`, every array a fresh copy; the environment is the first axis of what it holds for many.

    Args:
        known: What is known now.
        mean: The present estimate, shape (n,) or (n, N).
        state: x, shape (n,) or (n, N).
        steps: Steps taken in the episode, an int or shape (N,).
        missing: Whether zero was applied because the input committed had not arrived, a bool or shape (N,).
        arrived: Whether a packet arrived at this step, a bool or a fresh array of shape (N,).
        oldest: The largest age of the newest sample that the contract allows [steps]; infinite without one.
        constraints: How the safe box is kept; `values`, `cost` and `violations` are fresh arrays.
        sampled: What was requested in the step.
        network: What `EpisodeChannels.infos` says.
        actions: Those that stand for the inputs applied and committed, fresh arrays of shape (m,) or (N, m).
    """
    values, worst, cost, violations = constraints
    info = {
        "state": state.copy().T,
        "estimate": known.estimate.copy().T,
        "estimation_error": (mean - state).T,
        "error_shape": known.error_shape.copy(),
        "input": known.applied.copy().T,
        "input_committed": known.committed.copy().T,
        "action_applied": actions[0],
        "action_committed": actions[1],
        "constraint_values": values.T,
        "worst_constraint_values": worst.copy().T,
        "cost": cost,
        "episode_steps": steps,
        "measurement_age": known.age,
        "packet_arrived": arrived,
        "assumption_violated": known.alarm,
        "episode_violations": violations,
        "is_success": (violations == 0.0) * 1.0,
        "contract_broken": known.age > oldest,
        "downlink_broken": missing,
        "requested": sampled.requested,
        "request_forced": sampled.forced,
        "packets": sampled.packets,
        **network,
    }
    if state.ndim > 1:
        for key in (*SHARED, *network):
            info[key] = info[key].copy()
    return info
