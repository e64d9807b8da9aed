"""Compiled inner loops of the vector environment; the last axis of every array is the environment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit


class Model(NamedTuple):
    """The plant as loops need it: A (n, n), B (n, m), H (p, n), C (k, n), u_max (m,)."""

    A: np.ndarray
    B: np.ndarray
    H: np.ndarray
    C: np.ndarray
    u_max: np.ndarray


class Fleet(NamedTuple):
    """What N environments remember; rings have a slot per age 0..buffer, found by step modulo their length.

    Attributes:
        state, mean: x and x_hat, shape (n, N).
        priors: Means before updates, shape (buffer + 1, n, N).
        inputs: Inputs that led to each step, shape (buffer + 1, m, N).
        samples: Measurements as sent, shape (buffer + 1, p, N).
        due: Age at which each sample arrives, -1 if never, shape (buffer + 1, N).
        node: Of the gain table, shape (N,).
        age: Steps since the newest sample used, shape (N,).
        steps: In this episode, shape (N,).
        wait: Steps until the next sample is sent, shape (N,).
        lost: Packets lost in a row, shape (N,).
        bad: State of the Gilbert-Elliott chain, shape (N,).
        alarm, arrived: Shape (N,).
        violations: In this episode, shape (N,).
    """

    state: np.ndarray
    mean: np.ndarray
    priors: np.ndarray
    inputs: np.ndarray
    samples: np.ndarray
    due: np.ndarray
    node: np.ndarray
    age: np.ndarray
    steps: np.ndarray
    wait: np.ndarray
    lost: np.ndarray
    bad: np.ndarray
    alarm: np.ndarray
    arrived: np.ndarray
    violations: np.ndarray


class Network(NamedTuple):
    """A channel as loops need it; `losses` and `moves` are those of the good and the bad state.

    The chain moves if `bursts`; `most_lost` is -1 if any number may be lost in a row.
    """

    period: int
    delay: int
    jitter: int
    most_lost: int
    step: float
    bursts: bool
    losses: np.ndarray
    moves: np.ndarray


class Transitions(NamedTuple):
    """The arrays of a `GainTable`."""

    predicted: np.ndarray
    received: np.ndarray
    target: np.ndarray
    accepted: np.ndarray
    fresh: np.ndarray
    held: np.ndarray
    gains: np.ndarray
    checks: np.ndarray


@njit(cache=True, nogil=True)
def add_truncated(rng, energy, factor, out):
    """Adds factor g to each row of `out`, shape (count, n), g normal with a sum of squares of at most `energy`."""
    count, rank = out.shape[0], factor.shape[1]
    g = np.empty((count, rank))
    for row in range(count):
        square = np.inf
        while square > energy:
            square = 0.0
            for i in range(rank):
                value = rng.standard_normal()
                g[row, i] = value
                square += value * value
    for i in range(out.shape[1]):
        for j in range(rank):
            for row in range(count):
                out[row, i] += factor[i, j] * g[row, j]


@njit(cache=True, nogil=True)
def add_box(rng, half_widths, out):
    """Adds a uniform point of the box with these half-widths, shape (n,), to each row of `out`, shape (count, n)."""
    for row in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[row, i] += half_widths[i] * (2.0 * rng.random() - 1.0)


@njit(cache=True, nogil=True)
def read_actions(actions, u_max, u):
    """Fills inputs u, shape (m, N), from actions (N, m); returns whether all are finite."""
    finite = True
    for i in range(u.shape[0]):
        for e in range(u.shape[1]):
            action = np.float64(actions[e, i])
            finite &= np.isfinite(action)
            u[i, e] = u_max[i] * min(max(action, -1.0), 1.0)
    return finite


@njit(cache=True, nogil=True)
def moved(matrix, x, effect, u, out):
    """Fills out = matrix x + effect u."""
    for i in range(out.shape[0]):
        for e in range(out.shape[1]):
            out[i, e] = matrix[i, 0] * x[0, e]
        for j in range(1, matrix.shape[1]):
            for e in range(out.shape[1]):
                out[i, e] += matrix[i, j] * x[j, e]
        for j in range(effect.shape[1]):
            for e in range(out.shape[1]):
                out[i, e] += effect[i, j] * u[j, e]


@njit(cache=True, nogil=True)
def advance(model, fleet, tick, u, nominal, d):
    """Moves states, shape (n, N), to nominal + d, d of shape (N, n), and predicts means one step on."""
    slot = tick % fleet.priors.shape[0]
    prior = fleet.priors[slot]
    moved(model.A, fleet.mean, model.B, u, prior)
    fleet.mean[:] = prior
    fleet.inputs[slot] = u
    for i in range(nominal.shape[0]):
        for e in range(nominal.shape[1]):
            fleet.state[i, e] = nominal[i, e] + d[e, i]
    fleet.steps[:] += 1
    fleet.age[:] += 1
    fleet.wait[:] -= 1
    fleet.arrived[:] = False
    fleet.due[slot] = -1


@njit(cache=True, nogil=True)
def send(model, network, fleet, tick, uniforms, noise):
    """Measures, rounds, loses and delays the samples of this step.

    Args:
        model: The plant.
        network: The channel.
        fleet: Changed in place.
        tick: Steps of the whole fleet.
        uniforms: For loss, jitter and chain, shape (3, N); rows at the end that are not needed may be missing.
        noise: Sensor noise, one row per sample sent, shape (>= N, p).

    Returns:
        How many samples were sent.
    """
    slot = tick % fleet.due.shape[0]
    p, n = model.H.shape
    sent = 0
    for e in range(fleet.wait.size):
        state = 0
        if network.bursts:
            state = int(fleet.bad[e])
            if uniforms[2, e] < network.moves[state]:
                state = 1 - state
            fleet.bad[e] = state == 1
        if fleet.wait[e] > 0:
            continue
        fleet.wait[e] = network.period
        sent += 1
        lost = network.losses[state] > 0.0 and uniforms[0, e] < network.losses[state]
        lost = lost and (network.most_lost < 0 or fleet.lost[e] < network.most_lost)
        fleet.lost[e] = fleet.lost[e] + 1 if lost else 0
        if lost:
            continue
        extra = int(uniforms[1, e] * (network.jitter + 1)) if network.jitter > 0 else 0
        fleet.due[slot, e] = network.delay + min(extra, network.jitter)
        for i in range(p):
            value = noise[sent - 1, i]
            for j in range(n):
                value += model.H[i, j] * fleet.state[j, e]
            if not np.isfinite(value):  # no sensor within the assumptions sends this
                fleet.due[slot, e], fleet.alarm[e] = -1, True
            fleet.samples[slot, i, e] = np.rint(value / network.step) * network.step if network.step > 0.0 else value
    return sent


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


@njit(cache=True, nogil=True)
def receive(model, table, fleet, tick, age, column, missing, suspects, residuals):
    """Takes in the packets of one age, if the gain table knows all their edges: replays means from their stamp on.

    Args:
        model: The plant.
        table: Transitions of the gain table.
        fleet: Changed in place.
        tick: Steps of the whole fleet.
        age: Of the packets.
        column: Of `table.received`.
        missing: Filled with nodes without an edge, shape (N,).
        suspects: Filled with (environment, edge, age) of residuals beyond the quick test, shape (N (buffer + 1), 3).
        residuals: These residuals, shape (N (buffer + 1), p).

    Returns:
        How many edges are missing (nothing has moved then), and how many suspects there are.
    """
    slots, N = fleet.due.shape
    due = fleet.due[(tick - age) % slots]
    who, edges = np.empty(N, np.int64), np.empty(N, np.int64)
    count = missed = 0
    for e in range(N):
        if due[e] == age:
            edge = table.received[fleet.node[e], column]
            if edge < 0:
                missing[missed] = fleet.node[e]
                missed += 1
            who[count], edges[count] = e, edge
            count += 1
    if missed > 0 or count == 0:
        return missed, 0
    who, edges = who[:count], edges[:count]
    chain = np.empty((model.A.shape[0], count))
    for i in range(chain.shape[0]):
        for k in range(count):
            chain[i, k] = fleet.priors[(tick - age) % slots, i, who[k]]
    doubtful = 0
    for each in range(age, -1, -1):
        slot = (tick - each) % slots
        if each < age:
            _keep(table.accepted, edges, who, chain, fleet.priors[slot])
        if _any_held(table.held, edges, each):
            doubtful = _update(
                model, table, fleet.samples[slot], each, who, edges, chain, suspects, residuals, doubtful
            )
        if each > 0:
            chain = _predicted(model, fleet.inputs[(tick - each + 1) % slots], who, chain)
    _keep(table.accepted, edges, who, chain, fleet.mean)
    for k in range(count):
        edge, e = edges[k], who[k]
        fleet.arrived[e] = True
        fleet.node[e] = table.target[edge]
        if table.fresh[edge] >= 0:
            fleet.age[e] = table.fresh[edge]
    return 0, doubtful


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
        for k in range(edges.size):
            if accepted[edges[k]]:
                out[i, who[k]] = chain[i, k]


@njit(cache=True, nogil=True)
def _predicted(model, inputs, who, chain):
    """Returns A chain + B inputs of the environments `who`."""
    out = np.zeros_like(chain)
    for i in range(out.shape[0]):
        for j in range(out.shape[0]):
            for k in range(out.shape[1]):
                out[i, k] += model.A[i, j] * chain[j, k]
        for j in range(inputs.shape[0]):
            for k in range(out.shape[1]):
                out[i, k] += model.B[i, j] * inputs[j, who[k]]
    return out


@njit(cache=True, nogil=True)
def _update(model, table, samples, age, who, edges, chain, suspects, residuals, doubtful):
    """Adds gain times residual (zero where no sample is used) to the means of one age; returns how many suspects."""
    p, n = model.H.shape
    count = who.size
    residual, square = np.empty((p, count)), np.zeros(count)
    for i in range(p):
        for k in range(count):
            residual[i, k] = samples[i, who[k]]
        for j in range(n):
            for k in range(count):
                residual[i, k] -= model.H[i, j] * chain[j, k]
    for i in range(p):
        for j in range(p):
            for k in range(count):
                square[k] += residual[i, k] * table.checks[edges[k], age, i, j] * residual[j, k]
    for i in range(n):
        for j in range(p):
            for k in range(count):
                chain[i, k] += table.gains[edges[k], age, i, j] * residual[j, k]
    for k in range(count):
        if not square[k] <= 1.0 and table.held[edges[k], age]:
            suspects[doubtful, 0], suspects[doubtful, 1], suspects[doubtful, 2] = who[k], edges[k], age
            residuals[doubtful] = residual[:, k]
            doubtful += 1
    return doubtful


@njit(cache=True, nogil=True)
def report(model, fleet, shapes, most_age, low, high, counted, observation, error, shape, values, cost, broken):
    """Fills what a step reports.

    Args:
        model: The plant.
        fleet: Whose violations are counted in place.
        shapes: Sigma_k of the table's nodes, shape (nodes, n * n).
        most_age: What the contract allows, -1 without one.
        low: Of the observation box, shape (n + extra,).
        high: Of the observation box, shape (n + extra,).
        counted: Whose violations count, shape (N,).
        observation: First n rows filled, shape (n + extra, N).
        error: x_hat - x, shape (n, N).
        shape: Sigma_k, shape (N, n * n).
        values: abs(c_j x) - 1, shape (k, N).
        cost: 1.0 where one is positive, shape (N,).
        broken: Whether the newest sample used is too old, shape (N,).
    """
    n, N = fleet.state.shape
    for i in range(n):
        for e in range(N):
            observation[i, e] = min(max(fleet.mean[i, e], low[i]), high[i])
            error[i, e] = fleet.mean[i, e] - fleet.state[i, e]
    cost[:] = 0.0
    for k in range(values.shape[0]):
        for e in range(N):
            values[k, e] = model.C[k, 0] * fleet.state[0, e]
        for i in range(1, n):
            for e in range(N):
                values[k, e] += model.C[k, i] * fleet.state[i, e]
        for e in range(N):
            values[k, e] = abs(values[k, e]) - 1.0
            cost[e] = 1.0 if values[k, e] > 0.0 else cost[e]
    for e in range(N):
        if counted[e]:
            fleet.violations[e] += cost[e]
        broken[e] = most_age >= 0 and fleet.age[e] > most_age
        node = fleet.node[e]
        for i in range(n * n):
            shape[e, i] = shapes[node, i]


@njit(cache=True, nogil=True)
def quadratic(Q, x, R, u, out):
    """Fills out with x'Qx + u'Ru for x of shape (n, N) and u of shape (m, N)."""
    out[:] = 0.0
    for i in range(Q.shape[0]):
        for j in range(Q.shape[0]):
            for e in range(out.size):
                out[e] += Q[i, j] * x[i, e] * x[j, e]
    for i in range(R.shape[0]):
        for j in range(R.shape[0]):
            for e in range(out.size):
                out[e] += R[i, j] * u[i, e] * u[j, e]


@njit(cache=True, nogil=True)
def follow_profile(memory, acceleration, dt, draws, change_probability, fastest, out):
    """Fills speeds and targets, shape (N, 2), one step after `memory`; see `SpeedTracking.advance`."""
    for e in range(out.shape[0]):
        out[e, 0] = memory[e, 0] + dt * acceleration[e]
        out[e, 1] = fastest * draws[1, e] if draws[0, e] < change_probability else memory[e, 1]


@njit(cache=True, nogil=True)
def profile_reward(memory, acceleration, error_weight, input_weight, out):
    """Fills rewards, shape (N,); see `SpeedTracking.reward`."""
    for e in range(out.size):
        error, effort = memory[e, 1] - memory[e, 0], acceleration[e]
        out[e] = -error_weight * min(abs(error) / 5.0, 5.0) - input_weight * effort * effort
