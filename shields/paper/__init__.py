"""The method of Liu et al. as printed: its bounds, optimization problem OP, Algorithm 1 and constraints.

The certified method uses nothing of it. `synthesize` finds the certificate that OP gives, and `verify` checks OP's
constraints for it; the audit of the printed case study reads the bounds. docs/paper.md compares
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
from shields.paper.certificate import PaperCertificate
from shields.paper.conditions import verify
from shields.paper.synthesis import synthesize

__all__ = [
    "PaperBounds",
    "PaperCertificate",
    "PaperModel",
    "covariance_bound",
    "process_bound",
    "safety_margin",
    "state_error_bound",
    "synthesize",
    "uplink_error_bound",
    "verify",
]
