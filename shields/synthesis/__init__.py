"""Offline synthesis of a robust control invariant ellipsoid with its gain, by semidefinite programming.

`synthesize` looks for the largest certified set: the design problem is scaled, an initial design is found for fixed
multipliers or from a gain of largest margin, alternation between the linear matrix inequalities and the multipliers
enlarges the set, and the result is verified exactly. `certify` proves a given set and gain, and `requirements` says
which contracts leave a plant certifiable. Importing this package imports the solver.
"""

from shields.synthesis.certification import synthesize
from shields.synthesis.ellipsoid_certificates import certify
from shields.synthesis.network_requirements import Requirements, requirements

__all__ = [
    "Requirements",
    "certify",
    "requirements",
    "synthesize",
]
