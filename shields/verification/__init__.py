"""Exact verification of certificates: every condition is decided in rational arithmetic, without a solver.

`verify` reports all conditions of a certificate with their margins; `require_valid` raises at the first that fails.
Every float is a dyadic rational, so `rational_matrix` evaluates a condition without rounding; `certified_conditions`
states the conditions of docs/shield_proof.md, "Conditions".
"""

from shields.verification.rational_matrix import ACTION_ROUNDING, Condition
from shields.verification.verifier import Report, require_valid, verify

__all__ = ["ACTION_ROUNDING", "Condition", "Report", "require_valid", "verify"]
