"""Robust safety invariant sets, their exact verification, and shields made of them."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from shields.certificate import Certificate, CertificateError, Multipliers
from shields.errors import Infeasible
from shields.runtime import Decision, SafetyFilter, SafetyShield, VectorSafetyShield
from shields.verification.conditions import Condition
from shields.verification.verify import Report, verify

if TYPE_CHECKING:
    from shields.synthesis.synthesize import certify, synthesize

__all__ = [
    "Certificate",
    "CertificateError",
    "Condition",
    "Decision",
    "Infeasible",
    "Multipliers",
    "Report",
    "SafetyFilter",
    "SafetyShield",
    "VectorSafetyShield",
    "certify",
    "synthesize",
    "verify",
]


# Imported when they are asked for: what needs the solver.
LATER = {"certify": "synthesis.synthesize", "synthesize": "synthesis.synthesize"}


def __getattr__(name: str) -> Any:
    """Imports what takes long only when it is asked for."""
    if name in LATER:
        return getattr(import_module(f"shields.{LATER[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
