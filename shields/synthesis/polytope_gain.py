"""Gains whose polytope fills more of the safe box than that of the largest ellipsoid's gain."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from ncs_gym import LinearPlant
from ncs_gym.plants.lqr import lqr_gain
from shields.certificate import Certificate
from shields.synthesis.invariant_polytope import points_of_box, share_of_points

# Weights of the inputs, in units of their limits, against those of the states, in units of the box, in the
# linear-quadratic regulators that the search begins with.
_INPUT_WEIGHTS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
# The search begins with changes of a gain's entries by these shares of an input limit over a half-width of the box, in
# turn, and tries at most so many gains per entry in each.
_CHANGES, _TRIES_PER_ENTRY = (0.15, 0.08), 25
# It counts so many points of the box.
_POINTS_LOG2 = 13


def gains_of_larger_polytopes(
    certificate: Certificate,
    plant: LinearPlant,
    is_provable: Callable[[np.ndarray], bool],
    progress: Callable[[str], object],
) -> Iterator[np.ndarray]:
    """Yields gains, shape (m, n), that keep more of the safe box than a certificate's, those that keep most first.

    The search begins with regulators and the certificate's own gain, and goes on from the best of them: Nelder and
    Mead's simplex search for the entries whose polytope fills the largest share of the box. Nothing is yielded where
    that share is unknown (`points_of_box`).

    Args:
        certificate: Of method "certified", for the gain, the error sets and D.
        plant: Its plant.
        is_provable: Whether an ellipsoid is known that proves a gain; others are not taken.
        progress: Called with a line of text now and then.
    """
    points = points_of_box(plant, _POINTS_LOG2)
    if points is None:
        return

    def lost(entries: np.ndarray) -> float:
        """Returns the share of the box that a gain, its entries in one row, does not keep."""
        K = entries.reshape(plant.m, plant.n)
        kept = share_of_points(replace(certificate, K=K, polytope=None), plant, points)
        return 1.0 - kept if kept > 0.0 and is_provable(K) else 1.0

    efforts = (effort * np.diag(plant.u_max**-2.0) for effort in _INPUT_WEIGHTS)
    regulators = (lqr_gain(plant.A, plant.B, plant.weight, effort) for effort in efforts)
    gains = [K.ravel() for K in (certificate.K, *regulators) if K is not None]
    losses = [lost(entries) for entries in gains]
    best = gains[int(np.argmin(losses))]
    units = np.diag((plant.u_max[:, None] / plant.half_widths).ravel())
    for change in _CHANGES:
        progress(f"gain of the polytope: {100.0 * (1.0 - min(losses)):.1f} % of the box")
        simplex = best + change * np.concatenate([np.zeros((1, len(units))), units])
        options = {"initial_simplex": simplex, "maxfev": _TRIES_PER_ENTRY * len(units)}
        found = minimize(lost, best, method="Nelder-Mead", options=options)
        best = found.x
        gains.append(best)
        losses.append(found.fun)
    for k in np.argsort(losses, kind="stable"):
        if losses[k] < losses[0]:
            yield gains[k].reshape(plant.m, plant.n)
