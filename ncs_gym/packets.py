"""Compiled loops that take in what arrives; the last axis of every array is the environment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym.compiled import inner
from ncs_gym.estimation.gain_table import ACCEPTED, FRESH, HELD, LAST_BIT, TARGET
from ncs_gym.product import add_product, hold_rows, set_product


class Transitions(NamedTuple):
    """The arrays of a `GainTable` that loops read."""

    nodes: np.ndarray
    edges: np.ndarray
    weights: np.ndarray
    shapes: np.ndarray


class Doubts(NamedTuple):
    """What Python has to look at.

    Attributes:
        missing: Nodes without an edge, shape (>= N,).
        suspects: Environment, edge and age of residuals beyond the quick test, shape (N (buffer + 1), 3).
        residuals: These, shape (N (buffer + 1), p).
    """

    missing: np.ndarray
    suspects: np.ndarray
    residuals: np.ndarray


@inner
def follow_predictions(nodes, node, missing):
    """Moves the node of every environment along the edge of a prediction, if the table has them all.

    Args:
        nodes: Of the gain table.
        node: Shape (N,), changed in place.
        missing: Filled with nodes without an edge, shape (N,).

    Returns:
        How many are missing; nothing has moved then.
    """
    missed, after = 0, np.empty(node.size, np.int32)
    for e in range(node.size):
        after[e] = nodes[node[e], 0]
        missed += after[e] < 0
    if missed > 0:
        missed = 0
        for e in range(node.size):
            if after[e] < 0:
                missing[missed] = node[e]
                missed += 1
    else:
        for e in range(node.size):
            node[e] = after[e]
    return missed


@inner
def receive(system, table, fleet, tick, age, doubts, doubtful):
    """Takes in the packets of one age, if the gain table knows all their edges: replays means from their stamp on.

    Args:
        system: The loop.
        table: Transitions of the gain table.
        fleet: Changed in place.
        tick: Steps of the whole fleet.
        age: Of the packets.
        doubts: Filled with nodes without an edge, and with residuals beyond the quick test.
        doubtful: How many of these there are already.

    Returns:
        How many edges are missing (nothing has moved then), and how many suspects there are.
    """
    slots = system.slots
    who = _equal(fleet.due[(tick - age) % slots], age)
    if who.size == 0:
        return 0, doubtful
    edges, missed = _edges(table.nodes, 1 + age - system.delay, fleet.node, who, doubts.missing)
    if missed > 0:
        return missed, doubtful
    held, accepted = _common(table.edges, edges)
    chain = _gathered(fleet.priors, (tick - age) % slots, who)
    for each in range(age, -1, -1):
        slot = (tick - each) % slots
        if each < age:
            _keep(accepted, who, chain, fleet.priors[slot])
        if held >> min(each, LAST_BIT) & 1:
            residual, square = _gathered(fleet.samples, slot, who), np.zeros(who.size)
            _update(system.H, table.weights, each, edges, residual, square, chain)
            doubtful = _suspect(table.edges, each, edges, who, residual, square, doubts, doubtful)
        if each > 0:
            inputs = _gathered(fleet.inputs, (tick - each + 1) % slots, who)
            chain = _predicted(system, inputs, chain)
    _keep(accepted, who, chain, fleet.mean)
    _arrive(table.edges, edges, who, fleet.arrived, fleet.node, fleet.age)
    return 0, doubtful


@inner
def _arrive(table, edges, who, arrived, node, age):
    """Moves the environments `who` along their edges."""
    for k in range(who.size):
        edge, e = edges[k], who[k]
        arrived[e] = 1
        node[e] = table[edge, TARGET]
        fresh = table[edge, FRESH]
        age[e] = fresh if fresh >= 0 else age[e]


@inner
def _equal(marks, value):
    """Returns the environments with some mark."""
    who, count = np.empty(marks.size, np.int64), 0
    for e in range(marks.size):
        who[count] = e
        count += marks[e] == value
    return who[:count]


@inner
def _edges(nodes, column, node, who, missing):
    """Returns the edges that packets take from the nodes of some environments, and how many of them are missing."""
    edges, missed = np.empty(who.size, np.int64), 0
    for k in range(who.size):
        edges[k] = nodes[node[who[k]], column]
        missed += edges[k] < 0
    if missed > 0:
        missed = 0
        for k in range(who.size):
            if edges[k] < 0:
                missing[missed] = node[who[k]]
                missed += 1
    return edges, missed


@inner
def _gathered(ring, slot, who):
    """Returns the columns `who` of a slot of a ring, shape (slots, rows, N)."""
    out = np.empty((ring.shape[1], who.size))
    for i in range(ring.shape[1]):
        for k in range(who.size):
            out[i, k] = ring[slot, i, who[k]]
    return out


@inner
def _common(edges, taken):
    """Returns the ages of samples used along any of the edges taken, as bits, and which edges are accepted.

    The latter is empty if all are.
    """
    held, every = 0, 1
    for k in range(taken.size):
        held |= edges[taken[k], HELD]
        every &= edges[taken[k], ACCEPTED]
    accepted = np.empty(0 if every else taken.size, np.int32)
    for k in range(accepted.size):
        accepted[k] = edges[taken[k], ACCEPTED]
    return held, accepted


@inner
def _keep(accepted, who, chain, out):
    """Writes replayed means, shape (n, count), to the environments, shape (n, N), where they are accepted."""
    for i in range(chain.shape[0]):
        if accepted.size == 0:
            for k in range(who.size):
                out[i, who[k]] = chain[i, k]
        else:
            for k in range(who.size):
                out[i, who[k]] = chain[i, k] if accepted[k] else out[i, who[k]]


@inner
def _predicted(system, inputs, chain):
    """Returns A chain + B inputs, shape (n, count)."""
    out = np.empty_like(chain)
    set_product(system.A, chain, out)
    add_product(system.B, inputs, out)
    hold_rows(system.farthest, out)
    return out


@inner
def _update(H, table, age, edges, residual, square, chain):
    """Adds gain times residual (zero where no sample is used) to the means of one age.

    Args:
        H: Shape (p, n).
        table: Weights of the gain table.
        age: Of the samples.
        edges: Of the environments, shape (count,).
        residual: The samples, shape (p, count); turned into residuals.
        square: Zeros, shape (count,); filled with the quick test, at most 1 where a residual is possible.
        chain: Means, shape (n, count), changed in place.
    """
    (p, count), n = residual.shape, chain.shape[0]
    weights = np.empty(count)
    for i in range(p):
        for j in range(n):
            share = H[i, j]
            if share != 0.0:
                for k in range(count):
                    residual[i, k] -= share * chain[j, k]
    for i in range(p):
        for j in range(i + 1):
            factor = 1.0 if i == j else 2.0
            _look_up(table, age, n * p + i * p + j, edges, weights)
            for k in range(count):
                square[k] += factor * residual[i, k] * weights[k] * residual[j, k]
    for i in range(n):
        for j in range(p):
            _look_up(table, age, i * p + j, edges, weights)
            for k in range(count):
                chain[i, k] += weights[k] * residual[j, k]


@inner
def _look_up(table, age, row, edges, weights):
    """Fills one of the weights of edges, shape (count,)."""
    for k in range(edges.size):
        weights[k] = table[age, row, edges[k]]


@inner
def _suspect(table, age, edges, who, residual, square, doubts, doubtful):
    """Notes residuals beyond the quick test; returns how many there are now."""
    far = 0
    for k in range(square.size):
        far += not square[k] <= 1.0
    if far > 0:
        for k in range(square.size):
            if not square[k] <= 1.0 and table[edges[k], HELD] >> min(age, LAST_BIT) & 1:
                doubts.suspects[doubtful] = who[k], edges[k], age
                for i in range(residual.shape[0]):
                    doubts.residuals[doubtful, i] = residual[i, k]
                doubtful += 1
    return doubtful
