"""Offline synthesis of robust control invariant sets with their gains.

`certification` reads as one page: gains and what they bear (`tolerance`), at which the largest ellipsoid begins
(`ellipsoid_certificates`: alternation between linear matrix inequalities and multipliers), else a polytope alone
(`polytope_certificates`); each is verified exactly, and where there is none `diagnosis` says why. `design_problem` is
the plant in scaled coordinates; `requirements` says which contracts leave a plant certifiable. Importing this package
imports the solver.
"""

from shields.synthesis.certification import synthesize
from shields.synthesis.network_requirements import Requirements, requirements

__all__ = [
    "Requirements",
    "requirements",
    "synthesize",
]
