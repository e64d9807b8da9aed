"""Compiled search for the closest pair of inputs that passes the one-step test."""

from __future__ import annotations

import numpy as np
from ncs_gym.compiled import inner

# Newton steps on the multiplier; about five are needed.
NEWTON_STEPS = 60


@inner
def closest_pairs(effect, reserve, limits, weight, offset, radius, wanted, closest):
    """Fills what `closest_in_space` finds for two inputs, shape (2, count).

    Where the closest pair without limits is beyond some of them, at least one of those is attained at the closest pair
    within all (see `projection.closest_admissible`): it lies on one of at most two edges of the box. Not on both: if
    points of both passed, so would the corner between them, closer to what is wanted than the pair without limits.
    Where G B and G A x_hat are 1e7 times the radius, rounding may hide a pair that exists.

    Args:
        effect: G B, shape (n, 2).
        reserve: Room that it must have.
        limits: u_max, shape (2,).
        weight: W of |z|^2 = z'Wz, shape (n * n, count).
        offset: G A x_hat, shape (n, count).
        radius: Of the test, shape (count,).
        wanted: Shape (2, count).
        closest: Filled where there is one, shape (2, count).
    """
    count = radius.size
    forms = np.zeros((6, count))
    _fill_forms(effect, weight, offset, forms)
    for k in range(count):
        target = radius[k] - reserve
        if target < 0.0:
            continue
        a, b, d, f, g, c = forms[0, k], forms[1, k], forms[2, k], forms[3, k], forms[4, k], forms[5, k]
        x, y, level = wanted[0, k], wanted[1, k], target * target
        found, first, second = _onto_ellipse(a, b, d, f, g, c, level, x, y)
        if not found:
            continue
        if abs(first) <= limits[0] and abs(second) <= limits[1]:
            closest[0, k], closest[1, k] = first, second
            continue
        if abs(first) > limits[0]:
            held = np.copysign(limits[0], first)
            other = _on_edge(d, g + b * held, c + (2.0 * f + a * held) * held, level, limits[1], y)
            if np.isfinite(other):
                closest[0, k], closest[1, k] = held, other
        if abs(second) > limits[1]:
            held = np.copysign(limits[1], second)
            other = _on_edge(a, f + b * held, c + (2.0 * g + d * held) * held, level, limits[0], x)
            if np.isfinite(other):
                closest[0, k], closest[1, k] = other, held


@inner
def _fill_forms(effect, weight, offset, forms):
    """Adds to the rows of forms, shape (6, count), a, b, d, f, g and c of a quadratic form of pairs of inputs.

    |offset + effect (x, y)|^2 = a x^2 + 2 b x y + d y^2 + 2 f x + 2 g y + c.
    """
    n = offset.shape[0]
    for i in range(n):
        for j in range(n):
            one, both = effect[i, 0] * effect[j, 0], effect[i, 0] * effect[j, 1]
            other, first, second = effect[i, 1] * effect[j, 1], effect[i, 0], effect[i, 1]
            for k in range(offset.shape[1]):
                share = weight[i * n + j, k]
                forms[0, k] += share * one
                forms[1, k] += share * both
                forms[2, k] += share * other
            for k in range(offset.shape[1]):
                pull = weight[i * n + j, k] * offset[j, k]
                forms[3, k] += first * pull
                forms[4, k] += second * pull
                forms[5, k] += pull * offset[i, k]


@inner
def _on_edge(a, b, c, level, limit, wanted):
    """Returns the u closest to `wanted` with a u^2 + 2 b u + c <= level and |u| <= limit; NaN if there is none."""
    square = b * b - a * (c - level)
    if a <= 0.0:
        return min(max(wanted, -limit), limit) if c <= level else np.nan
    if square < 0.0:
        return np.nan
    half = np.sqrt(square)
    low, high = max((-b - half) / a, -limit), min((-b + half) / a, limit)
    return min(max(wanted, low), high) if low <= high else np.nan


@inner
def _onto_ellipse(a, b, d, f, g, c, level, x, y):
    """Returns whether a quadratic form is at most `level` anywhere, and the pair closest to (x, y) where it is.

    As `closest._onto_ball` does: in the axes of the form the minimizer for multiplier t is (w_i - t q_i) / (1 + t s_i).
    """
    if (a * x + 2.0 * (b * y + f)) * x + (d * y + 2.0 * g) * y + c <= level:
        return True, x, y
    slope = 0.0
    if b != 0.0:
        twist = (d - a) / (2.0 * b)
        slope = np.copysign(1.0, twist) / (abs(twist) + np.sqrt(1.0 + twist * twist))
    cosine = 1.0 / np.sqrt(1.0 + slope * slope)
    sine, one, other = slope * cosine, a - slope * b, d + slope * b
    flat, least, away, off = 1e-26 * max(one, other), c, 0.0, 0.0
    if one > flat:
        pull = (cosine * f - sine * g) / one
        least, away = least - pull * pull * one, cosine * x - sine * y + pull
    if other > flat:
        pull = (sine * f + cosine * g) / other
        least, off = least - pull * pull * other, sine * x + cosine * y + pull
    one, other, reach = max(one, 0.0), max(other, 0.0), level - least
    if reach < 0.0 or max(one, other) <= 0.0:
        return False, x, y
    multiplier = 0.0
    for _ in range(NEWTON_STEPS):
        share, rest = 1.0 / (1.0 + multiplier * one), 1.0 / (1.0 + multiplier * other)
        part, remainder = one * (away * share) ** 2, other * (off * rest) ** 2
        excess, change = part + remainder, part * one * share + remainder * other * rest
        if excess <= reach * (1.0 + 1e-12) or change <= 0.0:
            break
        multiplier += excess / change * (np.sqrt(excess / reach) - 1.0) if reach > 0.0 else 1e300
    move = away / (1.0 + multiplier * one) - away
    shift = off / (1.0 + multiplier * other) - off
    return True, x + cosine * move + sine * shift, y - sine * move + cosine * shift
