"""How far limited quantities get inside the safe set of a certificate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ncs_gym import Ellipsoid, LinearPlant
from ncs_gym.plants.description import row_limit
from shields.certificate import Certificate
from shields.polytope import Polytope
from shields.verification import require_valid


@dataclass(frozen=True)
class Reach:
    """How far a limited quantity gets inside the safe set, in percent of the way from the operating point to its ends.

    It is a number of a solver, for planning: nothing is proved with it.

    Attributes:
        limit: The limit in words, as `print(plant)` says it.
        low, high: Percent of the way to the low and to the high end, None for an end that is open; negative where the
            set does not get to the operating point.
    """

    limit: str
    low: float | None
    high: float | None

    def __str__(self) -> str:
        ends = [f"{0.0 + round(each, 2):.4g} %" for each in (self.low, self.high) if each is not None]
        return f"{' and '.join(dict.fromkeys(ends))} of {self.limit}"


def reach_of(certificate: Certificate, plant: LinearPlant) -> tuple[Reach, ...]:
    """Returns how far each quantity that the safe box limits gets inside the safe set, by its support along the row.

    Args:
        certificate: Verified exactly here.
        plant: The plant it was made for.

    Raises:
        CertificateError: If the certificate does not verify for the plant.
        ValueError: If an argument is of another kind, or a solver fails.
    """
    require_valid(certificate, plant)
    return reach_in(certificate.safe_set, plant)


def reach_in(safe_set: Ellipsoid | Polytope, plant: LinearPlant) -> tuple[Reach, ...]:
    """Returns what `reach_of` does, of any set inside the safe box.

    Raises:
        ValueError: If a solver fails.
    """

    def percent(row: np.ndarray, end: float) -> float | None:
        if not np.isfinite(end):
            return None
        return 100.0 * float(safe_set.support(np.sign(end) * row)) / abs(end)

    return tuple(
        Reach(row_limit(plant, j), *(percent(plant.box[j], end) for end in plant.box_ends[:, j].tolist()))
        for j in np.flatnonzero(~plant.is_past_row).tolist()
    )
