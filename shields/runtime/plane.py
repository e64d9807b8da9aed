"""The one-step test for two states and one input, in plain floats: ten times faster than arrays of two numbers."""

from __future__ import annotations

from math import inf, isfinite, sqrt

from ncs_gym.uncertainty.ellipsoid import SMALLEST_SHARE
from shields.runtime.projection import closest_on_line

# With less room than this between h and 1, rounding of the weights would no longer be small against it.
SMALLEST_RADIUS = 1e-5
# An error shape may be indefinite by this share of its diagonal: rounding of flat ones.
INDEFINITE = 1e-9
# An estimate this far out, in units of S, is not worth a test (and its square overflows at 1e154).
FARTHEST = 1e100

Pair = tuple[float, float] | list[float]
# The three different entries xx, xy, yy of a symmetric matrix.
Symmetric = tuple[float, float, float]


class PlaneOutlook:
    """The same as `Outlook`, for n = 2 and m = 1.

    Args:
        offset: G A x_hat.
        effect: G B.
        weight: Of the norm of the test.
        radius: 1 - h less rounding.
        limit: u_max.
    """

    __slots__ = ("_effect", "_limit", "_offset", "_weight", "radius")

    def __init__(self, offset: Pair, effect: Pair, weight: Symmetric, radius: float, limit: float) -> None:
        self._offset, self._effect, self._weight = offset, effect, weight
        self.radius, self._limit = radius, limit

    def judge(self, u: list[float]) -> tuple[float, float]:
        """Returns room and margin of an input, [u]."""
        (ex, ey), (ox, oy), (wxx, wxy, wyy) = self._effect, self._offset, self._weight
        value = u[0]
        x, y = ox + ex * value, oy + ey * value
        square = wxx * x * x + 2.0 * wxy * x * y + wyy * y * y
        return self.radius - sqrt(abs(square)), self.radius - sqrt(x * x + y * y)

    def smallest_room(self) -> float:
        """Returns the room of the worst input within the limits."""
        return min(self.judge([-self._limit])[0], self.judge([self._limit])[0])

    def closest(self, u: list[float], reserve: float) -> list[float] | None:
        """Returns the input within the limits, [u], closest to a given one with that much room; None if none is."""
        (ex, ey), (ox, oy), (wxx, wxy, wyy) = self._effect, self._offset, self._weight
        fx, fy = wxx * ex + wxy * ey, wxy * ex + wyy * ey
        c = wxx * ox * ox + 2.0 * wxy * ox * oy + wyy * oy * oy
        found = closest_on_line(u[0], fx * ex + fy * ey, fx * ox + fy * oy, c, self.radius - reserve, self._limit)
        return None if found is None else [found]


def outlook_in_plane(
    moved: list[list[float]],
    effect: list[float],
    D: list[list[float]],
    columns: list[float],
    pushed: float,
    rounding: float,
    limit: float,
    x_hat: Pair,
    Sigma: list[Pair],
) -> PlaneOutlook | None:
    """Returns the test at an estimate, None if it cannot be computed from it; see `OneStepTest` for the formula.

    Args:
        moved: G A, 2 by 2.
        effect: G B, 2 entries.
        D: G D G', 2 by 2.
        columns: Norms of the columns of |G| |A|.
        pushed: Norm of |G| |B| times u_max.
        rounding: What a product may be off by, relative to that of absolute values.
        limit: u_max.
        x_hat: 2 entries.
        Sigma: Sigma_k, 2 by 2.
    """
    (a, b), (c, d) = moved
    x, y = x_hat
    (sxx, sxy), (syx, syy) = Sigma
    sxy = 0.5 * (sxy + syx)
    if not (isfinite(x + y + sxx + syy) and sxx >= 0.0 and syy >= 0.0):
        return None
    if not (1.0 + INDEFINITE) * sxx * syy - sxy * sxy >= 0.0:
        return None
    reach = columns[0] * abs(x) + columns[1] * abs(y)
    spread = columns[0] * sqrt(sxx) + columns[1] * sqrt(syy)
    extra = rounding * spread * spread
    pxx = a * (a * sxx + 2.0 * b * sxy) + b * b * syy + extra
    pxy = c * (a * sxx + b * sxy) + d * (a * sxy + b * syy)
    pyy = c * (c * sxx + 2.0 * d * sxy) + d * d * syy + extra
    # The trace-optimal share nu of G A Sigma A' G' / nu + G D G' / (1 - nu).
    (dxx, dxy), (_, dyy) = D
    second = sqrt(dxx + dyy)
    first = sqrt(abs(pxx + pyy))
    if first < SMALLEST_SHARE * second:
        first = SMALLEST_SHARE * second
    p, q = 1.0 + second / first, 1.0 + first / second
    pxx, pxy, pyy = p * pxx + q * dxx, p * pxy + q * dxy, p * pyy + q * dyy
    middle, half = 0.5 * (pxx + pyy), 0.5 * (pxx - pyy)
    gap = sqrt(half * half + pxy * pxy)
    if not (0.0 < middle + gap < inf and reach < FARTHEST):
        return None
    h = sqrt(middle + gap)
    radius = 1.0 - h - rounding * (reach + spread + pushed)
    if radius >= SMALLEST_RADIUS:
        # The weights are (1-h) h (h I - P)^-1: the adjugate over h minus the smaller eigenvalue.
        scale = h - middle + gap
        weight = ((h - pyy) / scale, pxy / scale, (h - pxx) / scale)
    else:
        radius, weight = (0.0 if radius > 0.0 else radius), (1.0, 0.0, 1.0)
    return PlaneOutlook((a * x + b * y, c * x + d * y), effect, weight, radius, limit)
