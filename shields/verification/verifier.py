"""The exact verification of a certificate, independent of how it was synthesized."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ncs_gym import LinearPlant
from shields.certificate import Certificate
from shields.certificate_text import labeled
from shields.errors import CertificateError
from shields.verification.certified_conditions import certified_conditions
from shields.verification.rational_matrix import Condition, flag

# Where the name of a condition says which age, or row of the polytope, it is about.
_AGE = re.compile(r"(?<=Sigma_)\d+| at age \d+| of row \d+")


@dataclass(frozen=True)
class Report:
    """The outcome of a verification.

    Of conditions that hold and differ in age or row alone, the one with the least margin is printed.

    Attributes:
        conditions: Those that were checked, in order; later ones are left out where earlier ones fail.
    """

    conditions: tuple[Condition, ...]

    @property
    def valid(self) -> bool:
        """Whether every condition holds."""
        return all(condition.holds for condition in self.conditions)

    def __str__(self) -> str:
        holding, total = sum(c.holds for c in self.conditions), len(self.conditions)
        valid = f"valid: {holding} of {total} conditions hold in exact arithmetic"
        verdict = valid if self.valid else f"not valid: {total - holding} of {total} conditions broken"
        alike: dict[str, list[Condition]] = {}
        for condition in self.conditions:
            name = _AGE.sub("", condition.name) if condition.holds else condition.name
            alike.setdefault(name, []).append(condition)
        return "\n".join([verdict, *map(_line, alike.values())])


def _line(alike: list[Condition]) -> str:
    least = min(alike, key=lambda condition: condition.margin)
    count = "" if len(alike) == 1 else f" (the least of {len(alike)})"
    return labeled(f"{'holds ' if least.holds else 'BROKEN'}  {least.margin:+.3e}  ", f"{least.name}{count}")


def verify(certificate: Certificate, plant: LinearPlant) -> Report:
    """Returns whether a certificate proves what it claims for a plant, in exact rational arithmetic.

    The conditions are those of docs/shield_proof.md, and that D, N and X0 contain what its "Setting" says. Neither
    a tolerance nor a solver nor a float decides; the margins are for people.

    Raises:
        ValueError: If an argument is of another kind.
    """
    _require_kinds(certificate, plant)
    belongs = flag("plant: the certificate belongs to it", plant.digest() == certificate.fingerprint)
    return Report((belongs, *certified_conditions(certificate, plant)))


def _require_kinds(certificate: Certificate, plant: LinearPlant) -> None:
    if not isinstance(certificate, Certificate) or not isinstance(plant, LinearPlant):
        kinds = f"{type(certificate).__name__} and {type(plant).__name__}"
        raise ValueError(f"verify takes a Certificate and a LinearPlant, got {kinds}")


# Digests of every number of certificates and plants that have been verified in this process.
_valid: set[tuple[str, str]] = set()


def require_valid(certificate: Certificate, plant: LinearPlant) -> None:
    """Raises unless a certificate verifies for a plant; what has verified in this process is not verified again.

    Raises:
        CertificateError: Naming the first condition that does not hold.
        ValueError: If an argument is of another kind.
    """
    _require_kinds(certificate, plant)
    key = certificate.checksum, plant.digest()
    if key in _valid:
        return
    broken = next((each for each in verify(certificate, plant).conditions if not each.holds), None)
    if broken is not None and broken.name.startswith("plant"):
        raise CertificateError(
            "the certificate was made for another plant, or for other times at which its box counts (fingerprints "
            "differ): synthesize one for this plant"
        )
    if broken is not None:
        raise CertificateError(
            f"the certificate does not verify: {broken.name} does not hold (margin {broken.margin:.3g})"
        )
    _valid.add(key)
