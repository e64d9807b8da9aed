"""Compiled inner loops of the batched shield; the last axis of every array is the environment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

# What became of an input; the names are those of `Decision.reason`.
SAFE, PROJECTED, FALLBACK, UNSAFE, INVALID = range(5)


class Outlooks(NamedTuple):
    """What the one-step test needs to know of error shapes, by their index.

    Attributes:
        weight: W of |z|^2 = z'Wz where the radius is large enough for it, shape (k, n, n).
        radius: 1 - h, shape (k,).
        spread: What rounding grows with, shape (k,).
        usable: Whether the shape is one, shape (k,).
    """

    weight: np.ndarray
    radius: np.ndarray
    spread: np.ndarray
    usable: np.ndarray


class Rule(NamedTuple):
    """The test and the mode as loops need them.

    Attributes:
        moved: G A, shape (n, n).
        effect: G B, shape (n, m).
        columns: Of the bound on rounding, shape (n,).
        gain: K, shape (m, n).
        limits: u_max, shape (m,).
        vertices: Of the input box, shape (2^m, m); empty but in mode "boundary".
        pushed: What rounding grows with.
        rounding: Relative.
        margin: Room that an input must have.
        reserve: Room that a projected input must have.
        farthest: Estimates beyond this reach are unusable.
        smallest: Smallest radius with weights.
        monitors: Mode "monitor".
        projects: Mode "project".
    """

    moved: np.ndarray
    effect: np.ndarray
    columns: np.ndarray
    gain: np.ndarray
    limits: np.ndarray
    vertices: np.ndarray
    pushed: float
    rounding: float
    margin: float
    reserve: float
    farthest: float
    smallest: float
    monitors: bool
    projects: bool


class Knowledge(NamedTuple):
    """What a batch of `ProofTracker`s remembers, shape (N,) each: code of the first break, and two flags."""

    broken: np.ndarray
    inside: np.ndarray
    certified: np.ndarray


# Indices of the reasons why a proof does not hold; 0 while it does.
ALARM, OTHER_INPUT, OTHER_STEPS, LARGE_ERROR, FAR_OUT, UNUSABLE, NO_ERROR_SET, NOT_KNOWN_INSIDE = range(1, 9)


@njit(cache=True, nogil=True)
def track(knowledge, restarted, moved_once, decided, passed, fallback, known, inputs, estimate, alarm, facts, reason):
    """Moves the proofs of all environments one step on, as `ProofTracker` does.

    Args:
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
        facts: What is known of error shapes: their index by environment, whether usable and certified, half-widths and
            largest norm by index; G, its columns, rounding, margin, the reach of estimates, and whether the certificate
            has an error set.
        reason: Filled with codes, shape (N,).
    """
    shape, usable, certified, extent, largest, root, columns, rounding, margin, reach, has_errors = facts
    n = root.shape[0]
    for e in range(reason.size):
        k, broken = shape[e], knowledge.broken[e]
        if restarted[e]:
            broken, inside = 0, known[e]
        else:
            inside = passed[e] or (knowledge.inside[e] and knowledge.certified[e] and fallback[e])
        if broken == 0 and not moved_once[e]:
            broken = OTHER_STEPS
        if broken == 0 and not restarted[e]:
            for i in range(decided.shape[0]):
                if inputs[i, e] != decided[i, e]:
                    broken = OTHER_INPUT
        if broken == 0 and alarm[e]:
            broken = ALARM
        finite, far = usable[k], False
        for i in range(n):
            finite &= np.isfinite(estimate[i, e])
            far |= not abs(estimate[i, e]) + extent[k, i] <= reach[i]
        knowledge.certified[e] = finite and certified[k]
        if not finite:
            broken = UNUSABLE if broken == 0 else broken
        else:
            broken = FAR_OUT if broken == 0 and far else broken
            if not inside:
                level, spread = 0.0, 0.0
                for i in range(n):
                    value = 0.0
                    for j in range(n):
                        value += root[i, j] * estimate[j, e]
                    level += value * value
                    spread += columns[i] * abs(estimate[i, e])
                inside = np.sqrt(level) + largest[k] <= 1.0 - margin - rounding * spread
        knowledge.broken[e], knowledge.inside[e] = broken, inside
        if broken == 0 and not has_errors:
            broken = NO_ERROR_SET
        if broken == 0 and not inside:
            broken = NOT_KNOWN_INSIDE
        reason[e] = LARGE_ERROR if broken == 0 and not knowledge.certified[e] else broken


@njit(cache=True, nogil=True)
def decide(rule, outlooks, shape, estimate, proposed, u, intervened, passed, fallback, margin, reason):
    """Decides what to apply.

    Args:
        rule: The test and the mode.
        outlooks: By error shape.
        shape: Index of each environment's, shape (N,).
        estimate: x_hat, shape (n, N).
        proposed: Inputs within the limits, shape (m, N).
        u: Filled with inputs to apply, shape (m, N).
        intervened: Filled, shape (N,); see `Decision`.
        passed: Filled, shape (N,).
        fallback: Filled, shape (N,).
        margin: Filled, shape (N,).
        reason: Filled with codes, shape (N,).
    """
    offset, radius, reach = _offsets(rule, outlooks, shape, estimate)
    if rule.vertices.shape[0] == 0:
        room = _rooms(rule, outlooks, shape, offset, radius, proposed, margin)
    else:
        room = np.full(shape.size, np.inf)
        for row in range(rule.vertices.shape[0]):
            vertex = np.empty_like(proposed)
            for i in range(vertex.shape[0]):
                vertex[i] = rule.vertices[row, i]
            room = np.minimum(room, _rooms(rule, outlooks, shape, offset, radius, vertex, margin))
        _rooms(rule, outlooks, shape, offset, radius, proposed, margin)
    u[:] = proposed
    bad, count = np.empty(shape.size, np.int64), 0
    for e in range(shape.size):
        passed[e] = outlooks.usable[shape[e]] and reach[e] < rule.farthest and room[e] >= rule.margin
        intervened[e], fallback[e], reason[e] = False, False, SAFE
        bad[count] = e
        count += not passed[e]
    bad = bad[:count]
    if rule.projects and count > 0:
        closest = np.full((u.shape[0], count), np.nan)
        if u.shape[0] == 1:
            _closest_on_lines(rule, outlooks, shape, offset, radius, proposed, bad, closest)
        else:
            for k in range(count):
                e = bad[k]
                norm = outlooks.weight[shape[e]] if radius[e] >= rule.smallest else np.eye(offset.shape[0])
                closest[:, k] = _closest(rule, norm, radius[e] - rule.reserve, offset[:, e], proposed[:, e].copy())
        bad = _replace(
            rule, outlooks, shape, offset, radius, reach, bad, closest, u, intervened, passed, margin, reason
        )
    if bad.size > 0:
        _fall_back(
            rule, outlooks, shape, estimate, offset, radius, reach, bad, u, intervened, passed, fallback, margin, reason
        )


@njit(cache=True, nogil=True)
def _replace(rule, outlooks, shape, offset, radius, reach, bad, closest, u, intervened, passed, margin, reason):
    """Puts the closest inputs, shape (m, count), in the place of the bad ones where they pass; returns the rest."""
    tried = np.empty_like(closest)
    for i in range(tried.shape[0]):
        for k in range(bad.size):
            tried[i, k] = _expressible(closest[i, k], rule.limits[i])
    room, distance = _rooms_of(rule, outlooks, shape, offset, radius, bad, tried)
    left = 0
    for k in range(bad.size):
        e = bad[k]
        if outlooks.usable[shape[e]] and reach[e] < rule.farthest and room[k] >= rule.margin:
            for i in range(tried.shape[0]):
                u[i, e] = tried[i, k]
            margin[e], reason[e], intervened[e], passed[e] = distance[k], PROJECTED, True, True
        else:
            bad[left] = e
            left += 1
    return bad[:left]


@njit(cache=True, nogil=True)
def _fall_back(
    rule, outlooks, shape, estimate, offset, radius, reach, bad, u, intervened, passed, fallback, margin, reason
):
    """Puts K x_hat in the place of the bad inputs, zero where it overflows; in mode "monitor" it only says so."""
    (m, n), count = rule.gain.shape, bad.size
    tried, finite = np.zeros((m, count)), np.ones(count, np.bool_)
    for i in range(m):
        for j in range(n):
            for k in range(count):
                tried[i, k] += rule.gain[i, j] * estimate[j, bad[k]]
        for k in range(count):
            finite[k] &= np.isfinite(tried[i, k])
    for i in range(m):
        for k in range(count):
            e = bad[k]
            tried[i, k] = _expressible(tried[i, k], rule.limits[i]) if finite[k] else 0.0
            intervened[e] |= tried[i, k] != u[i, e]
            tried[i, k] = u[i, e] if rule.monitors else tried[i, k]
            u[i, e] = tried[i, k]
    room, distance = _rooms_of(rule, outlooks, shape, offset, radius, bad, tried)
    for k in range(count):
        e = bad[k]
        unsafe = rule.monitors and intervened[e]
        fallback[e] = finite[k] and not unsafe
        if outlooks.usable[shape[e]] and reach[e] < rule.farthest:
            margin[e], passed[e], reason[e] = distance[k], room[k] >= rule.margin, UNSAFE if unsafe else FALLBACK
        else:
            margin[e], passed[e], reason[e] = np.nan, False, INVALID


@njit(cache=True, nogil=True)
def _rooms_of(rule, outlooks, shape, offset, radius, some, u):
    """Returns room and margin of inputs u, shape (m, count), in some of the environments."""
    margin = np.empty(some.size)
    return _rooms(rule, outlooks, shape[some], offset[:, some], radius[some], u, margin), margin


@njit(cache=True, nogil=True)
def _offsets(rule, outlooks, shape, estimate):
    """Returns G A x_hat, shape (n, N), the radius of the test and what rounding grows with, shape (N,) each."""
    n, N = estimate.shape
    offset, reach, radius = np.zeros((n, N)), np.zeros(N), np.empty(N)
    for i in range(n):
        for j in range(n):
            for e in range(N):
                offset[i, e] += rule.moved[i, j] * estimate[j, e]
        for e in range(N):
            reach[e] += rule.columns[i] * abs(estimate[i, e])
    for e in range(N):
        k = shape[e]
        radius[e] = outlooks.radius[k] - rule.rounding * (reach[e] + outlooks.spread[k] + rule.pushed)
        if radius[e] < rule.smallest:
            radius[e] = min(radius[e], 0.0)
    return offset, radius, reach


@njit(cache=True, nogil=True)
def _rooms(rule, outlooks, shape, offset, radius, u, margin):
    """Returns the room of each input u, shape (m, N), and fills the margin; see `Outlook.judge`."""
    n, N = offset.shape
    reached, square, plain = offset.copy(), np.zeros(N), np.zeros(N)
    for i in range(n):
        for j in range(u.shape[0]):
            for e in range(N):
                reached[i, e] += rule.effect[i, j] * u[j, e]
        for e in range(N):
            plain[e] += reached[i, e] * reached[i, e]
    for i in range(n):
        for e in range(N):
            square[e] += outlooks.weight[shape[e], i, i] * reached[i, e] * reached[i, e]
        for j in range(i):
            for e in range(N):
                square[e] += 2.0 * outlooks.weight[shape[e], i, j] * reached[i, e] * reached[j, e]
    for e in range(N):
        margin[e] = radius[e] - np.sqrt(plain[e])
        square[e] = radius[e] - np.sqrt(abs(square[e] if radius[e] >= rule.smallest else plain[e]))
    return square


@njit(cache=True, nogil=True, inline="always")
def _expressible(value, limit):
    """Returns the nearest limit times a float32 action."""
    return limit * np.float64(np.float32(min(max(value / limit, -1.0), 1.0)))


@njit(cache=True, nogil=True)
def _closest_on_lines(rule, outlooks, shape, offset, radius, proposed, bad, closest):
    """Fills what `_closest` finds for one input, shape (1, count), as `projection.closest_on_line` does."""
    a, b, c = np.zeros((3, bad.size))
    for i in range(offset.shape[0]):
        for j in range(offset.shape[0]):
            first, second = rule.effect[i, 0], rule.effect[j, 0]
            for k in range(bad.size):
                e = bad[k]
                plain = 1.0 if i == j else 0.0
                share = outlooks.weight[shape[e], i, j] if radius[e] >= rule.smallest else plain
                a[k] += share * first * second
                b[k] += share * first * offset[j, e]
                c[k] += share * offset[i, e] * offset[j, e]
    limit = rule.limits[0]
    for k in range(bad.size):
        wanted, target = proposed[0, bad[k]], radius[bad[k]] - rule.reserve
        square = b[k] * b[k] - a[k] * (c[k] - target * target)
        if target < 0.0 or square < 0.0:
            continue
        if a[k] <= 0.0:
            closest[0, k] = wanted if c[k] <= target * target else np.nan
            continue
        half = np.sqrt(square)
        low, high = (-b[k] - half) / a[k], (-b[k] + half) / a[k]
        if low <= limit and high >= -limit:
            closest[0, k] = low if wanted < low else high if wanted > high else wanted


@njit(cache=True, nogil=True)
def _closest(rule, weight, target, offset, wanted):
    """Returns the input within the limits, shape (m,), closest to `wanted` with norm at most `target`; NaN if none is.

    It is the closest without limits on some face of the box of inputs, so every face is tried (3^m, few inputs); a face
    on which even that is farther than the best found needs no look at limits.
    """
    m = wanted.size
    best, distance = np.full(m, np.nan), np.inf
    if target < 0.0:
        return best
    # With z = offset + effect u, z'Wz = u'Pu + 2 q'u + c.
    P, q, c = np.zeros((m, m)), np.zeros(m), 0.0
    for i in range(offset.size):
        for j in range(offset.size):
            c += weight[i, j] * offset[i] * offset[j]
            for a in range(m):
                q[a] += weight[i, j] * rule.effect[i, a] * offset[j]
                for b in range(m):
                    P[a, b] += weight[i, j] * rule.effect[i, a] * rule.effect[j, b]
    for face in range(3**m):
        u, free, count, digits = wanted.copy(), np.empty(m, np.int64), 0, face
        for i in range(m):
            if digits % 3 == 0:
                free[count] = i
                count += 1
            else:
                u[i] = rule.limits[i] if digits % 3 == 1 else -rule.limits[i]
            digits //= 3
        if not _onto_ball(P, q, c, target, u, free[:count]):
            continue
        away, inside = 0.0, True
        for i in range(m):
            away += (u[i] - wanted[i]) ** 2
            inside &= abs(u[i]) <= rule.limits[i]
        if inside and away < distance:
            best, distance = u, away
        if face == 0 and inside:
            break
    return best


@njit(cache=True, nogil=True)
def _onto_ball(P, q, c, target, u, free):
    """Moves the free entries of u to the closest point with u'Pu + 2 q'u + c <= target^2; returns whether there is one.

    In the axes of the free block of P the minimizer for multiplier t is (w_i - t b_i) / (1 + t s_i); t is found by
    Newton's method as in `projection`, the square root of the excess against its reciprocal.
    """
    count, m = free.size, u.size
    slope, level = np.empty(count), c
    for i in range(m):
        fixed = True
        for k in range(count):
            fixed &= free[k] != i
        if fixed:
            level += 2.0 * q[i] * u[i]
            for j in range(m):
                held = True
                for k in range(count):
                    held &= free[k] != j
                if held:
                    level += P[i, j] * u[i] * u[j]
    block = np.empty((count, count))
    for a in range(count):
        slope[a] = q[free[a]]
        for j in range(m):
            held = True
            for k in range(count):
                held &= free[k] != j
            if held:
                slope[a] += P[free[a], j] * u[j]
        for b in range(count):
            block[a, b] = P[free[a], free[b]]
    value = level
    for a in range(count):
        value += 2.0 * slope[a] * u[free[a]]
        for b in range(count):
            value += block[a, b] * u[free[a]] * u[free[b]]
    if value <= target * target:
        return True
    if count == 0:
        return False
    if count == 1:
        values, axes = np.array([block[0, 0]]), np.ones((1, 1))
    else:
        values, axes = np.linalg.eigh(block)
    flat = 1e-26 * values[-1]
    away, least = np.zeros(count), level
    for a in range(count):
        tilt = start = 0.0
        for b in range(count):
            tilt += axes[b, a] * slope[b]
            start += axes[b, a] * u[free[b]]
        if values[a] > flat:
            least -= tilt * tilt / values[a]
            away[a] = start + tilt / values[a]
        else:
            values[a] = 0.0
    reach = target * target - least
    if reach < 0.0 or values[-1] <= 0.0:
        return False
    multiplier = 0.0
    for _ in range(60):
        excess = change = 0.0
        for a in range(count):
            share = 1.0 / (1.0 + multiplier * values[a])
            part = values[a] * (away[a] * share) ** 2
            excess += part
            change += part * values[a] * share
        if excess <= reach * (1.0 + 1e-12) or change <= 0.0:
            break
        multiplier += excess / change * (np.sqrt(excess / reach) - 1.0) if reach > 0.0 else 1e300
    for b in range(count):
        for a in range(count):
            u[free[b]] += axes[b, a] * (away[a] / (1.0 + multiplier * values[a]) - away[a])
    return True
