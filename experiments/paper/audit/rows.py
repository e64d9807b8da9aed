"""The rows of the audit, in order."""

from __future__ import annotations

from collections.abc import Iterator

from experiments.paper.audit.case_study import box_claim, disturbance_claim, sensor_claim
from experiments.paper.audit.claim import Claim
from experiments.paper.audit.constraints import constraint_claims, plant_claims
from experiments.paper.audit.error_bounds import error_claims
from experiments.paper.audit.feasibility import feasibility_claim
from experiments.paper.audit.invariance import invariance_claims
from experiments.paper.audit.late_packets import late_packet_claim
from experiments.paper.audit.optimum import optimum_claim
from experiments.paper.audit.theorems import equivalence_claim, margin_claim
from experiments.paper.paper_example import PaperExample


def audited_claims(example: PaperExample) -> Iterator[Claim]:
    """Yields the claims, all computed from the printed numbers; texts refer to one another by row number."""
    yield from plant_claims(example)  # rows 1 and 2
    yield from constraint_claims(example)  # rows 3 to 6
    yield from invariance_claims(example)  # rows 7 and 8
    yield from error_claims(example)  # rows 9 and 10
    yield feasibility_claim(example)  # row 11
    yield optimum_claim(example)  # row 12
    yield margin_claim(example)  # row 13
    yield equivalence_claim()  # row 14
    yield disturbance_claim(example)  # row 15
    yield late_packet_claim(example)  # row 16
    yield sensor_claim(example)  # row 17
    yield box_claim(example)  # row 18
