"""A second verifier by another route, on python-flint: what it and the product's agree on, no slip of either decides.

It states every condition anew, with denominators multiplied out, decides definiteness by the signs of characteristic
polynomials and chi-square quantiles in ball arithmetic; with the first it shares the reading of certificates alone.
"""

from collections.abc import Iterator

from ncs_gym import LinearPlant
from shields import Certificate, Report
from shields.paper import PaperCertificate
from shields.verification.rational_matrix import Condition
from tests.second_verifier.certified import certified_conditions
from tests.second_verifier.exact import is_so
from tests.second_verifier.paper import paper_conditions


def verify_again(certificate: Certificate | PaperCertificate, plant: LinearPlant) -> Report:
    """What `shields.verify` or `shields.paper.verify` returns, judged without its code."""
    return Report(tuple(_conditions(certificate, plant)))


def _conditions(certificate: Certificate | PaperCertificate, plant: LinearPlant) -> Iterator[Condition]:
    yield is_so("plant: the certificate belongs to it", plant.digest() == certificate.fingerprint)
    if isinstance(certificate, PaperCertificate):
        yield from paper_conditions(certificate, plant)
    else:
        yield from certified_conditions(certificate, plant)
