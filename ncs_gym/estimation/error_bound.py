"""Finds the certified error set of a plant: what the estimation error never leaves, whatever the channel does."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ncs_gym import exact
from ncs_gym.estimation.error_bounds_by_age import error_sets_by_age, in_round_numbers
from ncs_gym.estimation.error_sets import ErrorSet, ErrorSetError
from ncs_gym.network.contract import ChannelContract
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.ellipsoid import rounded_up

# Growth c of the optimal set: slack in (E1), and room for updates (docs/shield_proof.md).
GROWTH = 1.1
# Digits of a set relative to its extents, and of 1 - rate: what differs between processors beyond them is cut off.
DIGITS, RATE_DIGITS = 11, 4
# Beyond this many roundings of the largest entry a checked inequality is taken to hold.
ROUNDINGS = 100.0
# Smaller singular values, and distances from the unit circle, count as zero in the test of detectability.
UNDETECTABLE = 1e-8
# Flat disturbances are thickened by this fraction of their mean extent, so that (E1) has slack in every direction.
THICKENING = 1e-9
# No set is thinner than this, in half-widths of the safe box (a perfectly known plant has no error at all).
THINNEST = 1e-6


class UnstablePlantError(ValueError):
    """Without a promise from the channel no error bound exists for a plant that is not Schur stable."""


def certified_error_set(plant: LinearPlant, contract: ChannelContract | None = None) -> ErrorSet:
    """Returns the error set of a plant: of a stable one without a contract, of any under one.

    Raises:
        UnstablePlantError: If the plant is not Schur stable and there is no contract.
        ErrorSetError: If none is found, or the plant is too ill-conditioned to compute it.
    """
    key = plant.fingerprint, contract
    if key not in _known:
        _known[key] = _unconditional_set(plant) if contract is None else _conditional_set(plant, contract)
    return _known[key]


_known: dict[tuple[str, ChannelContract | None], ErrorSet] = {}


def _conditional_set(plant: LinearPlant, contract: ChannelContract) -> ErrorSet:
    try:
        sets = error_sets_by_age(plant, contract)
    except ErrorSetError as error:
        if (unseen := unseen_state(plant.A, plant.H, plant.half_widths, plant.state_names)) is not None:
            raise ErrorSetError(
                f"no error set exists: the outputs do not show {unseen}, whose errors never decay"
            ) from None
        raise ErrorSetError(
            f"no error set was found under a contract of max_age = {contract.max_age}: promise less age, or give finer "
            f"sensors, since {error}"
        ) from None
    require_error_set(sets, plant)
    return _round_if_it_holds(in_round_numbers(sets), sets, plant)


def _round_if_it_holds(rounded: ErrorSet, other: ErrorSet, plant: LinearPlant) -> ErrorSet:
    """Returns an error set in round numbers if its conditions hold, else the other one."""
    try:
        require_error_set(rounded, plant)
    except ErrorSetError:
        return other
    return rounded


def unseen_state(A: np.ndarray, H: np.ndarray, widths: np.ndarray, names: Sequence[str]) -> str | None:
    """Returns the state with the largest part in a mode that neither decays nor shows in the outputs; None without one.

    The test of Popov, Belevitch and Hautus for detectability, states being in units of widths, (n,); of the transposed
    model it is that for stabilizability.
    """
    A, H = A * widths / widths[:, None], H * widths
    H = H / np.maximum(np.abs(H).max(axis=1, keepdims=True), np.finfo(float).tiny)
    for mode in np.linalg.eigvals(A):
        if abs(mode) >= 1.0 - UNDETECTABLE:
            _, shown, directions = np.linalg.svd(np.vstack([A - mode * np.eye(len(A)), H]))
            if shown[-1] <= UNDETECTABLE * shown[0]:
                return names[int(np.argmax(np.abs(directions[-1])))]
    return None


def require_error_set(error_set: ErrorSet, plant: LinearPlant) -> None:
    """Raises ErrorSetError, naming the condition, unless all of a set hold by more than the rounding of this check."""
    for name, triples in error_set.needs(plant).items():
        if not all(_holds(*triple) for triple in triples):
            raise ErrorSetError(
                f"no error set found: the plant is too ill-conditioned for {name} to hold in float64; give states "
                "units in which the half-widths of the box are of similar size"
            )


def _holds(outer: np.ndarray, inner: np.ndarray, size: np.ndarray) -> bool:
    """Returns whether outer - inner is positive definite by more than rounding, each state in units of the outer set.

    The rounding of the inner shape grows with `size`, entry by entry.
    """
    with np.errstate(all="ignore"):
        scale = 1.0 / np.sqrt(np.diag(outer))
        units = np.outer(scale, scale)
        gap, rounded = units * (outer - inner), units * (np.abs(outer) + size)
        if not (np.isfinite(gap).all() and np.isfinite(rounded).all()):
            return False
        return bool(np.linalg.eigvalsh(gap)[0] > ROUNDINGS * len(outer) * np.finfo(float).eps * rounded.max())


def _unconditional_set(plant: LinearPlant) -> ErrorSet:
    """Returns the error set of a stable plant in closed form (docs/shield_proof.md, (E0) and (E1)).

    For a fixed rate the smallest solution of (E1) is a Lyapunov series; where it does not cover the first estimate, the
    missing part is added as a source to the same series. The rate minimizes tr(W Sigma), W the weight of the safe box.
    """
    from scipy.optimize import minimize_scalar  # takes long to import

    radius = plant.spectral_radius
    if not radius < 1.0:
        raise UnstablePlantError(
            f"no error bound exists without packets: the spectral radius of A is {radius:.6g}, it must be < 1; give "
            "the estimator error_set=certified_error_set(plant, contract) with the channel's contract"
        )
    # In coordinates z = T^-1 x, with W = (T T')^-1, the weight is the identity and units do not matter.
    inverse, identity = np.linalg.cholesky(plant.weight).T, np.eye(plant.n)
    T = np.linalg.inv(inverse)
    A = inverse @ plant.A @ T
    D = inverse @ plant.disturbance.shape_matrix @ inverse.T
    D = D + THICKENING * float(np.trace(D)) / plant.n * identity
    first = inverse @ plant.initial_error.shape_matrix @ inverse.T + THINNEST**2 * identity

    def size(rate: float) -> float:
        return float(np.trace(_smallest_solution(A, D, first, rate)))

    slowest = max(radius**2, 1e-6)
    margin = 1e-4 * (1.0 - slowest)
    bounds, options = (slowest + margin, 1.0 - margin), {"xatol": margin}
    best: Any = minimize_scalar(size, bounds=bounds, method="bounded", options=options)
    rate = 1.0 - float(exact.rounded(1.0 - best.x, RATE_DIGITS))
    Sigma = T @ (GROWTH * _smallest_solution(A, D, first, rate)) @ T.T
    found = ErrorSet(shapes=0.5 * (Sigma + Sigma.T)[None], rates=np.array([rate]))
    require_error_set(found, plant)
    return _round_if_it_holds(replace(found, shapes=rounded_up(found.Sigma, DIGITS)[None]), found, plant)


def _smallest_solution(A: np.ndarray, D: np.ndarray, first: np.ndarray, rate: float) -> np.ndarray:
    """Returns the Lyapunov solution of (E1) for one rate, enlarged to cover `first`; infinite where there is none."""
    try:
        solution = _lyapunov(A / np.sqrt(rate), D / (1.0 - rate))
        values, vectors = np.linalg.eigh(first - solution)
        if values[-1] > 0.0:
            missing = (vectors * np.maximum(values, 0.0)) @ vectors.T
            solution = solution + _lyapunov(A / np.sqrt(rate), missing)
    except np.linalg.LinAlgError:
        return np.full_like(A, np.inf)
    return 0.5 * (solution + solution.T)


def _lyapunov(A: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Returns X = A X A' + source by the direct method (the other fails silently)."""
    from scipy.linalg import LinAlgWarning, solve_discrete_lyapunov  # takes long to import

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LinAlgWarning)
        return solve_discrete_lyapunov(A, source, method="direct")
