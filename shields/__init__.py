"""Safety shields for networked control: synthesis, exact verification and run-time use of robust invariant sets.

`synthesize` finds a robust control invariant ellipsoid with its gain for a plant, `verify` checks the resulting
`Certificate` in exact arithmetic, and `SafetyShield`, `VectorSafetyShield`, `SafeLoop` and `SafetyFilter` use it to
keep any agent inside the safe set. `shields.paper` has the published method as printed.
"""

from typing import TYPE_CHECKING, Any

from shields.certificate import Certificate
from shields.errors import CertificateError, GuaranteeLostError, GuaranteeLostWarning, Infeasible
from shields.packaged_certificates import certificate_for
from shields.runtime import SafeLoop, SafetyFilter, SafetyShield, VectorSafetyShield
from shields.verification import Report, verify

if TYPE_CHECKING:
    from shields.held import reach_of, setpoint_range
    from shields.silence import silence_of
    from shields.synthesis import requirements, synthesize

__distribution__ = "ncs-gym"

__all__ = [
    "Certificate",
    "CertificateError",
    "GuaranteeLostError",
    "GuaranteeLostWarning",
    "Infeasible",
    "Report",
    "SafeLoop",
    "SafetyFilter",
    "SafetyShield",
    "VectorSafetyShield",
    "certificate_for",
    "reach_of",
    "requirements",
    "setpoint_range",
    "silence_of",
    "synthesize",
    "verify",
]


def __dir__() -> list[str]:
    """Returns the public names, of which none needs to be imported yet."""
    return __all__


def __getattr__(name: str) -> Any:
    """Returns a public name, or module, that needs the solver: these are imported at first use."""
    if name in ("reach_of", "setpoint_range"):
        import shields.held as module
    elif name == "silence_of":
        import shields.silence as module
    elif name in ("requirements", "synthesize"):
        import shields.synthesis as module
    elif name == "paper":
        import shields.paper

        return shields.paper
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(module, name)
