"""One step of the control loop for all environments: compiled loops over arrays whose last axis is the environment."""

from __future__ import annotations

import numpy as np
from numba import njit

from ncs_gym.compiled import entry, inner, version_of
from ncs_gym.draws import fill_uniform
from ncs_gym.fleet import fleet_of
from ncs_gym.law import add_drawn
from ncs_gym.packets import Doubts, Transitions, follow_predictions, receive
from ncs_gym.product import add_product, copy_rows, hold_rows, set_product
from ncs_gym.report import Report, report
from ncs_gym.samples import CHAIN, send, switch
from ncs_gym.system import unpacked

# Stages of a step, in this order; packets of each age have a stage of their own in between.
DRAW, MOVE, PREDICT, RECEIVE = range(4)
LAST = 1 << 30
# What `run` is made of, next to this file.
SOURCES = ("draws", "fleet", "law", "packets", "product", "report", "samples", "system")
# Numbers of draws: each purpose has this many per step.
DISTURBANCE, PROCESS, SENSOR, NETWORK, PURPOSES = range(5)
WIDTH = 1024


@entry
def read_actions(actions, u_max, u):
    """Fills the first m rows of u, shape (>= m, N), with inputs from actions (N, m); returns whether all are finite."""
    wrong = 0
    for i in range(u_max.size):
        limit, row = u_max[i], u[i]
        for e in range(row.size):
            action = np.float64(actions[e, i])
            wrong += not np.isfinite(action)
            row[e] = limit * min(max(action, -1.0), 1.0)
    return wrong == 0


@entry
def clip(extra, low, high, out):
    """Fills out, shape (extra, N), with entries of observations, shape (N, extra), within their bounds."""
    for i in range(out.shape[0]):
        for e in range(out.shape[1]):
            value = extra[e, i]
            out[i, e] = low[i] if value < low[i] else high[i] if value > high[i] else value


@inner
def draw(system, fleet, number):
    """Draws the disturbances and moves the chain of the channel; numbers of draws begin at `number`."""
    keys, d = fleet.keys, fleet.disturbance
    d.fill(0.0)
    law = system.disturbance
    add_drawn(law.kind, law.factor, law.energy, keys, number + DISTURBANCE * WIDTH, d)
    law = system.process
    add_drawn(law.kind, law.factor, law.energy, keys, number + PROCESS * WIDTH, d)
    if system.bursts:
        fill_uniform(keys, number + NETWORK * WIDTH + CHAIN, 1, fleet.uniforms[CHAIN:])
        switch(system.moves, fleet.uniforms, fleet.bad)


@inner
def move(system, fleet, tick, u):
    """Moves states to A x + B u + d, with d in `fleet.disturbance`, and predicts means one step on."""
    slot = tick % system.slots
    advance(system, fleet.state, u, fleet.disturbance)
    predict(system, fleet.mean, u, fleet.priors[slot], fleet.inputs[slot])
    count(fleet.steps, fleet.age, fleet.wait, fleet.arrived)


@inner
def advance(system, state, u, d):
    """Moves states, shape (n, N), to A x + B u + d."""
    moved = np.empty_like(state)
    copy_rows(d, moved)
    add_product(system.A, state, moved)
    add_product(system.B, u, moved)
    hold_rows(system.farthest, moved)
    copy_rows(moved, state)


@inner
def predict(system, mean, u, prior, inputs):
    """Moves means, shape (n, N), to A x_hat + B u, and remembers them and the inputs."""
    set_product(system.A, mean, prior)
    add_product(system.B, u, prior)
    hold_rows(system.farthest, prior)
    copy_rows(prior, mean)
    copy_rows(u, inputs)


@inner
def count(steps, age, wait, arrived):
    """Moves the counters, shape (N,), one step on."""
    for e in range(steps.size):
        steps[e] += 1
        age[e] += 1
    for e in range(steps.size):
        wait[e] -= 1
        arrived[e] = 0


@inner
def _run(
    first,
    end,
    tick,
    moment,
    counts,
    constants,
    numbers,
    marks,
    nodes,
    edges,
    weights,
    shapes,
    doubts,
    residuals,
    reported,
    flags,
    observation,
    progress,
):
    """Runs the stages `first` up to but not including `end` of a step; stops where the gain table lacks edges.

    Arguments are bare arrays, because numba takes a quarter of a microsecond to open a tuple.

    Args:
        first: DRAW, MOVE, PREDICT, RECEIVE + i for packets of age longest - i, and LAST for the report.
        end: See above; above LAST for all.
        tick: Steps of the whole fleet, this one included.
        moment: Steps since the keys were made: with a key it determines what is drawn.
        counts: Of a packed `System`.
        constants: Of a packed `System`.
        numbers: Of a `Fleet`.
        marks: Of a `Fleet`.
        nodes: Of the gain table; see `Transitions`.
        edges: Of the gain table.
        weights: Of the gain table.
        shapes: Of the gain table.
        doubts: Filled with nodes that lack an edge, and suspects; see `Doubts`.
        residuals: Filled; see `Doubts`.
        reported: Inputs, and what a `Report` is filled with.
        flags: Filled; see `Report`.
        observation: Filled; see `Report`.
        progress: Filled with the stage reached, how many edges it lacks, how many residuals are doubtful, and how many
            episodes are over.

    Returns:
        Whether `end` was reached.
    """
    system, table = unpacked(counts, constants), Transitions(nodes, edges, weights, shapes)
    (n, m), p, u = system.B.shape, system.H.shape[0], reported[: system.B.shape[1]]
    fleet, number = fleet_of(n, m, p, system.slots, numbers, marks), moment * PURPOSES * WIDTH
    doubtful = Doubts(doubts[:, 0], doubts[:, 1:], residuals)
    if first <= DRAW < end:
        draw(system, fleet, number)
    if first <= MOVE < end:
        move(system, fleet, tick, u)
        send(system, fleet, tick, number + SENSOR * WIDTH, number + NETWORK * WIDTH)
        progress[2] = 0
    if first <= PREDICT < end:
        progress[0], progress[1] = PREDICT, follow_predictions(nodes, fleet.node, doubtful.missing)
        if progress[1] > 0:
            return False
    for i in range(max(0, first - RECEIVE), system.jitter + 1):
        if RECEIVE + i < end and first < LAST:
            age = system.delay + system.jitter - i
            missed, suspected = receive(system, table, fleet, tick, age, doubtful, progress[2])
            progress[0], progress[1], progress[2] = RECEIVE + i, missed, suspected
            if progress[1] > 0:
                return False
    if end > LAST:
        progress[3] = report(system, fleet, shapes, Report(reported, flags, observation))
    return True


def _compiled_run(version):
    """Returns `_run`, kept on disk for one version of everything that it calls."""

    @njit(cache=True, nogil=True)
    def run(
        first,
        end,
        tick,
        moment,
        counts,
        constants,
        numbers,
        marks,
        nodes,
        edges,
        weights,
        shapes,
        doubts,
        residuals,
        reported,
        flags,
        observation,
        progress,
    ):
        if version < 0:
            return False
        return _run(
            first,
            end,
            tick,
            moment,
            counts,
            constants,
            numbers,
            marks,
            nodes,
            edges,
            weights,
            shapes,
            doubts,
            residuals,
            reported,
            flags,
            observation,
            progress,
        )

    return run


run = _compiled_run(version_of(__file__, *SOURCES))
