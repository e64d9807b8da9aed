"""What a step tells the outside: fresh arrays, filled in one go, and the infos made of them."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ncs_gym.compiled import inner
from ncs_gym.product import set_product

# Counts never get here.
MOST = 1 << 40


class Report(NamedTuple):
    """Arrays that are handed out once and never used again.

    Attributes:
        numbers: Rows by environments: input (m), state, estimate, error (n each), shape (n * n), values (k), cost,
            violations, success, reward, and the age in bits of int64.
        flags: Packet arrived, alarm, contract broken, terminated, truncated, done, shape (6, N).
        observation: Shape (n + extra, N).
    """

    numbers: np.ndarray
    flags: np.ndarray
    observation: np.ndarray


class Layout:
    """Where infos are in the rows of a report.

    Args:
        count: Number of environments.
        n: Number of states.
        m: Number of inputs.
        k: Number of constraints.
        observed: Number of entries of an observation.
    """

    def __init__(self, count: int, n: int, m: int, k: int, observed: int) -> None:
        ends = np.cumsum([0, m, n, n, n, n * n, k]).tolist()
        parts = [slice(*pair) for pair in pairwise(ends)]
        self._n, self._shape = n, parts[4]
        self._input, self._state, self._mean, self._error, _, self._values = ((slice(None), part) for part in parts)
        self._sizes = (ends[-1] + 5, count), (6, count), (observed, count)

    def new(self) -> Report:
        """Returns arrays to fill."""
        numbers, flags, observation = self._sizes
        return Report(np.empty(numbers), np.empty(flags, np.bool_), np.empty(observation, np.float32))

    def infos(self, filled: Report) -> dict[str, Any]:
        """Returns the infos, each with the environment as first axis."""
        rows, flags, columns = filled.numbers, filled.flags, filled.numbers.T
        return {
            "state": columns[self._state],
            "estimate": columns[self._mean],
            "estimation_error": columns[self._error],
            "error_shape": rows[self._shape].reshape(self._n, self._n, -1).transpose(2, 0, 1),
            "input": columns[self._input],
            "constraint_values": columns[self._values],
            "cost": rows[-5],
            "measurement_age": rows[-1].view(np.int64),
            "packet_arrived": flags[0],
            "assumption_violated": flags[1],
            "episode_violations": rows[-4],
            "is_success": rows[-3],
            "contract_broken": flags[2],
        }


@inner
def report(system, fleet, shapes, filled):
    """Fills what a step reports next to the inputs, and counts violations.

    Args:
        system: The loop.
        fleet: Whose violations are counted in place.
        shapes: Of the nodes of the gain table, shape (n * n, nodes).
        filled: A `Report`.

    Returns:
        How many episodes are over.
    """
    (n, m), k, rows = system.B.shape, len(system.C), filled.numbers
    _estimate(fleet.state, fleet.mean, m, rows)
    _observe(fleet.mean, system.low, system.high, filled.observation)
    _shape(n, shapes, fleet.node, m + 3 * n, rows)
    start = m + 3 * n + n * n
    cost = rows[start + k]
    _judge(system.C, fleet.state, rows[start : start + k], cost)
    _count(cost, fleet.counted, fleet.violations, start + k, rows)
    _age(fleet.age, rows[start + k + 4].view(np.int64))
    if system.pays:
        reward = rows[start + k + 3]
        reward.fill(0.0)
        _pay(system.Q, fleet.state, reward)
        _pay(system.R, rows, reward)
    _flag(system.most_age, fleet.arrived, fleet.alarm, fleet.age, filled.flags)
    return _end(system.limit, system.terminates, fleet.steps, cost, filled.flags)


@inner
def _estimate(state, mean, start, rows):
    """Fills state, mean and error from row `start` on."""
    n = state.shape[0]
    for i in range(n):
        for e in range(state.shape[1]):
            rows[start + i, e] = state[i, e]
        for e in range(state.shape[1]):
            rows[start + n + i, e] = mean[i, e]
        for e in range(state.shape[1]):
            rows[start + 2 * n + i, e] = mean[i, e] - state[i, e]


@inner
def _observe(mean, low, high, out):
    """Fills the first n rows of what is observed, the mean within its bounds."""
    for i in range(mean.shape[0]):
        least, most = low[i], high[i]
        for e in range(mean.shape[1]):
            out[i, e] = np.float32(min(max(mean[i, e], least), most))


@inner
def _shape(n, shapes, node, start, rows):
    """Fills the error shapes, which are symmetric, from row `start` on."""
    for i in range(n):
        for j in range(i + 1):
            for e in range(node.size):
                rows[start + i * n + j, e] = shapes[i * n + j, node[e]]
            if j < i:
                for e in range(node.size):
                    rows[start + j * n + i, e] = rows[start + i * n + j, e]


@inner
def _judge(C, state, values, cost):
    """Fills abs(c_j x) - 1, shape (k, N), and 1.0 where one of them is positive, else 0.0, shape (N,)."""
    set_product(C, state, values)
    cost.fill(0.0)
    for k in range(values.shape[0]):
        for e in range(cost.size):
            value = abs(values[k, e]) - 1.0
            values[k, e] = value
            cost[e] = 1.0 if value > 0.0 else cost[e]


@inner
def _count(cost, counted, total, start, rows):
    """Adds costs to the totals where they count; fills two rows after `start`: the totals, and 1.0 where that is 0."""
    for e in range(total.size):
        total[e] += cost[e] * counted[e]
    for e in range(total.size):
        rows[start + 1, e] = total[e]
        rows[start + 2, e] = 1.0 if total[e] == 0.0 else 0.0


@inner
def _age(age, out):
    """Fills the ages, shape (N,)."""
    for e in range(age.size):
        out[e] = age[e]


@inner
def _pay(Q, x, reward):
    """Subtracts x'Qx, x in the first rows of an array, from rewards, shape (N,)."""
    for i in range(Q.shape[0]):
        for j in range(Q.shape[0]):
            share = Q[i, j]
            if share != 0.0:
                for e in range(reward.size):
                    reward[e] -= share * x[i, e] * x[j, e]


@inner
def _flag(most_age, arrived, alarm, age, flags):
    """Fills the flags of arrivals, alarms and broken contracts."""
    most = most_age if most_age >= 0 else MOST
    for e in range(age.size):
        flags[0, e] = arrived[e] != 0
    for e in range(age.size):
        flags[1, e] = alarm[e] != 0
    for e in range(age.size):
        flags[2, e] = age[e] > most


@inner
def _end(limit, terminates, steps, cost, flags):
    """Fills the flags of what is terminated, truncated and either; returns how many are either."""
    most, over = limit if limit >= 0 else MOST, 0
    for e in range(steps.size):
        flags[3, e] = terminates and cost[e] > 0.0
    for e in range(steps.size):
        flags[4, e] = steps[e] >= most
    for e in range(steps.size):
        flags[5, e] = flags[3, e] | flags[4, e]
        over += flags[5, e]
    return over
