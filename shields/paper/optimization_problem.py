"""The published optimization problem OP and its search (Liu et al. Definition 2 and Algorithm 1), as printed.

docs/paper.md says what was found about them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.validation import as_number
from shields.paper.bounds import PaperBounds, PaperModel
from shields.paper.conditions import SMALLEST_GAP
from shields.paper.cone_program import ConeProgram
from shields.synthesis.semidefinite_programs import found, largest_box_ellipsoid

# Tightens every constraint, so that what the solver returns meets the printed ones in exact arithmetic.
SLACK = 1e-7
# (C2) must have this much room before the tightened problem is tried.
ROOM = 1e-6
# In units of the box, lambda_min(L) below this is the solver's noise, and a weight above that is no limit.
SMALLEST_MARGIN, LARGEST_WEIGHT = 1e-7, 1e9


@dataclass(frozen=True, eq=False)
class PaperDesign:
    """A solution of OP: L (n, n), K (m, n), its constants and log det L."""

    L: np.ndarray
    K: np.ndarray
    bounds: PaperBounds
    log_det: float


@dataclass(frozen=True, eq=False)
class Units:
    """OP in units where the safe box is of size 1 and the inputs are limited by 1.

    One unit for all states keeps OP's identity matrices what they are: with x = size x', L = size^2 L', and alpha, eps
    and eps_up are divided by size^2.

    Attributes:
        A, B, C: Plant in these units.
        size: Unit of the states.
        u_max: Units of the inputs, shape (m,).
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    size: float
    u_max: np.ndarray

    @classmethod
    def of(cls, plant: LinearPlant) -> Units:
        """Returns the units of a plant; its box must be bounded."""
        size = float(np.linalg.det(largest_box_ellipsoid(plant.C))) ** (0.5 / plant.n)
        return cls(plant.A, plant.B * plant.u_max / size, plant.C * size, size, plant.u_max)


def solve_op(plant: LinearPlant, bounds: PaperBounds, *, slack: float = 0.0) -> PaperDesign | None:
    """Returns the solution of OP at one (kappa, rho), or None if the solver finds none: OP as printed, readably.

    Args:
        plant: The plant.
        bounds: kappa, rho and the constants.
        slack: Relative tightening of the constraints.
    """
    n, m, units = plant.n, plant.m, Units.of(plant)
    alpha, epsilon_up = bounds.alpha / units.size**2, bounds.epsilon_up / units.size**2
    L, U = cp.Variable((n, n), symmetric=True), cp.Variable((n, n), symmetric=True)
    F, tau, beta = cp.Variable((m, n)), cp.Variable(m), cp.Variable()
    identity, closed = np.eye(n), units.A @ L + units.B @ F
    less, more = 1.0 - slack, 1.0 + slack
    constraints = [
        cp.bmat([[less * bounds.kappa * L, closed.T], [closed, L]]) >> 0,  # (C1)
        L >> more * alpha * identity,  # (C2)
        cp.diag(units.C @ L @ units.C.T) <= less,  # (C3)
        epsilon_up * U << less * alpha**2 * identity,  # (C4)
        U >> 0,
    ]
    if bounds.rho == 1.0:
        constraints.append(beta * identity == L)  # (C7)
    else:
        constraints += [more * beta * identity << L, L << less * bounds.rho * beta * identity]
    for i in range(m):
        row = F[i : i + 1, :]
        constraints += [
            cp.bmat([[cp.reshape(less * 0.5 - tau[i], (1, 1), order="C"), row], [row.T, L]]) >> 0,  # (C5), u_max = 1
            cp.bmat([[cp.reshape(tau[i], (1, 1), order="C"), row], [row.T, U]]) >> 0,  # (C6)
        ]
    problem = cp.Problem(cp.Maximize(cp.log_det(L)), constraints)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "may be inaccurate": the exact check afterwards judges
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.SolverError:
            return None
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or L.value is None:
        return None
    shape = 0.5 * (L.value + L.value.T)
    if bounds.rho == 1.0:
        shape = float(shape[0, 0]) * identity
    if np.linalg.eigvalsh(shape)[0] <= 0.0:
        return None
    K = units.u_max[:, None] * np.linalg.solve(shape, found(F).T).T / units.size
    shape = units.size**2 * shape
    return PaperDesign(shape, K, bounds, float(np.linalg.slogdet(shape)[1]))


def _eliminated(units: Units, *, volume: bool, with_error: bool) -> ConeProgram:
    """Returns OP with U and tau eliminated exactly, to be updated in place.

    The best U is (alpha^2 / eps_up) I, and (C5) with (C6) become one matrix inequality. The parameters are kappa, rho,
    then alpha^2 / eps_up (`with_error`; without it the limit is K_i L K_i' <= 1/2), then alpha (`volume`: the
    objective is log det L; without it, the largest lambda_min(L), (C2) is left out).
    """
    n, m = units.B.shape
    L, F = cp.Variable((n, n), symmetric=True), cp.Variable((m, n))
    margin, beta = cp.Variable(), cp.Variable()
    kappa, rho, weight, alpha = (cp.Parameter(nonneg=True) for _ in range(4))
    closed, identity, zero = units.A @ L + units.B @ F, np.eye(n), np.zeros((n, n))
    constraints = [
        cp.bmat([[kappa * L, closed.T], [closed, L]]) >> 0,
        L >> (alpha if volume else margin) * identity,
        cp.diag(units.C @ L @ units.C.T) <= 1,
        beta * identity << L,
        L << rho * beta * identity,
    ]
    for i in range(m):
        row, corner = F[i : i + 1, :], np.array([[0.5]])
        blocks = [[corner, row], [row.T, L]]
        if with_error:
            blocks = [[corner, row, row], [row.T, L, zero], [row.T, zero, weight * identity]]
        constraints.append(cp.bmat(blocks) >> 0)
    objective = cp.log_det(L) if volume else margin
    parameters = [kappa, rho] + [weight] * with_error + [alpha] * volume
    return ConeProgram(cp.Problem(cp.Maximize(objective), constraints), parameters, almost=volume)


class MarginProgram:
    """The largest lambda_min(L) that all of OP but (C2) allows: OP is feasible exactly if it reaches alpha.

    Args:
        plant: The plant.
        with_error: False drops the communication error from the input limit, which leaves K_i L K_i' <= u_max^2 / 2 and
            makes the margin independent of gamma, Q and P0.
    """

    def __init__(self, plant: LinearPlant, *, with_error: bool = True) -> None:
        self._units, self._with_error = Units.of(plant), with_error
        self._program = _eliminated(self._units, volume=False, with_error=with_error)

    def largest(self, bounds: PaperBounds) -> float:
        """Returns the largest lambda_min(L); minus infinity if there is none beyond the solver's accuracy."""
        weight = [_weight(bounds, self._units)] * self._with_error
        margin = self._program.maximum([bounds.kappa, bounds.rho, *weight])
        return self._units.size**2 * margin if margin > SMALLEST_MARGIN else -np.inf


def _weight(bounds: PaperBounds, units: Units) -> float:
    """Returns alpha^2 / eps_up in the given units, capped where it no longer matters (smaller is conservative)."""
    if bounds.epsilon_up == 0.0:
        return LARGEST_WEIGHT
    return min(bounds.alpha / units.size**2 * bounds.alpha / bounds.epsilon_up, LARGEST_WEIGHT)


class VolumeProgram:
    """OP with U and tau eliminated, updated in place: its largest log det L at any (kappa, rho).

    Args:
        plant: The plant.
    """

    def __init__(self, plant: LinearPlant) -> None:
        self._units, self._n = Units.of(plant), plant.n
        self._program = _eliminated(self._units, volume=True, with_error=True)

    def largest(self, bounds: PaperBounds) -> float:
        """Returns the largest log det L; minus infinity if the solver finds none."""
        alpha = bounds.alpha / self._units.size**2
        volume = self._program.maximum([bounds.kappa, bounds.rho, _weight(bounds, self._units), alpha])
        return volume + 2.0 * self._n * float(np.log(self._units.size))


def grid(dkappa: float, drho: float) -> Iterator[tuple[float, float]]:
    """Yields (kappa, rho) in the order of Algorithm 1: kappa from 1 down by dkappa, rho from 1 up to 1/kappa by drho.

    Points with kappa rho = 1 are skipped: there the error bound is infinite.

    Raises:
        ValueError: If a step is not positive.
    """
    dkappa, drho = (as_number(v, name, low=0.0, low_open=True) for v, name in ((dkappa, "dkappa"), (drho, "drho")))
    kappa, i = 1.0, 0
    while kappa > SMALLEST_GAP:
        rho, j = 1.0, 0
        while kappa * rho <= 1.0 - SMALLEST_GAP:
            yield kappa, rho
            j += 1
            rho = 1.0 + j * drho
        i += 1
        kappa = 1.0 - i * dkappa


def codesign(
    plant: LinearPlant,
    *,
    dkappa: float = 0.02,
    drho: float = 0.05,
    search: str = "first",
    accept: Callable[[PaperDesign], bool] = lambda design: True,
) -> PaperDesign:
    """Returns the solution of OP that Algorithm 1 finds.

    Args:
        plant: The plant with its bounds.
        dkappa: Step of kappa, > 0.
        drho: Step of rho, > 0.
        search: "first" (as printed: the first feasible pair wins) or "largest" (the largest log det over the grid).
        accept: Judges a solution; the search goes on past one that is not accepted.

    Raises:
        LookupError: If OP has no accepted solution anywhere on the grid.
        ValueError: If a step is not positive or the search is unknown.
    """
    if search not in ("first", "largest"):
        raise ValueError(f"search must be 'first' or 'largest', got {search!r}")
    model, margin, volume = PaperModel(plant), MarginProgram(plant), VolumeProgram(plant)
    feasible: list[tuple[float, PaperBounds]] = []
    for kappa, rho in grid(dkappa, drho):
        bounds = model.at(kappa, rho)
        if margin.largest(bounds) < bounds.alpha * (1.0 + ROOM):
            continue
        if search == "first":
            design = solve_op(plant, bounds, slack=SLACK)
            if design is not None and accept(design):
                return design
        else:
            feasible.append((volume.largest(bounds), bounds))
    for _, bounds in sorted(feasible, key=lambda pair: -pair[0]):
        design = solve_op(plant, bounds, slack=SLACK)
        if design is not None and accept(design):
            return design
    raise LookupError("OP has no solution on the grid")
