"""A second verifier by another route, on python-flint: what it and the first agree on, no slip of either decides.

It states every condition anew, with denominators multiplied out, decides definiteness by the signs of characteristic
polynomials and chi-square quantiles in ball arithmetic; with the first it shares the reading of certificates alone.
"""

from collections.abc import Iterator

from ncs_gym import LinearPlant
from shields.certificate import Certificate
from shields.verification.conditions import Condition
from shields.verification.flint.certified import certified_conditions
from shields.verification.flint.exact import is_so
from shields.verification.flint.paper import paper_conditions

__all__ = ["flint_conditions"]


def flint_conditions(certificate: Certificate, plant: LinearPlant) -> Iterator[Condition]:
    """Yields every condition of a certificate of either method, judged without the code of the first engine."""
    yield is_so("plant: the certificate belongs to it", plant.fingerprint == certificate.fingerprint)
    yield from (paper_conditions if certificate.method == "paper" else certified_conditions)(certificate, plant)
