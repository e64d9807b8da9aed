"""The method of Liu et al. as printed: its bounds, optimization problem OP, Algorithm 1 and constraints.

The certified method uses nothing of it. docs/paper.md compares the printed formulas and figures with what was found.
"""

from shields.paper.certificate import PaperCertificate, verify
from shields.paper.synthesis import synthesize

__all__ = ["PaperCertificate", "synthesize", "verify"]
