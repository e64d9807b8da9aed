"""What a step tells the outside: fresh arrays, filled in one go, and the infos made of them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit


class Report(NamedTuple):
    """Arrays that are handed out once and never used again.

    Attributes:
        numbers: Rows by environments: state, estimate, error (n each), shape (n * n), values (k), cost, violations,
            success, reward.
        flags: Packet arrived, alarm, contract broken, terminated, truncated, shape (5, N).
        age: Shape (N,).
        observation: Shape (n + extra, N).
        done: Whether an episode is over, shape (N,); this one is kept.
    """

    numbers: np.ndarray
    flags: np.ndarray
    age: np.ndarray
    observation: np.ndarray
    done: np.ndarray


def new_report(n: int, k: int, observed: int, done: np.ndarray) -> Report:
    """Returns arrays to fill."""
    N = done.size
    numbers, flags = np.empty((3 * n + n * n + k + 4, N)), np.empty((5, N), np.bool_)
    return Report(numbers, flags, np.empty(N, np.int64), np.empty((observed, N), np.float32), done)


def infos(filled: Report, u: np.ndarray, n: int) -> dict[str, Any]:
    """Returns the infos, each with the environment as first axis."""
    rows, flags, count = filled.numbers, filled.flags, filled.done.size
    columns, last = rows.T, 3 * n + n * n
    return {
        "state": columns[:, :n],
        "estimate": columns[:, n : 2 * n],
        "estimation_error": columns[:, 2 * n : 3 * n],
        "error_shape": rows[3 * n : last].reshape(n, n, count).transpose(2, 0, 1),
        "input": u.T,
        "constraint_values": columns[:, last:-4],
        "cost": rows[-4],
        "measurement_age": filled.age,
        "packet_arrived": flags[0],
        "assumption_violated": flags[1],
        "episode_violations": rows[-3],
        "is_success": rows[-2],
        "contract_broken": flags[2],
    }


@njit(cache=True, nogil=True, error_model="numpy")
def report(system, fleet, shapes, u, counted, filled):
    """Fills what a step reports, and counts violations.

    Args:
        system: The loop.
        fleet: Whose violations are counted in place.
        shapes: Of the nodes of the gain table, shape (nodes, n * n).
        u: Inputs, shape (m, N).
        counted: Whose violations count, shape (N,).
        filled: A `Report`.
    """
    rows, flags, n = filled.numbers, filled.flags, fleet.state.shape[0]
    for i in range(n):
        _compare(fleet.state[i], fleet.mean[i], rows[i], rows[n + i], rows[2 * n + i])
        _clip(fleet.mean[i], system.low[i], system.high[i], filled.observation[i])
    start = 3 * n + n * n
    for i in range(n * n):
        row = rows[3 * n + i]
        for e in range(row.size):
            row[e] = shapes[fleet.node[e], i]
    cost, violations, success = rows[start + len(system.C)], rows[start + len(system.C) + 1], rows[-2]
    _judge(system.C, fleet.state, rows[start : start + len(system.C)], cost)
    _count(fleet.violations, counted, cost, violations, success)
    for e in range(cost.size):
        filled.age[e] = fleet.age[e]
        flags[0, e], flags[1, e] = fleet.arrived[e] != 0, fleet.alarm[e] != 0
    for e in range(cost.size):
        flags[2, e] = fleet.age[e] > system.most_age and system.most_age >= 0
        flags[4, e] = fleet.steps[e] >= system.limit and system.limit >= 0
    for e in range(cost.size):
        flags[3, e] = system.terminates and cost[e] > 0.0
        filled.done[e] = flags[3, e] or flags[4, e]
    if system.pays:
        _pay(system.Q, fleet.state, system.R, u, rows[-1])


@njit(cache=True, nogil=True, error_model="numpy")
def _compare(state, mean, state_out, mean_out, error_out):
    """Fills copies of state and mean, and the error."""
    for e in range(state.size):
        state_out[e], mean_out[e] = state[e], mean[e]
    for e in range(state.size):
        error_out[e] = mean[e] - state[e]


@njit(cache=True, nogil=True, error_model="numpy")
def _clip(mean, low, high, out):
    """Fills what is observed."""
    for e in range(mean.size):
        out[e] = np.float32(min(max(mean[e], low), high))


@njit(cache=True, nogil=True, error_model="numpy")
def _judge(C, state, values, cost):
    """Fills abs(c_j x) - 1, shape (k, N), and 1.0 where one of them is positive, shape (N,)."""
    cost[:] = 0.0
    for k in range(values.shape[0]):
        row = values[k]
        row[:] = 0.0
        for i in range(state.shape[0]):
            share, some = C[k, i], state[i]
            for e in range(row.size):
                row[e] += share * some[e]
        for e in range(row.size):
            row[e] = abs(row[e]) - 1.0
            cost[e] = 1.0 if row[e] > 0.0 else cost[e]


@njit(cache=True, nogil=True, error_model="numpy")
def _count(total, counted, cost, violations, success):
    """Adds costs to the totals where they count; fills copies of the totals and 1.0 where there are none."""
    for e in range(cost.size):
        total[e] += cost[e] if counted[e] else 0.0
    for e in range(cost.size):
        violations[e] = total[e]
        success[e] = 1.0 if total[e] == 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _pay(Q, x, R, u, reward):
    """Fills -(x'Qx + u'Ru) for x of shape (n, N) and u of shape (m, N)."""
    reward[:] = 0.0
    for i in range(Q.shape[0]):
        for j in range(Q.shape[0]):
            share, one, other = Q[i, j], x[i], x[j]
            if share != 0.0:
                for e in range(reward.size):
                    reward[e] -= share * one[e] * other[e]
    for i in range(R.shape[0]):
        for j in range(R.shape[0]):
            share, one, other = R[i, j], u[i], u[j]
            if share != 0.0:
                for e in range(reward.size):
                    reward[e] -= share * one[e] * other[e]
