"""The design problem of the certified method: the plant in scaled coordinates, with its error sets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce
from typing import NamedTuple

import numpy as np

from ncs_gym import ChannelContract, ErrorSetError, LinearPlant, UnstablePlantError, exact
from ncs_gym.ellipsoid import is_inside, joined
from ncs_gym.estimation.error_bound import ErrorSet, certified_error_set
from shields.errors import Infeasible
from shields.synthesis.semidefinite_programs import largest_box_ellipsoid
from shields.verification import ACTION_ROUNDING

# The certificate's Sigma is larger than the environment's by this factor: another machine's rounding stays inside.
INFLATION = 1.0 + 1e-9
# Axes of an error set are lengthened to at least this fraction of its longest one in the semidefinite programs; exact
# verification uses the error set itself.
_SMALLEST_AXIS_RATIO = 0.01
# A box that is longer in one direction than in another by more, each state in units of its own limit, is refused.
_FLATTEST = 1e7
# Of the longest direction those states are named whose part in it is at least this much of the largest one.
_SHARE_OF_DIRECTION = 0.1


class Rest(NamedTuple):
    """The point x_c, (n,), and u_c, (m,), at which the fallback input rests: x_c = A x_c + B u_c."""

    state: np.ndarray
    input: np.ndarray


class SymmetricLimits(NamedTuple):
    """Limits |c_j z| <= 1, c of shape (k, n) and full column rank, and |v_i| <= u_max_i, (m,), from a resting point."""

    box_rows: np.ndarray
    u_max: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class DesignProblem:
    """The plant in scaled coordinates z = T^-1 x and u / u_max, with T T' the largest ellipsoid in the safe box.

    Attributes:
        A: State matrix in scaled coordinates, shape (n, n).
        B: Input matrix in scaled coordinates, shape (n, m).
        C: Rows of the safe box in scaled coordinates, shape (k, n).
        D_u: Shape of the disturbance set with the rounding of actions, scaled, (n, n).
        error_shapes: Shapes of the error sets for which K x_hat must be safe, scaled, (k, n, n).
        transform: T, shape (n, n).
        u_max: Input limits in physical units, shape (m,).
        rounding: Multiplier s of D_u.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D_u: np.ndarray
    error_shapes: np.ndarray
    transform: np.ndarray
    u_max: np.ndarray
    rounding: float

    @property
    def maximal_error_shapes(self) -> np.ndarray:
        """The error sets that lie in no other one, shape (l, n, n), thickened where they are nearly flat.

        A larger set is sound; for a flat one the linearization of L Sigma^-1 L allows hardly any change of L.
        """
        kept = list(self.error_shapes)
        for Sigma in self.error_shapes:
            others = [other for other in kept if other is not Sigma]
            if any(is_inside(Sigma, other) for other in others):
                kept = others
        longest = np.linalg.eigvalsh(np.stack(kept))[:, -1]
        return np.stack(kept) + _SMALLEST_AXIS_RATIO**2 * longest[:, None, None] * np.eye(len(self.A))

    @cached_property
    def covering_error_shape(self) -> np.ndarray:
        """The shape of an ellipsoid that contains every error set, (n, n)."""
        return reduce(joined, self.error_shapes)

    def to_physical(self, L: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns L (n, n) and K (m, n) in physical units."""
        shape = self.transform @ L @ self.transform.T
        return 0.5 * (shape + shape.T), np.diag(self.u_max) @ np.linalg.solve(self.transform.T, K.T).T


@dataclass(frozen=True, eq=False)
class CandidateDesign:
    """An ellipsoid E(L), (n, n), and a gain K, (m, n), in scaled coordinates, not yet verified.

    Its multipliers are (lx, le, ld) of (I), and mu of (U), shape (m,).
    """

    L: np.ndarray
    K: np.ndarray
    multipliers: tuple[float, float, float]
    inputs: np.ndarray

    @cached_property
    def log_det(self) -> float:
        """log det L; 0 is the largest ellipsoid in the safe box."""
        return float(np.linalg.slogdet(self.L)[1])


def design_problem(
    plant: LinearPlant, contract: ChannelContract | None = None, limits: SymmetricLimits | None = None
) -> tuple[DesignProblem, ErrorSet]:
    """Returns the scaled design problem, and the error set with its shapes a little larger than the environment's.

    The set is sought within `limits`, by default the plant's own.

    Raises:
        Infeasible: If the plant has no error set, or its safe box is flat.
        ValueError: If its own limits are meant, which are not symmetric.
    """
    if limits is None and not plant.is_symmetric:
        raise ValueError("the limits of the plant are not symmetric: give those around a resting point")
    limits = SymmetricLimits(plant.box, plant.largest_input) if limits is None else limits
    _, sizes, directions = np.linalg.svd(limits.box_rows * plant.half_widths)
    flatness = float(sizes[0] / sizes[-1])
    if flatness > _FLATTEST:
        large = np.flatnonzero(np.abs(directions[-1]) > _SHARE_OF_DIRECTION * np.abs(directions[-1]).max())
        names = " or ".join(plant.state_names[j] for j in large.tolist())
        raise Infeasible(
            f"the safe box is flat, {flatness:.0e} times longer in one direction than in another that is no axis: add "
            f"a limit of {names}, along which it is long, or leave out those that limit the short one",
            "S",
            flatness,
        )
    try:
        errors = certified_error_set(plant, contract).larger(INFLATION)
    except UnstablePlantError as error:
        raise Infeasible(
            "(E1) cannot hold: without packets the estimation error grows for ever, because the spectral radius of A "
            f"is {plant.spectral_radius:.6g}, not below 1: give contract=ChannelContract(max_age=...), or --max-age, "
            "the age in steps that the newest sample never exceeds (if A is that of a model in continuous time, make "
            "the plant by Model.sampled)",
            "E1",
            plant.spectral_radius - 1.0,
        ) from error
    except ErrorSetError as error:
        raise Infeasible(str(error), "E1", 0.0) from error
    box_rows, u_max = limits
    box = largest_box_ellipsoid(box_rows)
    T = np.linalg.cholesky(box)
    D = plant.disturbance.shape_matrix
    step = plant.B * (float(ACTION_ROUNDING) * plant.input_half)
    rounding = plant.m * step @ step.T
    weight = np.linalg.inv(box)
    ratio = np.vdot(weight, rounding) / max(float(np.vdot(weight, D)), 1e-30)
    s = float(exact.rounded(np.sqrt(np.clip(ratio, 1e-16, 1.0)), 6))
    inverse = np.linalg.inv(T)
    D_u = (1.0 + s) * D + (1.0 + 1.0 / s) * rounding
    problem = DesignProblem(
        A=inverse @ plant.A @ T,
        B=inverse @ plant.B @ np.diag(u_max),
        C=box_rows @ T,
        D_u=inverse @ D_u @ inverse.T,
        error_shapes=inverse @ errors.promised @ inverse.T,
        transform=T,
        u_max=u_max,
        rounding=s,
    )
    return problem, errors
