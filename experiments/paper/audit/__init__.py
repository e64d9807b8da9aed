"""The audit of Liu et al.: each claim of the paper beside what its own numbers give, all computed here.

`claim` says what a row is and `rows` lists them in order; the other modules compute them, one subject each.
docs/paper.md discusses the outcome.
"""

from experiments.paper.audit.claim import Claim, Verdict, defects
from experiments.paper.audit.rows import audited_claims

__all__ = ["Claim", "Verdict", "audited_claims", "defects"]
