"""The method of Liu et al. as printed: its bounds, optimization problem OP, Algorithm 1 and constraints.

The certified method uses nothing of it. `synthesize(plant, method="paper")` finds the certificate that OP gives, and
`verify` checks OP's constraints for it; the audit of the printed case study reads the bounds. docs/paper.md compares
the printed formulas and figures with what was found.
"""

from shields.paper.bounds import (
    PaperBounds,
    PaperModel,
    covariance_bound,
    process_bound,
    safety_margin,
    state_error_bound,
    uplink_error_bound,
)
from shields.paper.conditions import paper_conditions

__all__ = [
    "PaperBounds",
    "PaperModel",
    "covariance_bound",
    "paper_conditions",
    "process_bound",
    "safety_margin",
    "state_error_bound",
    "uplink_error_bound",
]
