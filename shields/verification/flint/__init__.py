"""A second verifier by another route, on python-flint: what it and the first agree on, no slip of either decides.

It states every condition anew, with denominators multiplied out, decides definiteness by the signs of characteristic
polynomials and chi-square quantiles in ball arithmetic; with the first it shares the reading of certificates alone.
"""

from shields.verification.flint.flint_conditions import flint_conditions

__all__ = ["flint_conditions"]
