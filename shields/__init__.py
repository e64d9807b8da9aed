"""Robust safety invariant sets, their exact verification, and shields made of them."""

from shields.certificate import Certificate, CertificateError, Multipliers
from shields.filter import Decision, SafetyFilter
from shields.synthesis import Infeasible, synthesize
from shields.verification import Condition, Report, verify
from shields.wrapper import SafetyShield

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
    "synthesize",
    "verify",
]
