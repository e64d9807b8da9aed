"""Robust safety invariant sets, their exact verification, and shields made of them."""

from shields.certificate import Certificate, CertificateError, Multipliers
from shields.condition import Condition
from shields.filter import Decision, SafetyFilter
from shields.infeasible import Infeasible
from shields.synthesis import certify, synthesize
from shields.verification import Report, verify
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
    "certify",
    "synthesize",
    "verify",
]
