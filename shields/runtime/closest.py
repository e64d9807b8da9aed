"""Compiled search for the closest input that passes the one-step test."""

from __future__ import annotations

import numpy as np
from ncs_gym.compiled import inner


@inner
def closest_on_lines(effect, reserve, limits, weight, offset, radius, wanted, closest):
    """Fills what `closest_in_space` finds for one input, shape (1, count), as `projection.closest_on_line` does.

    Args:
        effect: G B, shape (n, 1).
        reserve: Room that it must have.
        limits: u_max, shape (1,).
        weight: W of |z|^2 = z'Wz, shape (n * n, count).
        offset: G A x_hat, shape (n, count).
        radius: Of the test, shape (count,).
        wanted: Shape (1, count).
        closest: Filled where there is one, shape (1, count).
    """
    n, count = offset.shape
    a, b, c = np.zeros((3, count))
    for i in range(n):
        for j in range(n):
            first, second = effect[i, 0], effect[j, 0]
            for k in range(count):
                share = weight[i * n + j, k]
                a[k] += share * first * second
                b[k] += share * first * offset[j, k]
                c[k] += share * offset[i, k] * offset[j, k]
    limit = limits[0]
    for k in range(count):
        target = radius[k] - reserve
        square = b[k] * b[k] - a[k] * (c[k] - target * target)
        if target < 0.0 or square < 0.0:
            continue
        if a[k] <= 0.0:
            closest[0, k] = wanted[0, k] if c[k] <= target * target else np.nan
            continue
        half = np.sqrt(square)
        low, high = (-b[k] - half) / a[k], (-b[k] + half) / a[k]
        if low <= limit and high >= -limit:
            closest[0, k] = min(max(wanted[0, k], low), high)


@inner
def closest_in_space(effect, limits, weight, target, offset, wanted):
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
                q[a] += weight[i, j] * effect[i, a] * offset[j]
                for b in range(m):
                    P[a, b] += weight[i, j] * effect[i, a] * effect[j, b]
    for face in range(3**m):
        u, free, count, digits = wanted.copy(), np.empty(m, np.int64), 0, face
        for i in range(m):
            if digits % 3 == 0:
                free[count] = i
                count += 1
            else:
                u[i] = limits[i] if digits % 3 == 1 else -limits[i]
            digits //= 3
        if not _onto_ball(P, q, c, target, u, free[:count]):
            continue
        away, inside = 0.0, True
        for i in range(m):
            away += (u[i] - wanted[i]) ** 2
            inside &= abs(u[i]) <= limits[i]
        if inside and away < distance:
            best, distance = u, away
        if face == 0 and inside:
            break
    return best


@inner
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
