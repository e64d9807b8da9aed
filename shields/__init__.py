"""Safety shields for networked control: synthesis, exact verification and run-time use of robust invariant sets.

`synthesize` finds a robust control invariant ellipsoid with its gain for a plant, `verify` checks the resulting
`Certificate` in exact arithmetic, and `SafetyShield`, `VectorSafetyShield`, `SafeLoop` and `SafetyFilter` use it to
keep any agent inside the safe set. `shields.paper` has the published method as printed.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from shields.certificate import Certificate, Multipliers, Proof, Updates
from shields.certificate_text import Reach
from shields.errors import CertificateError, GuaranteeLostError, GuaranteeLostWarning, Infeasible
from shields.packaged_certificates import certificate_for
from shields.polytope import Polytope
from shields.runtime import Decision, SafeLoop, SafetyFilter, SafetyShield, VectorSafetyShield
from shields.verification import Condition, Report, verify

if TYPE_CHECKING:
    from shields.held import SetPoints, reach_of, setpoint_range
    from shields.silence import Silence, silence_of
    from shields.synthesis import (
        Requirements,
        certify,
        requirements,
        synthesize,
    )

__distribution__ = "ncs-gym"

__all__ = [
    "Certificate",
    "CertificateError",
    "Condition",
    "Decision",
    "GuaranteeLostError",
    "GuaranteeLostWarning",
    "Infeasible",
    "Multipliers",
    "Polytope",
    "Proof",
    "Reach",
    "Report",
    "Requirements",
    "SafeLoop",
    "SafetyFilter",
    "SafetyShield",
    "SetPoints",
    "Silence",
    "Updates",
    "VectorSafetyShield",
    "certificate_for",
    "certify",
    "reach_of",
    "requirements",
    "setpoint_range",
    "silence_of",
    "synthesize",
    "verify",
]


# Imported at first use: these need the solver.
_NAMES = {
    "synthesis": ("Requirements", "certify", "requirements", "synthesize"),
    "held": ("SetPoints", "reach_of", "setpoint_range"),
    "silence": ("Silence", "silence_of"),
}
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}


def __dir__() -> list[str]:
    """Returns the public names, of which none needs to be imported yet."""
    return __all__


def __getattr__(name: str) -> Any:
    """Returns a public name, or module, whose import takes long."""
    if name in _MODULE_OF:
        return getattr(import_module(f"shields.{_MODULE_OF[name]}"), name)
    if name == "paper":
        return import_module("shields.paper")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
