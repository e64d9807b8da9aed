"""Compiled loops that send samples and take in what arrives; the last axis of every array is the environment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ncs_gym.law import add_drawn


class Transitions(NamedTuple):
    """The arrays of a `GainTable` that loops read."""

    predicted: np.ndarray
    received: np.ndarray
    target: np.ndarray
    accepted: np.ndarray
    fresh: np.ndarray
    held: np.ndarray
    weights: np.ndarray


class Doubts(NamedTuple):
    """Nodes without an edge, shape (N,), and residuals beyond the quick test: (environment, edge, age) and (p,) each."""

    missing: np.ndarray
    suspects: np.ndarray
    residuals: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
def send(system, fleet, tick, keys, number):
    """Measures, rounds, loses and delays the samples of this step.

    Args:
        system: The loop.
        fleet: Changed in place.
        tick: Steps of the whole fleet.
        keys: Of random numbers, shape (N,).
        number: Of the first draw of the sensors.
    """
    p, n = system.H.shape
    N, slot = fleet.wait.size, tick % system.slots
    due = fleet.due[slot]
    due[:] = -1
    if system.bursts:
        for e in range(N):
            fleet.bad[e] ^= fleet.uniforms[2, e] < system.moves[fleet.bad[e]]
    sent = 0
    for e in range(N):
        sent += fleet.wait[e] <= 0
    if sent == 0:
        return
    fleet.noise[:] = 0.0
    add_drawn(system.sensor, keys, number, fleet.noise)
    for e in range(N):
        if fleet.wait[e] <= 0:
            fleet.wait[e] = system.period
            loss = system.losses[fleet.bad[e]]
            lost = loss > 0.0 and fleet.uniforms[0, e] < loss
            lost = lost and (system.most_lost < 0 or fleet.lost[e] < system.most_lost)
            extra = int(fleet.uniforms[1, e] * (system.jitter + 1)) if system.jitter > 0 else 0
            fleet.lost[e] = fleet.lost[e] + 1 if lost else 0
            due[e] = -1 if lost else system.delay + min(extra, system.jitter)
    for i in range(p):
        _measure(system, fleet, i, due, fleet.samples[slot, i])


@njit(cache=True, nogil=True, error_model="numpy")
def _measure(system, fleet, i, due, samples):
    """Fills what sensor i says, shape (N,), rounded; what is not finite is not sent and raises the alarm."""
    noise, absurd = fleet.noise[i], 0
    samples[:] = noise
    for j in range(fleet.state.shape[0]):
        share, row = system.H[i, j], fleet.state[j]
        for e in range(samples.size):
            samples[e] += share * row[e]
    for e in range(samples.size):
        absurd += not np.isfinite(samples[e])
    if absurd > 0:
        for e in range(samples.size):
            if not np.isfinite(samples[e]):
                samples[e] = 0.0
                if due[e] >= 0:  # no sensor within the assumptions sends this
                    due[e], fleet.alarm[e] = -1, 1
    if system.step > 0.0:
        for e in range(samples.size):
            samples[e] = np.rint(samples[e] / system.step) * system.step


@njit(cache=True, nogil=True)
def follow_predictions(predicted, node, missing):
    """Moves the node of every environment along the edge of a prediction, if the table has them all.

    Args:
        predicted: Of the gain table.
        node: Shape (N,), changed in place.
        missing: Filled with nodes without an edge, shape (N,).

    Returns:
        How many are missing; nothing has moved then.
    """
    missed = 0
    for e in range(node.size):
        if predicted[node[e]] < 0:
            missing[missed] = node[e]
            missed += 1
    if missed == 0:
        for e in range(node.size):
            node[e] = predicted[node[e]]
    return missed


@njit(cache=True, nogil=True, error_model="numpy")
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
    edges, missed = _edges(table.received[:, age - system.delay], fleet.node, who, doubts.missing)
    if missed > 0:
        return missed, doubtful
    chain = _gathered(fleet.priors[(tick - age) % slots], who)
    for each in range(age, -1, -1):
        slot = (tick - each) % slots
        if each < age:
            _keep(table.accepted, edges, who, chain, fleet.priors[slot])
        if _any_held(table.held, edges, each):
            samples = _gathered(fleet.samples[slot], who)
            doubtful = _update(system, table, samples, each, who, edges, chain, doubts, doubtful)
        if each > 0:
            chain = _predicted(system, _gathered(fleet.inputs[(tick - each + 1) % slots], who), chain)
    _keep(table.accepted, edges, who, chain, fleet.mean)
    for k in range(who.size):
        edge, e = edges[k], who[k]
        fleet.arrived[e] = 1
        fleet.node[e] = table.target[edge]
        if table.fresh[edge] >= 0:
            fleet.age[e] = table.fresh[edge]
    return 0, doubtful


@njit(cache=True, nogil=True)
def _equal(marks, value):
    """Returns the environments with some mark."""
    who, count = np.empty(marks.size, np.int64), 0
    for e in range(marks.size):
        who[count] = e
        count += marks[e] == value
    return who[:count]


@njit(cache=True, nogil=True)
def _edges(received, nodes, who, missing):
    """Returns the edges that packets take from the nodes of some environments, and how many of them are missing."""
    edges, missed = np.empty(who.size, np.int64), 0
    for k in range(who.size):
        edges[k] = received[nodes[who[k]]]
        missed += edges[k] < 0
    if missed > 0:
        missed = 0
        for k in range(who.size):
            if edges[k] < 0:
                missing[missed] = nodes[who[k]]
                missed += 1
    return edges, missed


@njit(cache=True, nogil=True)
def _gathered(rows, who):
    """Returns the columns `who` of an array of rows."""
    out = np.empty((rows.shape[0], who.size))
    for i in range(rows.shape[0]):
        row, some = rows[i], out[i]
        for k in range(who.size):
            some[k] = row[who[k]]
    return out


@njit(cache=True, nogil=True)
def _any_held(held, edges, age):
    """Returns whether a sample of some age is used along any of the edges."""
    for k in range(edges.size):  # noqa: SIM110
        if held[edges[k], age]:
            return True
    return False


@njit(cache=True, nogil=True)
def _keep(accepted, edges, who, chain, out):
    """Writes replayed means, shape (n, count), to the environments, shape (n, N), where they are accepted."""
    for i in range(chain.shape[0]):
        some, row = chain[i], out[i]
        for k in range(edges.size):
            e = who[k]
            row[e] = some[k] if accepted[edges[k]] else row[e]


@njit(cache=True, nogil=True, error_model="numpy")
def _predicted(system, inputs, chain):
    """Returns A chain + B inputs, shape (n, count)."""
    out = np.zeros_like(chain)
    for i in range(out.shape[0]):
        row = out[i]
        for j in range(out.shape[0]):
            share, some = system.A[i, j], chain[j]
            for k in range(row.size):
                row[k] += share * some[k]
        for j in range(inputs.shape[0]):
            share, some = system.B[i, j], inputs[j]
            for k in range(row.size):
                row[k] += share * some[k]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _update(system, table, residual, age, who, edges, chain, doubts, doubtful):
    """Adds gain times residual (zero where no sample is used) to the means of one age; returns how many suspects.

    Args:
        system: The loop.
        table: Transitions of the gain table.
        residual: The samples, shape (p, count); turned into residuals.
        age: Of the samples.
        who: Environments, shape (count,).
        edges: Their edges.
        chain: Means, shape (n, count), changed in place.
        doubts: Filled with residuals beyond the quick test.
        doubtful: How many there are already.
    """
    (p, count), n = residual.shape, chain.shape[0]
    weights, square = np.empty((n * p + p * p, count)), np.zeros(count)
    for k in range(count):
        row = table.weights[edges[k], age]
        for i in range(row.size):
            weights[i, k] = row[i]
    for i in range(p):
        for j in range(n):
            share, row, some = system.H[i, j], residual[i], chain[j]
            if share != 0.0:
                for k in range(count):
                    row[k] -= share * some[k]
    for i in range(p):
        for j in range(p):
            share, row, other = weights[n * p + i * p + j], residual[i], residual[j]
            for k in range(count):
                square[k] += row[k] * share[k] * other[k]
    for i in range(n):
        for j in range(p):
            share, row, other = weights[i * p + j], chain[i], residual[j]
            for k in range(count):
                row[k] += share[k] * other[k]
    far = 0
    for k in range(count):
        far += not square[k] <= 1.0
    if far > 0:
        for k in range(count):
            if not square[k] <= 1.0 and table.held[edges[k], age]:
                doubts.suspects[doubtful] = who[k], edges[k], age
                doubts.residuals[doubtful] = residual[:, k]
                doubtful += 1
    return doubtful
