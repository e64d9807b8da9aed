"""Robust safety invariant sets, their exact verification, and shields made of them."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from shields.certificate import Certificate, CertificateError, Multipliers
from shields.condition import Condition
from shields.filter import Decision, SafetyFilter
from shields.infeasible import Infeasible
from shields.synthesis import certify, synthesize
from shields.verification import Report, verify
from shields.wrapper import SafetyShield

if TYPE_CHECKING:
    from shields.vector_wrapper import VectorSafetyShield

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


def __getattr__(name: str) -> Any:
    """Imports what needs the compiler only when it is asked for."""
    if name == "VectorSafetyShield":
        return import_module("shields.vector_wrapper").VectorSafetyShield
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
