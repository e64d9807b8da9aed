"""What shields of many environments do after a step at which no episode began, in one compiled call."""

from __future__ import annotations

import numpy as np
from numba import njit

from ncs_gym import product
from ncs_gym.compiled import inner, version_of
from ncs_gym.product import copy_rows
from shields.tracking import Ground, Knowledge, compare_clocks, count_interventions, number, track

# Rows of what is kept from step to step: whole numbers and flags.
BROKEN, INTERVENTIONS, COUNTS = range(3)
INSIDE, CERTIFIED, KNOWN, MARKS = range(4)
# Rows of what a step tells.
CORRECTION, TOTAL, TOLD = range(3)


@inner
def _follow(
    root,
    bounds,
    rounding,
    margin,
    has_errors,
    seen,
    numbers,
    nodes,
    episodes,
    steps,
    episodes_before,
    steps_before,
    next_tick,
    counts,
    marks,
    decided,
    proposed,
    intervened,
    passed,
    fallback,
    applied,
    reported,
    alarm,
    shape,
    estimate,
    reason,
    told,
    guaranteed,
):
    """Moves everything that a batch of shields remembers one step on; arguments are bare arrays, see `motion`.

    Args:
        root: Of a `Ground`.
        bounds: Columns and reach of a `Ground`, shape (2, n).
        rounding: Of a `Ground`.
        margin: Of a `Ground`.
        has_errors: Of a `Ground`.
        seen: Of a `ShapeBook`.
        numbers: Index in the book of each node's shape, -1 where unknown.
        nodes: Of the environments, shape (N,).
        episodes: By the clock now, shape (N,).
        steps: By the clock now, shape (N,).
        episodes_before: By the clock before, shape (N,).
        steps_before: By the clock before, shape (N,); moved on.
        next_tick: Whether the vector moved once.
        counts: Kept, shape (COUNTS, N); changed.
        marks: Kept, shape (MARKS, N); changed.
        decided: Inputs decided, shape (m, N).
        proposed: Inputs proposed, shape (m, N).
        intervened: Decided, shape (N,).
        passed: Of decisions, shape (N,).
        fallback: Of decisions, shape (N,).
        applied: Inputs reported, shape (m, N).
        reported: Estimates reported, shape (n, N).
        alarm: Of the monitor, shape (N,).
        shape: Indices of error shapes, shape (N,); changed.
        estimate: Shape (n, N); filled with what is reported.
        reason: Filled with codes, shape (N,).
        told: Filled with norms of corrections and, in bits of int64, interventions so far, shape (TOLD, N).
        guaranteed: Filled, shape (N,).

    Returns:
        How many proofs do not hold; -1 if an episode began or a shape is not in the book, and nothing was done.
    """
    count = steps.size
    restarted, moved_once = np.empty(count, np.bool_), np.empty(count, np.bool_)
    if compare_clocks(episodes, steps, episodes_before, steps_before, next_tick, restarted, moved_once) > 0:
        return -1
    if _some_unknown(numbers, nodes):
        return -1
    number(numbers, nodes, shape)
    copy_rows(reported, estimate)
    total = told[TOTAL].view(np.int64)
    count_interventions(intervened, restarted, decided, proposed, counts[INTERVENTIONS], told[CORRECTION])
    wrong = track(
        Ground(root, bounds[0], bounds[1], rounding, margin, has_errors),
        seen,
        shape,
        Knowledge(counts[BROKEN], marks[INSIDE], marks[CERTIFIED]),
        restarted,
        moved_once,
        decided,
        passed,
        fallback,
        marks[KNOWN],
        applied,
        estimate,
        alarm,
        reason,
    )
    for e in range(count):
        steps_before[e] = steps[e]
    for e in range(count):
        total[e] = counts[INTERVENTIONS, e]
        guaranteed[e] = reason[e] == 0
    return wrong


@inner
def _some_unknown(numbers, nodes):
    """Returns whether the shape of some node is not in the book."""
    least = 0
    for e in range(nodes.size):
        least = min(least, numbers[nodes[e]])
    return least < 0


def _compiled_follow(version, other):
    """Returns `_follow`, kept on disk for one version of everything that it calls."""

    @njit(cache=True, nogil=True)
    def follow(
        root,
        bounds,
        rounding,
        margin,
        has_errors,
        seen,
        numbers,
        nodes,
        episodes,
        steps,
        episodes_before,
        steps_before,
        next_tick,
        counts,
        marks,
        decided,
        proposed,
        intervened,
        passed,
        fallback,
        applied,
        reported,
        alarm,
        shape,
        estimate,
        reason,
        told,
        guaranteed,
    ):
        if version + other < 0:
            return -1
        return _follow(
            root,
            bounds,
            rounding,
            margin,
            has_errors,
            seen,
            numbers,
            nodes,
            episodes,
            steps,
            episodes_before,
            steps_before,
            next_tick,
            counts,
            marks,
            decided,
            proposed,
            intervened,
            passed,
            fallback,
            applied,
            reported,
            alarm,
            shape,
            estimate,
            reason,
            told,
            guaranteed,
        )

    return follow


follow = _compiled_follow(version_of(__file__, "tracking"), version_of(product.__file__))
