"""What network a plant needs: under which contracts a certificate exists, and how much of the safe box it keeps.

A certificate depends on a network only through its contract: the largest age of the newest sample, and the resolution
of its values (the quantization step).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ncs_gym import ChannelContract, LinearPlant
from ncs_gym.network.channel import MAX_AGE
from ncs_gym.validation import as_count, as_number
from shields.certificate import Certificate
from shields.errors import Infeasible
from shields.synthesis.certification import Search, first_certificate
from shields.synthesis.invariant_polytope import Progress

# Ages that are asked about by default [steps].
AGES = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32)


@dataclass(frozen=True, eq=False, kw_only=True)
class Requirements:
    """A table of contracts, each with a verified certificate or None.

    None does not prove that there is no certificate. The table is monotone: a contract that promises more than another
    one keeps at least its share.

    Attributes:
        ages: Largest ages of the newest sample when an input takes effect [steps], ascending.
        resolutions: Quantization steps, in the units of y, ascending.
        certificates: By age and resolution.
    """

    ages: tuple[int, ...]
    resolutions: tuple[float, ...]
    certificates: tuple[tuple[Certificate | None, ...], ...]

    def certificate(self, max_age: int, quantization_step: float = 0.0) -> Certificate | None:
        """Returns the certificate of a contract that was asked about; None if none was found.

        Raises:
            ValueError: If it was not asked about.
        """
        if max_age not in self.ages or quantization_step not in self.resolutions:
            raise ValueError(f"ages {self.ages} and resolutions {self.resolutions} were asked about")
        return self.certificates[self.ages.index(max_age)][self.resolutions.index(quantization_step)]

    def largest_age(self, quantization_step: float = 0.0) -> int | None:
        """Returns the largest age with a certificate, of those asked about; None if there is none."""
        return max((age for age in self.ages if self.certificate(age, quantization_step)), default=None)

    @property
    def cells(self) -> list[list[str]]:
        """The table as texts, header first: shares of the safe box [%], "yes" where not known, "-" for none."""
        header = ["max_age [steps]", *(f"{step:g}" for step in self.resolutions)]
        rows = zip(self.ages, self.certificates, strict=True)
        return [header, *([str(age), *map(_cell, found)] for age, found in rows)]

    @property
    def document(self) -> dict[str, Any]:
        """All of it as JSON values, without the certificates."""
        return {
            "ages": list(self.ages),
            "resolutions": list(self.resolutions),
            "shares": [[each and share_of(each) for each in row] for row in self.certificates],
            "certificates": [[each and each.checksum for each in row] for row in self.certificates],
        }


def share_of(certificate: Certificate) -> float | None:
    """Returns how much of the safe box the safe set fills; None if that is not known."""
    names = ("share_of_box", "share_of_box_at_rest", "volume_of_box_ellipsoid")
    return next((float(certificate.provenance[name]) for name in names if name in certificate.provenance), None)


def _cell(certificate: Certificate | None) -> str:
    if certificate is None:
        return "-"
    share = share_of(certificate)
    return "yes" if share is None else f"{100.0 * share:.3g}"


@np.errstate(all="ignore")
def requirements(
    plant: LinearPlant,
    *,
    ages: Sequence[int] = AGES,
    resolutions: Sequence[float] = (0.0,),
    progress: Progress = lambda line: None,
) -> Requirements:
    """Returns under which contracts a plant has a certificate, each of them verified.

    Each is sought as `synthesize` does, without a polytope around an ellipsoid. A contract that promises less than one
    for which none was found is not tried, and one that promises more has at least the share of the others.

    Args:
        plant: The plant with its bounds.
        ages: Largest ages of the newest sample [steps]; the steps by which inputs are late count, too.
        resolutions: Quantization steps, in the units of y; 0 for none.
        progress: Called with a line of text now and then.

    Raises:
        ValueError: If there is no age or resolution, one is given twice, or one is out of range.
    """
    if not isinstance(plant, LinearPlant):
        raise ValueError(f"plant must be a LinearPlant, got {type(plant).__name__}")
    asked = sorted(as_count(each, "an age", low=0, high=MAX_AGE) for each in ages)
    steps = sorted(as_number(each, "a resolution", low=0.0) for each in resolutions)
    for name, values in {"ages": asked, "resolutions": steps}.items():
        if not values or len(set(values)) != len(values):
            raise ValueError(f"{name} must be different values, at least one")
    found: list[list[Certificate | None]] = [[None] * len(steps) for _ in asked]
    for j, step in enumerate(steps):
        for i, age in enumerate(asked):
            if j and found[i][j - 1] is None:
                break
            progress(f"max_age {age}, resolution {step:g}")
            try:
                found[i][j] = first_certificate(plant, ChannelContract(age, step), Search(progress))
            except Infeasible:
                break
    for i in reversed(range(len(asked))):  # a certificate is one of every contract that promises more
        for j in reversed(range(len(steps))):
            stricter = (*(row[j] for row in found[i + 1 : i + 2]), *found[i][j + 1 : j + 2])
            certified = [each for each in (found[i][j], *stricter) if each is not None]
            found[i][j] = max(certified, key=lambda each: share_of(each) or 0.0, default=None)
    return Requirements(ages=tuple(asked), resolutions=tuple(steps), certificates=tuple(map(tuple, found)))
