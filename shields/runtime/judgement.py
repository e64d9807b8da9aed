"""Compiled decisions of the batched shield; the last axis of every array is the environment."""

from __future__ import annotations

import numpy as np
from ncs_gym.compiled import entry, inner, version_of
from ncs_gym.product import add_product, copy_rows, set_product
from numba import njit

from ncs_gym import product
from shields.runtime.closest import closest_in_space, closest_on_lines
from shields.runtime.closest_pair import closest_pairs
from shields.runtime.rule import unpacked

# What became of an input; the names are those of `Decision.reason`.
SAFE, PROJECTED, FALLBACK, UNSAFE, INVALID = range(5)
# Columns of what the test needs to know of an error shape: 1 - h, what rounding grows with, whether it is usable at
# all, and W of |z|^2 = z'Wz where the radius is large enough for it, n * n numbers.
RADIUS, SPREAD, USABLE, WEIGHT = range(4)
# Rows of flags; see `Decision`.
INTERVENED, PASSED, FELL_BACK, FLAGS = range(4)


@inner
def _decide(rule, outlooks, shape, estimate, proposed, u, flags, margin, reason):
    """Decides what to apply.

    Args:
        rule: The test and the mode.
        outlooks: What is known of error shapes, shape (WEIGHT + n * n, k).
        shape: Index of each environment's, shape (N,).
        estimate: x_hat, shape (n, N).
        proposed: Inputs within the limits, shape (m, N).
        u: Filled with inputs to apply, shape (m, N).
        flags: Filled, shape (FLAGS, N).
        margin: Filled, shape (N,).
        reason: Filled with codes, shape (N,).
    """
    count = shape.size
    look, offset, reach = np.empty((outlooks.shape[0], count)), np.empty(estimate.shape), np.empty(count)
    _look_up(outlooks, shape, look)
    set_product(rule.moved, estimate, offset)
    _reach(rule.columns, estimate, reach)
    _shrink(rule.rounding, rule.pushed, rule.smallest, reach, look)
    room = np.empty(count)
    if rule.vertices.shape[0] > 0:
        worst, vertex = np.full(count, np.inf), np.empty(proposed.shape)
        for row in range(rule.vertices.shape[0]):
            for i in range(vertex.shape[0]):
                vertex[i, :] = rule.vertices[row, i]
            _judge(rule.effect, rule.smallest, look, offset, vertex, room, margin)
            worst = np.minimum(worst, room)
        _judge(rule.effect, rule.smallest, look, offset, proposed, room, margin)
        room = worst
    else:
        _judge(rule.effect, rule.smallest, look, offset, proposed, room, margin)
    copy_rows(proposed, u)
    bad = _sort_out(rule.farthest, rule.margin, look, reach, room, flags, reason)
    if bad.size > 0:
        # Only what concerns these, a column each.
        looks, offsets, reaches = _columns(look, bad), _columns(offset, bad), reach[bad]
        if rule.projects:
            closest = _closest(rule, looks, offsets, _columns(proposed, bad))
            bad, left = _replace(rule, looks, offsets, reaches, bad, closest, u, flags, margin, reason)
            looks, offsets, reaches = _columns(looks, left), _columns(offsets, left), reaches[left]
        if bad.size > 0:
            _fall_back(rule, looks, offsets, reaches, bad, _columns(estimate, bad), u, flags, margin, reason)


@inner
def _look_up(outlooks, shape, look):
    """Fills what is known of each environment's error shape, shape (columns, N)."""
    for i in range(outlooks.shape[0]):
        for e in range(shape.size):
            look[i, e] = outlooks[i, shape[e]]


@inner
def _columns(rows, some):
    """Returns some of the columns."""
    out = np.empty((rows.shape[0], some.size))
    for i in range(rows.shape[0]):
        for k in range(some.size):
            out[i, k] = rows[i, some[k]]
    return out


@inner
def _reach(columns, estimate, reach):
    """Fills what rounding grows with, shape (N,)."""
    share = columns[0]
    for e in range(reach.size):
        reach[e] = share * abs(estimate[0, e])
    for i in range(1, columns.size):
        share = columns[i]
        for e in range(reach.size):
            reach[e] += share * abs(estimate[i, e])


@inner
def _shrink(rounding, pushed, smallest, reach, look):
    """Reduces the radius of the test by rounding, to at most 0 where it is small; there |z| is plain."""
    for e in range(reach.size):
        radius = look[RADIUS, e] - rounding * (reach[e] + look[SPREAD, e] + pushed)
        look[RADIUS, e] = radius if radius >= smallest else min(radius, 0.0)


@inner
def _judge(effect, smallest, look, offset, u, room, margin):
    """Fills room and margin of inputs u, shape (m, N); see `Outlook.judge`."""
    n, count = offset.shape
    reached, plain = np.empty((n, count)), np.zeros(count)
    copy_rows(offset, reached)
    add_product(effect, u, reached)
    for e in range(count):
        room[e] = 0.0
    for i in range(n):
        for e in range(count):
            plain[e] += reached[i, e] * reached[i, e]
        for e in range(count):
            room[e] += look[WEIGHT + i * n + i, e] * reached[i, e] * reached[i, e]
        for j in range(i):
            for e in range(count):
                room[e] += 2.0 * look[WEIGHT + i * n + j, e] * reached[i, e] * reached[j, e]
    for e in range(count):
        margin[e] = look[RADIUS, e] - np.sqrt(plain[e])
    for e in range(count):
        room[e] = abs(room[e]) if look[RADIUS, e] >= smallest else plain[e]
    for e in range(count):  # together with the choice it would not run in parallel lanes
        room[e] = look[RADIUS, e] - np.sqrt(room[e])


@inner
def _sort_out(farthest, least, look, reach, room, flags, reason):
    """Fills flags and reasons as if all inputs were applied as proposed; returns the environments that need others."""
    bad, count = np.empty(reach.size, np.int64), 0
    for e in range(reach.size):
        flags[PASSED, e] = (look[USABLE, e] > 0.0) & (reach[e] < farthest) & (room[e] >= least)
    for e in range(reach.size):
        flags[INTERVENED, e] = False
        flags[FELL_BACK, e] = False
    for e in range(reach.size):
        reason[e] = SAFE
        count += not flags[PASSED, e]
    if count > 0:
        count = 0
        for e in range(reach.size):
            bad[count] = e
            count += not flags[PASSED, e]
    return bad[:count]


@inner
def _closest(rule, look, offset, wanted):
    """Returns the inputs closest to those wanted, shape (m, count), that leave some room; NaN where there is none."""
    (m, count), n = wanted.shape, offset.shape[0]
    closest, weight = np.full((m, count), np.nan), look[WEIGHT:].copy()
    for i in range(n):
        for j in range(n):
            for k in range(count):
                if look[RADIUS, k] < rule.smallest:
                    weight[i * n + j, k] = 1.0 if i == j else 0.0
    if m == 1:
        closest_on_lines(rule.effect, rule.reserve, rule.limits, weight, offset, look[RADIUS], wanted, closest)
    elif m == 2:
        closest_pairs(rule.effect, rule.reserve, rule.limits, weight, offset, look[RADIUS], wanted, closest)
    else:
        for k in range(count):
            norm, target = weight[:, k].copy().reshape(n, n), look[RADIUS, k] - rule.reserve
            found = closest_in_space(rule.effect, rule.limits, norm, target, offset[:, k], wanted[:, k].copy())
            closest[:, k] = found
    return closest


@inner
def _replace(rule, look, offset, reach, bad, tried, u, flags, margin, reason):
    """Puts inputs that are tried, shape (m, count), in the place of the bad ones where they pass.

    Returns:
        The environments that are left, and which columns they have.
    """
    count = bad.size
    room, distance, left, kept = np.empty(count), np.empty(count), np.empty(count, np.int64), 0
    for i in range(tried.shape[0]):
        for k in range(count):
            tried[i, k] = _expressible(tried[i, k], rule.limits[i])
    _judge(rule.effect, rule.smallest, look, offset, tried, room, distance)
    for k in range(count):
        e = bad[k]
        if look[USABLE, k] > 0.0 and reach[k] < rule.farthest and room[k] >= rule.margin:
            for i in range(tried.shape[0]):
                u[i, e] = tried[i, k]
            margin[e], reason[e], flags[INTERVENED, e], flags[PASSED, e] = distance[k], PROJECTED, True, True
        else:
            left[kept] = k
            kept += 1
    return bad[left[:kept]], left[:kept]


@inner
def _fall_back(rule, look, offset, reach, bad, estimate, u, flags, margin, reason):
    """Puts K x_hat in the place of the bad inputs, zero where it overflows; in mode "monitor" it only says so."""
    (m, n), count = rule.gain.shape, bad.size
    tried, finite = np.zeros((m, count)), np.ones(count, np.bool_)
    for i in range(m):
        for j in range(n):
            for k in range(count):
                tried[i, k] += rule.gain[i, j] * estimate[j, k]
        for k in range(count):
            finite[k] &= np.isfinite(tried[i, k])
    for i in range(m):
        for k in range(count):
            e = bad[k]
            tried[i, k] = _expressible(tried[i, k], rule.limits[i]) if finite[k] else 0.0
            flags[INTERVENED, e] |= tried[i, k] != u[i, e]
            tried[i, k] = u[i, e] if rule.monitors else tried[i, k]
            u[i, e] = tried[i, k]
    room, distance = np.empty(count), np.empty(count)
    _judge(rule.effect, rule.smallest, look, offset, tried, room, distance)
    for k in range(count):
        e = bad[k]
        unsafe = rule.monitors and flags[INTERVENED, e]
        flags[FELL_BACK, e] = finite[k] and not unsafe
        if look[USABLE, k] > 0.0 and reach[k] < rule.farthest:
            margin[e], flags[PASSED, e], reason[e] = distance[k], room[k] >= rule.margin, UNSAFE if unsafe else FALLBACK
        else:
            margin[e], flags[PASSED, e], reason[e] = np.nan, False, INVALID


@entry
def override(actions, intervened, inputs, limits, out):
    """Fills out with actions, shape (N, m), or what stands for inputs, shape (m, N), where the shield intervened."""
    for i in range(limits.size):
        limit = limits[i]
        for e in range(intervened.size):
            replaced = np.float32(inputs[i, e] / limit)
            out[e, i] = replaced if intervened[e] else actions[e, i]


@inner
def _expressible(value, limit):
    """Returns the nearest limit times a float32 action."""
    return limit * np.float64(np.float32(min(max(value / limit, -1.0), 1.0)))


def _compiled_decide(version, other):
    """Returns `_decide`, kept on disk for one version of everything that it calls."""

    @njit(cache=True, nogil=True)
    def decide(counts, numbers, outlooks, shape, estimate, proposed, u, flags, margin, reason):
        if version + other >= 0:
            rule = unpacked(counts, numbers)
            _decide(rule, outlooks, shape, estimate, proposed, u, flags, margin, reason)

    return decide


decide = _compiled_decide(version_of(__file__, "closest", "closest_pair", "rule"), version_of(product.__file__))
