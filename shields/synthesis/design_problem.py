"""The design problem of the certified method: the plant in scaled coordinates, with its error sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ncs_gym import ChannelContract, ErrorSet, ErrorSetError, LinearPlant, UnstablePlantError, certified_error_set
from shields.errors import Infeasible
from shields.synthesis.semidefinite_programs import ScaledProblem, largest_box_ellipsoid, scaled_problem

# The certificate's Sigma and D are larger than the environment's by this, so that another machine's rounding (of a
# Lyapunov solution, of a chi-square quantile) stays inside.
GROWTH = 1.0 + 1e-9


def design_problem(plant: LinearPlant, contract: ChannelContract | None = None) -> tuple[ScaledProblem, ErrorSet]:
    """Returns the scaled problem and the error set, with its shapes a little larger than the environment's.

    Raises:
        Infeasible: If the plant has no error set or its box is unbounded.
    """
    free = plant.n - int(np.linalg.matrix_rank(plant.C))
    if free:
        raise Infeasible(
            f"the safe box leaves {free} of {plant.n} directions unbounded: add rows to C with generous limits",
            "S",
            free,
        )
    try:
        errors = grown(certified_error_set(plant, contract))
    except UnstablePlantError as error:
        raise Infeasible(f"(E1) cannot hold: {error}", "E1", plant.spectral_radius - 1.0) from error
    except ErrorSetError as error:
        raise Infeasible(str(error), "E1", 0.0) from error
    shapes = errors.Sigma[None] if errors.ages is None else errors.ages.shapes[:-1]
    return scaled_problem(plant, shapes, largest_box_ellipsoid(plant.C)), errors


def grown(errors: ErrorSet) -> ErrorSet:
    """Returns an error set with every shape larger by GROWTH; (E0) to (C2) keep holding."""
    ages = errors.ages and replace(errors.ages, shapes=GROWTH * errors.ages.shapes)
    return replace(errors, Sigma=GROWTH * errors.Sigma, ages=ages)
