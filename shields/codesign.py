"""The published optimization problem OP and its search (Liu et al. Definition 2 and Algorithm 1), as printed.

docs/paper.md says what was found about them.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.frozen import as_number
from shields.cone_program import ConeProgram
from shields.paper_bounds import PaperBounds, PaperModel

# kappa * rho this near to 1 makes the error bound infinite: the point is skipped.
SMALLEST_GAP = 1e-9
# Tightens every constraint, so that what the solver returns meets the printed ones in exact arithmetic.
SLACK = 1e-7
# (C2) must have this much room before the tightened problem is tried.
ROOM = 1e-6


@dataclass(frozen=True, eq=False)
class PaperDesign:
    """A solution of OP: L (n, n), K (m, n), its constants and log det L."""

    L: np.ndarray
    K: np.ndarray
    bounds: PaperBounds
    log_det: float


def solve_op(plant: LinearPlant, bounds: PaperBounds, *, slack: float = 0.0) -> PaperDesign | None:
    """Returns the solution of OP at one (kappa, rho), or None if the solver finds none: OP as printed, readably.

    Args:
        plant: The plant; its input limits must all be those of (C5).
        bounds: kappa, rho and the constants.
        slack: Relative tightening of the constraints.
    """
    n, m = plant.n, plant.m
    L, U = cp.Variable((n, n), symmetric=True), cp.Variable((n, n), symmetric=True)
    F, tau, beta = cp.Variable((m, n)), cp.Variable(m), cp.Variable()
    identity, closed = np.eye(n), plant.A @ L + plant.B @ F
    less, more = 1.0 - slack, 1.0 + slack
    constraints = [
        cp.bmat([[less * bounds.kappa * L, closed.T], [closed, L]]) >> 0,  # (C1)
        L >> more * bounds.alpha * identity,  # (C2)
        cp.diag(plant.C @ L @ plant.C.T) <= less,  # (C3)
        bounds.epsilon_up * U << less * bounds.alpha**2 * identity,  # (C4)
        U >> 0,
    ]
    if bounds.rho == 1.0:
        constraints.append(beta * identity == L)  # (C7)
    else:
        constraints += [more * beta * identity << L, L << less * bounds.rho * beta * identity]
    for i, limit in enumerate(plant.u_max):
        row = F[i : i + 1, :]
        constraints += [
            cp.bmat([[cp.reshape(less * 0.5 * limit**2 - tau[i], (1, 1), order="C"), row], [row.T, L]]) >> 0,  # (C5)
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
    return PaperDesign(shape, np.linalg.solve(shape, F.value.T).T, bounds, float(np.linalg.slogdet(shape)[1]))


def _eliminated(plant: LinearPlant, *, volume: bool, with_error: bool) -> ConeProgram:
    """Returns OP with U and tau eliminated exactly, to be updated in place.

    The best U is (alpha^2 / eps_up) I, and (C5) with (C6) become one matrix inequality. The parameters are kappa, rho,
    then alpha^2 / eps_up (`with_error`; without it the limit is K_i L K_i' <= u_max^2 / 2), then alpha (`volume`: the
    objective is log det L; without it, the largest lambda_min(L), (C2) is left out).
    """
    n = plant.n
    L, F = cp.Variable((n, n), symmetric=True), cp.Variable((plant.m, n))
    margin, beta = cp.Variable(), cp.Variable()
    kappa, rho, weight, alpha = (cp.Parameter(nonneg=True) for _ in range(4))
    closed, identity, zero = plant.A @ L + plant.B @ F, np.eye(n), np.zeros((n, n))
    constraints = [
        cp.bmat([[kappa * L, closed.T], [closed, L]]) >> 0,
        L >> (alpha if volume else margin) * identity,
        cp.diag(plant.C @ L @ plant.C.T) <= 1,
        beta * identity << L,
        L << rho * beta * identity,
    ]
    for i, limit in enumerate(plant.u_max):
        row, corner = F[i : i + 1, :], np.array([[0.5 * limit**2]])
        blocks = [[corner, row], [row.T, L]]
        if with_error:
            blocks = [[corner, row, row], [row.T, L, zero], [row.T, zero, weight * identity]]
        constraints.append(cp.bmat(blocks) >> 0)
    objective = cp.log_det(L) if volume else margin
    parameters = [kappa, rho] + [weight] * with_error + [alpha] * volume
    return ConeProgram(cp.Problem(cp.Maximize(objective), constraints), parameters)


class MarginProgram:
    """The largest lambda_min(L) that all of OP but (C2) allows: OP is feasible exactly if it reaches alpha.

    Args:
        plant: The plant.
        with_error: False drops the communication error from the input limit, which leaves K_i L K_i' <= u_max^2 / 2 and
            makes the margin independent of gamma, Q and P0.
    """

    def __init__(self, plant: LinearPlant, *, with_error: bool = True) -> None:
        self._with_error = with_error
        self._program = _eliminated(plant, volume=False, with_error=with_error)

    def largest(self, bounds: PaperBounds) -> float:
        """Returns the largest lambda_min(L); minus infinity if the other constraints have no solution."""
        weight = [bounds.alpha**2 / bounds.epsilon_up] * self._with_error
        return self._program.maximum([bounds.kappa, bounds.rho, *weight])


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


class VolumeProgram:
    """OP with U and tau eliminated, updated in place: its largest log det L at any (kappa, rho).

    Args:
        plant: The plant.
    """

    def __init__(self, plant: LinearPlant) -> None:
        self._program = _eliminated(plant, volume=True, with_error=True)

    def largest(self, bounds: PaperBounds) -> float:
        """Returns the largest log det L; minus infinity if the solver finds none."""
        weight = bounds.alpha**2 / bounds.epsilon_up
        return self._program.maximum([bounds.kappa, bounds.rho, weight, bounds.alpha])


def codesign(plant: LinearPlant, *, dkappa: float = 0.02, drho: float = 0.05, search: str = "first") -> PaperDesign:
    """Returns the solution of OP that Algorithm 1 finds.

    Args:
        plant: The plant with its bounds.
        dkappa: Step of kappa, > 0.
        drho: Step of rho, > 0.
        search: "first" (as printed: the first feasible pair wins) or "largest" (the largest log det over the grid).

    Raises:
        LookupError: If OP has no solution anywhere on the grid.
        ValueError: If a step is not positive or the search is unknown.
    """
    if search not in ("first", "largest"):
        raise ValueError(f"search must be 'first' or 'largest', got {search!r}")
    model, margin, volume = PaperModel(plant), MarginProgram(plant), VolumeProgram(plant)
    best: tuple[float, PaperBounds | None] = (-np.inf, None)
    for kappa, rho in grid(dkappa, drho):
        bounds = model.at(kappa, rho)
        if margin.largest(bounds) < bounds.alpha * (1.0 + ROOM):
            continue
        if search == "first":
            design = solve_op(plant, bounds, slack=SLACK)
            if design is not None:
                return design
        else:
            best = max(best, (volume.largest(bounds), bounds), key=lambda pair: pair[0])
    design = None if best[1] is None else solve_op(plant, best[1], slack=SLACK)
    if design is None:
        raise LookupError("OP has no solution on the grid")
    return design
