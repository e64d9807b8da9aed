"""Compiled tracking of proofs; the last axis of every array is the environment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from ncs_gym.compiled import entry

# Reasons why a proof does not hold; 0 while it does.
ALARM, OTHER_INPUT, OTHER_STEPS, LARGE_ERROR, FAR_OUT, UNUSABLE, NO_ERROR_SET, NOT_KNOWN_INSIDE = range(1, 9)
# Columns of what is known of an error shape: whether it is usable and lies in a certified one, the norm of the largest
# error, and half-widths, n numbers.
USABLE, CERTIFIED, LARGEST, EXTENT = range(4)


class Knowledge(NamedTuple):
    """What a batch of `ProofTracker`s remembers, shape (N,) each: code of the first break, and two flags."""

    broken: np.ndarray
    inside: np.ndarray
    certified: np.ndarray


class Ground(NamedTuple):
    """What proofs stand on.

    Attributes:
        root: G, shape (n, n).
        columns: What rounding of G x grows with, shape (n,).
        reach: How far out estimates may be, shape (n,).
        rounding: Relative.
        margin: Room that a level must have.
        has_errors: Whether the certificate has an error set.
    """

    root: np.ndarray
    columns: np.ndarray
    reach: np.ndarray
    rounding: float
    margin: float
    has_errors: bool


@entry
def number(numbers, nodes, out):
    """Fills the index in the book of each environment's error shape, shape (N,); returns the smallest, -1: unknown."""
    least = 0
    for e in range(nodes.size):
        out[e] = numbers[nodes[e]]
        least = min(least, out[e])
    return least


@entry
def compare_clocks(episodes, steps, episodes_before, steps_before, next_tick, restarted, moved_once):
    """Fills whether a new episode began, and whether an environment moved just one step (to its start, where it began).

    Args:
        episodes: Begun, by the clock now, shape (N,).
        steps: In them, shape (N,).
        episodes_before: By the clock before.
        steps_before: By the clock before.
        next_tick: Whether the vector moved once.
        restarted: Filled, shape (N,).
        moved_once: Filled, shape (N,).

    Returns:
        How many new episodes there are.
    """
    count = 0
    for e in range(steps.size):
        restarted[e] = episodes[e] != episodes_before[e]
        count += restarted[e]
    for e in range(steps.size):
        moved_once[e] = (steps[e] == steps_before[e] + 1) & next_tick
    if count > 0:
        for e in range(steps.size):
            if restarted[e]:
                moved_once[e] = steps[e] == 0 and episodes[e] == episodes_before[e] + 1 and next_tick
    return count


@entry
def track(
    ground,
    seen,
    shape,
    knowledge,
    restarted,
    moved_once,
    decided,
    passed,
    fallback,
    known,
    inputs,
    estimate,
    alarm,
    reason,
):
    """Moves the proofs of all environments one step on, as `ProofTracker` does.

    Args:
        ground: What proofs stand on.
        seen: What is known of error shapes, shape (EXTENT + n, k).
        shape: Index of each environment's, shape (N,).
        knowledge: Changed in place.
        restarted: Whether a new episode began, shape (N,).
        moved_once: Whether it moved exactly one step (none, where restarted), shape (N,).
        decided: Inputs decided, shape (m, N).
        passed: Shape (N,).
        fallback: Shape (N,).
        known: Whether all starts lie in S, shape (N,).
        inputs: Inputs reported, shape (m, N).
        estimate: x_hat, shape (n, N).
        alarm: Of the monitor, shape (N,).
        reason: Filled with codes, shape (N,).

    Returns:
        How many proofs do not hold.
    """
    fine = np.empty(reason.size, np.bool_)
    _mark_fine(knowledge.broken, restarted, moved_once, passed, alarm, fine)
    _mark_same(decided, inputs, fine)
    _mark_near(seen, shape, estimate, ground.reach, fine)
    doubtful = _mark_proved(fine, ground.has_errors, knowledge.inside, knowledge.certified, reason)
    if doubtful == 0:
        return 0
    count = 0
    for e in range(reason.size):
        if not fine[e]:
            _track_one(
                ground,
                seen[:, shape[e]],
                knowledge,
                e,
                restarted[e],
                moved_once[e],
                decided,
                passed[e],
                fallback[e],
                known[e],
                inputs,
                estimate,
                alarm[e],
                reason,
            )
            count += reason[e] != 0
    return count


@entry
def _mark_proved(fine, has_errors, inside, certified, reason):
    """Notes that the proofs marked hold, none without an error set; returns how many are not marked."""
    count = 0
    for e in range(fine.size):
        fine[e] &= has_errors
        count += not fine[e]
    for e in range(fine.size):
        inside[e] |= fine[e]
        certified[e] |= fine[e]
    for e in range(fine.size):
        reason[e] = 0
    return count


@entry
def _mark_fine(broken, restarted, moved_once, passed, alarm, fine):
    """Fills whether nothing but the estimate can be wrong, shape (N,)."""
    for e in range(fine.size):
        fine[e] = (broken[e] == 0) & (not restarted[e])
    for e in range(fine.size):
        fine[e] &= moved_once[e] & passed[e]
    for e in range(fine.size):
        fine[e] &= not alarm[e]


@entry
def _mark_same(decided, inputs, fine):
    """Clears the marks where other inputs were applied."""
    for i in range(decided.shape[0]):
        for e in range(fine.size):
            fine[e] &= decided[i, e] == inputs[i, e]


@entry
def _mark_near(seen, shape, estimate, reach, fine):
    """Clears the marks where the estimate is not finite or far out, or the error shape is not a certified one."""
    good = np.empty(fine.size)
    for e in range(fine.size):  # only usable shapes are certified
        good[e] = seen[CERTIFIED, shape[e]]
    for e in range(fine.size):
        fine[e] &= good[e] > 0.0
    for i in range(estimate.shape[0]):
        limit = reach[i]
        for e in range(fine.size):
            good[e] = seen[EXTENT + i, shape[e]]
        for e in range(fine.size):
            fine[e] &= abs(estimate[i, e]) + good[e] <= limit


@entry
def _track_one(
    ground, seen, knowledge, e, restarted, moved_once, decided, passed, fallback, known, inputs, estimate, alarm, reason
):
    """Moves the proof of environment e one step on; see `track`."""
    n, broken = ground.root.shape[0], knowledge.broken[e]
    if restarted:
        broken, inside = 0, known
    else:
        inside = passed or (knowledge.inside[e] and knowledge.certified[e] and fallback)
    if broken == 0 and not moved_once:
        broken = OTHER_STEPS
    if broken == 0 and not restarted:
        for i in range(decided.shape[0]):
            if inputs[i, e] != decided[i, e]:
                broken = OTHER_INPUT
    if broken == 0 and alarm:
        broken = ALARM
    finite, far = seen[USABLE] > 0.0, False
    for i in range(n):
        finite &= np.isfinite(estimate[i, e])
        far |= not abs(estimate[i, e]) + seen[EXTENT + i] <= ground.reach[i]
    knowledge.certified[e] = finite and seen[CERTIFIED] > 0.0
    if not finite:
        broken = UNUSABLE if broken == 0 else broken
    else:
        broken = FAR_OUT if broken == 0 and far else broken
        if not inside:
            inside = _knows_inside(ground, seen[LARGEST], estimate[:, e])
    knowledge.broken[e], knowledge.inside[e] = broken, inside
    if broken == 0 and not ground.has_errors:
        broken = NO_ERROR_SET
    if broken == 0 and not inside:
        broken = NOT_KNOWN_INSIDE
    reason[e] = LARGE_ERROR if broken == 0 and not knowledge.certified[e] else broken


@entry
def _knows_inside(ground, largest, estimate):
    """Returns whether |x_hat|_M + sqrt(lambda_max(M Sigma_k)) <= 1 - margin, which proves that x is in S."""
    level, spread = 0.0, 0.0
    for i in range(estimate.size):
        value = 0.0
        for j in range(estimate.size):
            value += ground.root[i, j] * estimate[j]
        level += value * value
        spread += ground.columns[i] * abs(estimate[i])
    return np.sqrt(level) + largest <= 1.0 - ground.margin - ground.rounding * spread


@entry
def count_interventions(intervened, decided, proposed, interventions, correction):
    """Adds interventions to the running numbers, and fills norms of corrections, shape (N,)."""
    for e in range(interventions.size):
        interventions[e] += intervened[e]
    for e in range(correction.size):
        correction[e] = 0.0
    for i in range(decided.shape[0]):
        for e in range(correction.size):
            correction[e] += (decided[i, e] - proposed[i, e]) ** 2
    for e in range(correction.size):
        correction[e] = np.sqrt(correction[e])
