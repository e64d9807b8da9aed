"""Where deviations are counted from: the point of a model, moved to where the middle of its disturbance rests."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import pushes_of
from ncs_gym.limits import LimitValues
from ncs_gym.model import residual
from ncs_gym.plants.hard_bounds import weight_of
from ncs_gym.uncertainty.ellipsoid import Ellipsoid
from ncs_gym.uncertainty.shape_matrices import outer_sum
from ncs_gym.validation import shown, warn_caller

# What is found of such a point is rounded to this, in units of the limits.
POINT_PRECISION = 1e-11


class MovedOperatingPointWarning(UserWarning):
    """A disturbance with two different ends moves the point that deviations are counted from."""


def at_rest(own: LimitValues, disturbance: Any) -> LimitValues:
    """Returns a plant counted from where it rests under E w, the middle of a disturbance: x = A x + B u + E w.

    That is the point of its model if E w = 0, else the nearest such point in units of the limits.

    Raises:
        ValueError: If no such point lies within the limits.
    """
    if not (pushes := pushes_of(disturbance)):
        return own
    E, middle = np.hstack([each for each, _ in pushes]), np.concatenate([each for _, each in pushes])
    x, u, missing = _resting(own, E, middle)
    rest = own.around(x, u)
    points = rest.operating_state, rest.operating_input
    state, applied = ([float(f"{each:.6g}") for each in point] for point in points)
    low, high = np.concatenate([rest.box_ends, rest.input_ends, rest.mixed_ends], axis=1)
    if not ((low < 0.0) & (high > 0.0)).all():
        raise ValueError(f"a disturbance rests at {shown(state)}, {shown(applied)}, not strictly within the limits")
    text = f"deviations are counted from where the middle of the disturbance rests: {shown(state)}, {shown(applied)}"
    warn_caller(text, MovedOperatingPointWarning)
    step_offset = own.step_offset + exact.product(np.abs(E), np.abs(middle))
    return rest.replaced(step_offset=step_offset, lacking=np.abs(missing) + own.lacking)


def _resting(own: LimitValues, E: np.ndarray, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns x, u, in deviations from the model's point, and A x + B u + E w - x there, which is rounding."""
    from scipy.linalg import null_space  # takes long to import

    (n, m), A, B, rows = own.B.shape, own.A, own.B, own.box
    reach = 0.5 * np.ptp(own.input_ends, axis=0)
    widths = np.sqrt(1.0 / np.diag(weight_of(rows, np.abs(E @ middle))))
    balance = np.hstack([(np.eye(n) - A) * widths, -B * reach]) / widths[:, None]
    found = np.linalg.lstsq(balance, E @ middle / widths)[0]
    directions = null_space(balance)
    sizes = np.vstack([np.hstack([rows * widths, np.zeros((len(rows), m))]), np.hstack([np.zeros((m, n)), np.eye(m)])])
    found = found - directions @ np.linalg.lstsq(sizes @ directions, sizes @ found)[0]
    x, u = widths * found[:n], reach * found[n:]
    if not residual(A, B, E, x, u, middle)[1]:
        pushed = shown((E @ middle).tolist())
        raise ValueError(f"no state stays where it is under the middle of a disturbance, {pushed} per step")
    x, u = _in_steps(x, np.abs(rows).max(axis=0)), _in_steps(u, 1.0 / reach)
    return x, u, residual(A, B, E, x, u, middle)[0]


def _in_steps(values: np.ndarray, per_limit: np.ndarray) -> np.ndarray:
    """Returns values rounded to `POINT_PRECISION` of limits, of which `per_limit` is the inverse, by powers of two.

    What LAPACK finds differs between processors in the last bits, and a point is part of what identifies a plant.
    """
    sizes = np.where(per_limit > 0.0, 1.0 / np.where(per_limit > 0.0, per_limit, 1.0), np.maximum(np.abs(values), 1e-9))
    steps = np.exp2(np.round(np.log2(POINT_PRECISION * sizes)))
    return np.rint(values / steps) * steps


def with_residual(bound: Ellipsoid, missing: np.ndarray, rows: np.ndarray) -> Ellipsoid:
    """Returns a bound of d with twice what a point lacks of an equilibrium; rows, (k, n), give the units."""
    n = len(missing)
    gram = exact.product(rows.T, rows)
    lacking = np.diag(n * np.square(2.0 * np.abs(missing)))
    return Ellipsoid(outer_sum(bound.shape_matrix, lacking, gram + np.eye(n) * np.trace(gram) / n))
