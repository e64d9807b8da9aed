"""Whether all starts that are possible lie in the safe set, or in the safe box, in exact arithmetic."""

from __future__ import annotations

import numpy as np

from ncs_gym import Ellipsoid, LinearPlant
from shields.certificate import Certificate
from shields.verification.rational_matrix import (
    is_positive_semidefinite,
    multiply,
    quadratic,
    rational,
    subtract,
    transpose,
)


def starts_inside(certificate: Certificate, initial: Ellipsoid | np.ndarray) -> bool:
    """Returns whether all possible starts lie in S, decided in exact arithmetic.

    Args:
        certificate: Gives S = E(L).
        initial: An ellipsoid E(P), inside S exactly if L - P >= 0; or a single state, shape (n,), inside S exactly if
            [1, x'; x, L] >= 0.
    """
    L = rational(certificate.L)
    if isinstance(initial, Ellipsoid):
        return is_positive_semidefinite(subtract(L, rational(initial.shape)))
    state = rational(initial)[0]
    one = rational(np.ones(1))[0]
    return is_positive_semidefinite([one + state] + [[x, *row] for x, row in zip(state, L, strict=True)])


def starts_in_box(plant: LinearPlant, initial: Ellipsoid | np.ndarray) -> bool:
    """Returns whether all possible starts lie in the safe box, decided in exact arithmetic.

    Args:
        plant: Gives the rows c_i.
        initial: An ellipsoid E(P), in the box exactly if c_i P c_i' <= 1 for all rows; or a single state, shape (n,).
    """
    rows = rational(plant.C)
    if isinstance(initial, Ellipsoid):
        shape = rational(initial.shape)
        return all(quadratic([row], shape) <= 1 for row in rows)
    return all(abs(product) <= 1 for (product,) in multiply(rows, transpose(rational(initial))))
