"""What shields of many environments do after a step at which no episode began, in one compiled call."""

from __future__ import annotations

import numpy as np
from ncs_gym.compiled import inner, version_of
from ncs_gym.product import copy_rows
from numba import njit

from ncs_gym import product
from shields.runtime.tracking import Ground, Knowledge, compare_clocks, count_interventions, number, track

# Rows of what is kept from step to step: whole numbers and flags.
BROKEN, INTERVENTIONS, COUNTS = range(3)
INSIDE, CERTIFIED, KNOWN, MARKS = range(4)
# Rows of what a step tells.
CORRECTION, TOTAL, TOLD = range(3)


@inner
def _follow(
    root,
    bounds,
    widest,
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
        widest: Of a `ShapeBook`.
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
        How many proofs do not hold; -1 if an episode began or a shape is not in the book: nothing but `shape` has
        changed then.
    """
    if number(numbers, nodes, shape) < 0:
        return -1
    known = has_errors and next_tick and _move_once(episodes, steps, episodes_before, steps_before)
    if known and _hold(bounds[1], widest, counts[BROKEN], decided, passed, applied, reported, alarm):
        wrong = 0
        marks[: CERTIFIED + 1] = True
        reason.fill(0)
    else:
        restarted, moved_once = np.empty(steps.size, np.bool_), np.empty(steps.size, np.bool_)
        if compare_clocks(episodes, steps, episodes_before, steps_before, next_tick, restarted, moved_once) > 0:
            return -1
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
            reported,
            alarm,
            reason,
        )
    copy_rows(reported, estimate)
    count_interventions(intervened, decided, proposed, counts[INTERVENTIONS], told[CORRECTION])
    _tell(steps, reason, counts[INTERVENTIONS], steps_before, told[TOTAL].view(np.int64), guaranteed)
    return wrong


@inner
def _move_once(episodes, steps, episodes_before, steps_before):
    """Returns whether every environment moved just one step, in the same episode."""
    others = 0
    for e in range(steps.size):
        others += (episodes[e] != episodes_before[e]) | (steps[e] != steps_before[e] + 1)
    return others == 0


@inner
def _hold(reach, widest, broken, decided, passed, applied, estimate, alarm):
    """Returns whether all proofs hold by the widest of the error shapes; if not, `track` looks at each environment."""
    doubtful = 0
    for e in range(broken.size):
        doubtful += (broken[e] != 0) | (not passed[e]) | alarm[e]
    for i in range(decided.shape[0]):
        for e in range(broken.size):
            doubtful += decided[i, e] != applied[i, e]
    for i in range(estimate.shape[0]):
        limit, width = reach[i], widest[i]
        for e in range(broken.size):
            doubtful += not abs(estimate[i, e]) + width <= limit
    return doubtful == 0


@inner
def _tell(steps, reason, interventions, steps_before, total, guaranteed):
    """Fills what a step tells, and moves the clock on."""
    for e in range(steps.size):
        steps_before[e] = steps[e]
    for e in range(steps.size):
        total[e] = interventions[e]
        guaranteed[e] = reason[e] == 0


def _compiled_follow(version, other):
    """Returns `_follow`, kept on disk for one version of everything that it calls."""

    @njit(cache=True, nogil=True)
    def follow(
        root,
        bounds,
        widest,
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
            widest,
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
