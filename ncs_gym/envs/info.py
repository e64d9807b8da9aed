"""What a step reports: the keys of `info`, written once for one environment and for many."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.envs.report import Report

# What is a number in the info of one environment, and of many an array that the environments go on using.
SHARED = (
    *("measurement_age", "assumption_violated", "downlink_broken", "requested", "request_forced", "packets"),
    *("episode_steps", "episode_violations"),
)


def loop_info(report: Report, oldest: float, actions: tuple[np.ndarray, np.ndarray]) -> dict[str, Any]:
    """Returns `info`, every array a fresh copy; the environment is the first axis of what it holds for many.

    Args:
        report: What happened.
        oldest: The largest age of the newest sample that the contract allows [steps]; infinite without one.
        actions: Those that stand for the inputs applied and committed, fresh arrays of shape (m,) or (N, m).
    """
    belief, state = report.belief, report.state
    info = {
        "state": state.copy().T,
        "estimate": belief.estimate.copy().T,
        "estimation_error": (report.mean - state).T,
        "error_shape": belief.error_shape.copy(),
        "input": belief.applied.copy().T,
        "input_committed": belief.committed.copy().T,
        "action_applied": actions[0],
        "action_committed": actions[1],
        "constraint_values": report.values.T,
        "worst_constraint_values": report.worst.copy().T,
        "cost": report.cost,
        "episode_steps": report.steps,
        "measurement_age": belief.age,
        "packet_arrived": report.arrived,
        "assumption_violated": belief.alarm,
        "episode_violations": report.violations,
        "is_success": (report.violations == 0.0) * 1.0,
        "contract_broken": belief.age > oldest,
        "downlink_broken": report.missing,
        "requested": report.requested,
        "request_forced": report.forced,
        "packets": report.packets,
        **report.others,
    }
    if state.ndim > 1:
        for key in (*SHARED, *report.others):
            info[key] = info[key].copy()
    return info
