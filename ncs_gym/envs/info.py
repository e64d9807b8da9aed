"""What a step reports: the keys of `info`, written once for one environment and for many."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym.envs.loop import Loop
from ncs_gym.envs.report import Report
from ncs_gym.envs.spaces import nearest_action
from ncs_gym.network.downlink import Inputs
from ncs_gym.plants.linear_plant import LinearPlant

# What is a number in the info of one environment, and of many an array that the environments go on using.
SHARED = (
    *("measurement_age", "assumption_violated", "packets", "episode_steps", "episode_violations"),
    *("downlink_broken", "requested", "request_forced"),
)


def loop_info(report: Report, loop: Loop, actions: tuple[np.ndarray, np.ndarray]) -> dict[str, Any]:
    """Returns `info`, every array a fresh copy; the environment is the first axis of what it holds for many.

    Keys of a feature are there where the loop has it; `actions` stand for the inputs applied and committed, fresh
    arrays of shape (m,) or (N, m).
    """
    belief, state = report.belief, report.state
    info = {
        "state": state.copy().T,
        "estimate": belief.estimate.copy().T,
        "estimation_error": (report.mean - state).T,
        "error_shape": belief.error_shape.copy(),
        "input": belief.applied.copy().T,
        "action_applied": actions[0],
        "action_committed": actions[1],
        "constraint_values": report.values.T,
        "cost": report.cost,
        "episode_steps": report.steps,
        "measurement_age": belief.age,
        "packet_arrived": report.arrived,
        "assumption_violated": belief.alarm,
        "episode_violations": report.violations,
        "is_success": (report.violations == 0.0) * 1.0,
        "contract_broken": belief.age > loop.oldest,
        "packets": report.packets,
        **report.others,
    }
    if loop.limits_the_way:
        info["worst_constraint_values"] = report.worst.copy().T
    if loop.downlink is not None:
        info["input_committed"], info["downlink_broken"] = belief.committed.copy().T, report.missing
    if loop.channel.on_request:
        info["requested"], info["request_forced"] = report.requested, report.forced
    if state.ndim > 1:
        for key in (*SHARED, *report.others):
            if key in info:
                info[key] = info[key].copy()
    return info


def actions_of(
    inputs: Inputs, plant: LinearPlant, read: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the float32 actions that stand for the inputs applied and committed, shape (m,) or (N, m) each.

    If what `read_action` returned was decided, the action is the one that was given.
    """
    if read is not None and inputs.committed is inputs.applied is read[1] and read[0].dtype.char == "f":
        return read[0], read[0].copy()
    applied = nearest_action(inputs.applied.T, plant)
    if inputs.committed is inputs.applied:  # as without a downlink
        return applied, applied.copy()
    return applied, nearest_action(inputs.committed.T, plant)
