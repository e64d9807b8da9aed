"""What share of the safe box an ellipsoid in it fills: less than pi/4 of a plane's, less still in more dimensions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from ncs_gym import LinearPlant, exact

# A box with more rows than states is a polytope, whose corners are too many to count in more dimensions or with more
# rows than this.
_MOST_DIMENSIONS, _MOST_ROWS = 5, 30


def share_of_box(plant: LinearPlant, L: np.ndarray) -> dict[str, Any]:
    """Returns the record, for a certificate, of the share of the safe box's volume that E(L) fills.

    Where the last states are inputs under way (`Model.with_delays`) the box is that of the
    others, and what counts is which of its states are in E(L) with no input under way.

    Args:
        plant: The plant, with its safe box.
        L: Shape of a set in the box, (n, n), positive definite.

    Returns:
        One entry, `share_of_box` or `share_of_box_at_rest`, a number in (0, 1]; none where it is not known: of flat
        sets, open boxes, limits with two ends that are no box, and boxes with too many corners.
    """
    try:
        np.linalg.cholesky(L)
    except np.linalg.LinAlgError:
        return {}
    is_box = plant.is_symmetric or (len(plant.box) == plant.n and np.isfinite(plant.box_ends).all())
    if not is_box or exact.rank(plant.box) < plant.n:
        return {}
    stored = plant.past
    if not stored:
        share = _share(plant.box, L)
        return {} if share is None else {"share_of_box": share}
    kept = plant.n - stored
    rows = plant.box[plant.box[:, :kept].any(axis=1)]
    if rows[:, kept:].any() or exact.rank(rows[:, :kept]) < kept:
        return {}
    share = _share(rows[:, :kept], np.linalg.inv(np.linalg.inv(L)[:kept, :kept]))
    return {} if share is None else {"share_of_box_at_rest": share}


def _share(C: np.ndarray, L: np.ndarray) -> float | None:
    """Returns the volume of E(L) in that of the box {|c_j x| <= 1}; None if that has too many corners."""
    n = len(L)
    # In coordinates in which E(L) is the unit ball, so that units do not matter.
    volume = _volume(C @ np.linalg.cholesky(L))
    return None if volume is None else math.pi ** (n / 2) / math.gamma(n / 2 + 1) / volume


def _volume(C: np.ndarray) -> float | None:
    """Returns the volume of {z : |c_j z| <= 1}, c_j the rows of C, (k, n); None if it has too many corners."""
    k, n = C.shape
    if k == n:  # the cube [-1, 1]^n, mapped by the inverse of C
        return 2.0**n / abs(float(np.linalg.det(C)))
    if n == 1:
        return 2.0 / float(np.abs(C).max())
    if n > _MOST_DIMENSIONS or k > _MOST_ROWS:
        return None
    sides = np.concatenate([C, -C])
    halfspaces = np.column_stack([sides, -np.ones(len(sides))])
    try:
        return float(ConvexHull(HalfspaceIntersection(halfspaces, np.zeros(n)).intersections).volume)
    except QhullError:
        return None
