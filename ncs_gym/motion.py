"""One step of the control loop for all environments: compiled loops over arrays whose last axis is the environment."""

from __future__ import annotations

import numpy as np
from numba import njit

from ncs_gym.draws import fill_uniform
from ncs_gym.fleet import fleet_of
from ncs_gym.law import add_drawn
from ncs_gym.packets import Doubts, Transitions, follow_predictions, receive, send
from ncs_gym.report import report
from ncs_gym.system import unpacked

# Stages of a step, in this order; packets of each age have a stage of their own in between.
DRAW, MOVE, PREDICT, RECEIVE = range(4)
LAST = 1 << 30
# Numbers of draws: each purpose has this many per step.
DISTURBANCE, PROCESS, SENSOR, NETWORK, PURPOSES = range(5)
WIDTH = 1024


@njit(cache=True, nogil=True)
def read_actions(actions, u_max, u):
    """Fills inputs u, shape (m, N), from actions (N, m); returns whether all are finite."""
    wrong = 0
    for i in range(u.shape[0]):
        limit, row = u_max[i], u[i]
        for e in range(row.size):
            action = np.float64(actions[e, i])
            wrong += not np.isfinite(action)
            row[e] = limit * min(max(action, -1.0), 1.0)
    return wrong == 0


@njit(cache=True, nogil=True, error_model="numpy")
def add_moved(matrix, x, out):
    """Adds matrix x to out, shapes (k, n), (n, N) and (k, N)."""
    for i in range(out.shape[0]):
        row = out[i]
        for j in range(x.shape[0]):
            share, some = matrix[i, j], x[j]
            for e in range(row.size):
                row[e] += share * some[e]


@njit(cache=True, nogil=True, error_model="numpy")
def draw(system, fleet, keys, number):
    """Draws the disturbances and what the channel needs; numbers of draws begin at `number`."""
    fleet.disturbance[:] = 0.0
    add_drawn(system.disturbance, keys, number + DISTURBANCE * WIDTH, fleet.disturbance)
    add_drawn(system.process, keys, number + PROCESS * WIDTH, fleet.disturbance)
    fill_uniform(keys, number + NETWORK * WIDTH, fleet.uniforms[: system.uniforms])


@njit(cache=True, nogil=True, error_model="numpy")
def move(system, fleet, tick, u):
    """Moves states to A x + B u + d, with d in `fleet.disturbance`, and predicts means one step on."""
    slot = tick % system.slots
    prior, state = fleet.priors[slot], fleet.state
    prior[:] = 0.0
    add_moved(system.A, fleet.mean, prior)
    add_moved(system.B, u, prior)
    fleet.mean[:] = prior
    fleet.inputs[slot] = u
    moved = np.zeros_like(state)
    add_moved(system.A, state, moved)
    add_moved(system.B, u, moved)
    for i in range(state.shape[0]):
        row, some, d = state[i], moved[i], fleet.disturbance[i]
        for e in range(row.size):
            row[e] = some[e] + d[e]
    for e in range(fleet.age.size):
        fleet.steps[e] += 1
        fleet.age[e] += 1
        fleet.wait[e] -= 1
    fleet.arrived[:] = 0


@njit(cache=True, nogil=True)
def run(first, end, tick, moment, packed, memory, keys, table, shapes, doubts, u, counted, outputs, progress):
    """Runs the stages `first` up to but not including `end` of a step; stops where the gain table lacks edges.

    Args:
        first: DRAW, MOVE, PREDICT, RECEIVE + i for packets of age longest - i, and LAST for the report.
        end: See above; above LAST for all.
        tick: Steps of the whole fleet, this one included.
        moment: Steps since the keys were made: with a key it determines what is drawn.
        packed: The two arrays of a `System`.
        memory: The two arrays of a `Fleet`.
        keys: Of random numbers, shape (N,).
        table: `Transitions` of the gain table.
        shapes: Of its nodes, shape (nodes, n * n).
        doubts: Filled; see `Doubts`.
        u: Inputs, shape (m, N).
        counted: Whose violations count, shape (N,).
        outputs: Filled by `report`.
        progress: Filled with the stage reached, how many edges it lacks, and how many residuals are doubtful.

    Returns:
        Whether `end` was reached.
    """
    system = unpacked(packed[0], packed[1])
    (n, m), p = system.B.shape, system.H.shape[0]
    fleet, number = fleet_of(n, m, p, system.slots, memory[0], memory[1]), moment * PURPOSES * WIDTH
    if first <= DRAW < end:
        draw(system, fleet, keys, number)
    if first <= MOVE < end:
        move(system, fleet, tick, u)
        send(system, fleet, tick, keys, number + SENSOR * WIDTH)
        progress[2] = 0
    if first <= PREDICT < end:
        progress[0], progress[1] = PREDICT, follow_predictions(table.predicted, fleet.node, doubts.missing)
        if progress[1] > 0:
            return False
    for i in range(max(0, first - RECEIVE), system.jitter + 1):
        if RECEIVE + i < end and first < LAST:
            age = system.delay + system.jitter - i
            missed, doubtful = receive(system, table, fleet, tick, age, doubts, progress[2])
            progress[0], progress[1], progress[2] = RECEIVE + i, missed, doubtful
            if missed > 0:
                return False
    if end > LAST:
        report(system, fleet, shapes, u, counted, outputs)
    return True
