"""Why there is no certificate."""

from __future__ import annotations


class Infeasible(ValueError):
    """No certificate was found.

    Attributes:
        binding: What stands in the way: "E1" (no error bound), "S" (the box is unbounded), "U" (input limits) or
            "I" (invariance); where only exact verification failed, the name of its condition.
            Of OP: "C2", "C1", "C5" (input limit), or "grid" where only the search's steps are too coarse.
        shortfall: By how much: for "E1" the excess of the spectral radius over 1; for "I" and "U" the share by
            which the uncertainty (disturbance and error radii) is too large, in (0, 1]; for "S" the number of
            directions without a limit; where only exact verification failed, its margin; for "C2"
            1 - lambda_min(L)/alpha.
        details: Further figures by name. "certified": `share_of_radii` for which a design is found; under a contract
            also the largest `max_age`, and the `largest_gamma` at the age asked for. "paper": the best ratio
            lambda_min(L)/alpha, its kappa and rho, the largest gamma and the largest scales of the uncertainty for
            which OP is feasible.
    """

    def __init__(self, message: str, binding: str, shortfall: float, details: dict[str, float] | None = None) -> None:
        super().__init__(message)
        self.binding = binding
        self.shortfall = shortfall
        self.details = details or {}

    def __reduce__(self):
        return type(self), (self.args[0], self.binding, self.shortfall, self.details)
