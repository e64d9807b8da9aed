"""Why there is no certificate, or why one is refused."""

from __future__ import annotations


class CertificateError(ValueError):
    """A certificate is damaged, belongs to another plant, or does not verify."""


class GuaranteeLostError(RuntimeError):
    """The state of a shielded loop is not proved safe, and `on_unproved="raise"` asks for an error.

    The step has happened: the loop can go on, and the same reason is not raised again in this episode.
    """


class GuaranteeLostWarning(UserWarning):
    """The state of a shielded loop is not proved safe; said once per episode and reason."""


class Infeasible(ValueError):
    """No certificate was found.

    Attributes:
        binding: Name of the condition that cannot be met: "E1" (there is no error bound), "S" (the safe box), "U" (the
            input limits), "I" (invariance), "P" (a gain bears all, but its polytope was not found), "R" (it has too
            many rows), or "T" (`time_limit` was over before anything was found); where a candidate failed in exact
            verification only, the condition it failed. "OP" for the published method.
        shortfall: By how much the condition fails: for "E1" the excess of the spectral radius over 1; for "I" and "U"
            the fraction, in (0, 1], by which the radii of disturbance and estimation error must shrink; where only
            exact verification failed, the violation of that condition.
    """

    def __init__(self, message: str, binding: str, shortfall: float) -> None:
        super().__init__(message)
        self.binding = binding
        self.shortfall = shortfall

    def __reduce__(self):
        return type(self), (self.args[0], self.binding, self.shortfall)
