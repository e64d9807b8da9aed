"""Certificates of sets and gains that are found, not yet verified: proofs, assumptions, and how they were made."""

from __future__ import annotations

import math
from contextlib import suppress
from importlib.metadata import version
from typing import Any

import numpy as np

from ncs_gym import Ellipsoid, LinearPlant, exact
from ncs_gym.ellipsoid import inflated
from ncs_gym.estimation.error_bound import ErrorSet
from shields.certificate import Certificate, Proof, Updates
from shields.certificate_text import reach_in
from shields.polytope import Polytope
from shields.synthesis.design_problem import CandidateDesign, DesignProblem
from shields.synthesis.invariant_set_program import with_best_multipliers
from shields.synthesis.semidefinite_programs import largest_box_ellipsoid

# Significant digits of the numbers of a certificate: what differs between processors beyond them is cut off. Sizes
# that are for people have fewer.
DIGITS, _SHOWN_DIGITS = 12, 6


def certificate_of(
    plant: LinearPlant, problem: DesignProblem, design: CandidateDesign, errors: ErrorSet
) -> Certificate:
    """Returns the certificate of a design, not yet verified."""
    L, K = problem.to_physical(design.L, design.K)
    L, K = shape_in_digits(L), gain_in_digits(K, plant)
    return Certificate(
        safe_set=Ellipsoid(L),
        K=K,
        proofs=proofs_of(errors, problem, design),
        D=inflated(plant.disturbance.shape_matrix),
        rounding=problem.rounding,
        **fields_of_plant(plant, errors),
    ).recording(ellipsoid_size(plant, L))


def proofs_of(
    errors: ErrorSet, problem: DesignProblem | None = None, design: CandidateDesign | None = None
) -> tuple[Proof, ...]:
    """Returns a proof per error set, with the multipliers of an ellipsoid that suit it best if a design is given."""
    sets = list(zip(errors.promised, errors.rates.tolist(), strict=True))
    designs: list[CandidateDesign | None] = len(sets) * [design]
    if len(sets) > 1 and problem is not None and design is not None:
        designs = [with_best_multipliers(problem, design, Sigma[None]) for Sigma in problem.error_shapes]
    return tuple(
        Proof(Sigma=Sigma, rate=rate)
        if each is None
        else Proof(Sigma=Sigma, rate=rate, shares=_rounded_down(each.multipliers), inputs=each.inputs)
        for (Sigma, rate), each in zip(sets, designs, strict=True)
    )


def _updates(errors: ErrorSet) -> Updates | None:
    if errors.contract is None:
        return None
    return Updates(
        contract=errors.contract,
        last=errors.shapes[-1],
        gains=errors.gains,
        shares=errors.multipliers,
        noise=errors.noise,
    )


def fields_of_plant(plant: LinearPlant, errors: ErrorSet) -> dict[str, Any]:
    """Returns the fields of a certificate that set and gain have no part in, with how it was made."""
    solver = f"Clarabel {version('clarabel')} through cvxpy {version('cvxpy')}"
    known: dict[str, Any] = {"source": "docs/shield_proof.md", "solver": solver}
    return {
        "updates": _updates(errors),
        "fingerprint": plant.fingerprint,
        "provenance": known | ({"assumptions": list(plant.assumptions)} if plant.assumptions else {}),
    }


def ellipsoid_size(plant: LinearPlant, L: np.ndarray) -> dict[str, Any]:
    """Returns the record of how large an ellipsoid, shape (n, n), is."""
    volume, share = _volume_of(plant, L), share_of_box(plant, L)
    sizes = ({} if math.isnan(volume) else {"volume_of_box_ellipsoid": volume}) | share
    known = {name: float(exact.rounded(size, _SHOWN_DIGITS)) for name, size in sizes.items()}
    return known | ({} if share else reach_recorded(Ellipsoid(L), plant))


def share_of_box(plant: LinearPlant, L: np.ndarray) -> dict[str, float]:
    """Returns the record of the share of the safe box's volume that E(L) fills: pi/4 of a plane's at most.

    With delayed inputs it is `share_of_box_at_rest`, that of the other states with no input under way. There is none of
    flat sets, and of boxes that are open or have more rows than states.
    """
    kept = plant.n - plant.past
    C = plant.box[plant.box[:, :kept].any(axis=1)] if plant.past else plant.box
    is_box = len(C) == kept and not C[:, kept:].any() and np.isfinite(plant.box_ends).all()
    if not is_box or exact.rank(C[:, :kept]) < kept or not np.linalg.slogdet(L)[0] > 0.0:
        return {}
    L = np.linalg.inv(np.linalg.inv(L)[:kept, :kept]) if plant.past else L
    sides = abs(float(np.linalg.det(C[:, :kept] @ np.linalg.cholesky(L))))  # in units of the cube's [-1, 1]^n
    share = math.pi ** (kept / 2) / math.gamma(kept / 2 + 1) / (2.0**kept / sides)
    return {"share_of_box_at_rest" if plant.past else "share_of_box": share}


def reach_recorded(safe_set: Ellipsoid | Polytope, plant: LinearPlant) -> dict[str, Any]:
    """Returns the record of how far limited quantities get inside a set, for a certificate; none if a solver fails."""
    with suppress(ValueError):
        return {"reach": [str(each) for each in reach_in(safe_set, plant)]}
    return {}


def _volume_of(plant: LinearPlant, L: np.ndarray) -> float:
    """Returns the volume of an ellipsoid in units of the largest one in the box; NaN if the box has no center."""
    middle, half = 0.5 * plant.box_ends.sum(axis=0), 0.5 * np.ptp(plant.box_ends, axis=0)
    if not np.isfinite(half).all() or exact.rank(plant.box) < plant.n:
        return math.nan
    widths = plant.half_widths
    center = widths * np.linalg.lstsq(plant.box * widths, middle, rcond=None)[0]
    if (np.abs(plant.box @ center - middle) > 1e-9 * half).any():
        return math.nan
    units = np.outer(widths, widths)
    own = largest_box_ellipsoid(plant.box * widths / half[:, None])
    return float(np.linalg.det(np.linalg.solve(own, L / units)) ** 0.5)


def gain_in_digits(K: np.ndarray, plant: LinearPlant) -> np.ndarray:
    """Returns a gain, (m, n), with entries of few digits, each state in a power of ten of about its limit."""
    units = np.array([float(f"1e{int(np.floor(np.log10(width)))}") for width in plant.half_widths])
    return exact.rounded(K * units, DIGITS, axis=1) / units


def shape_in_digits(L: np.ndarray) -> np.ndarray:
    """Returns a shape, (n, n), with entries of few digits."""
    extents = np.array([float(exact.rounded(extent, 1)) for extent in np.sqrt(np.diag(L))])
    units = np.outer(extents, extents)
    return np.round(L / units, DIGITS) * units


def _rounded_down(multipliers: tuple[float, float, float]) -> np.ndarray:
    """Returns multipliers of few digits, so much smaller that rounding cannot lift lx + le + ld above 1."""
    return np.array([float(exact.rounded((1.0 - 1e-11) * each, DIGITS)) for each in multipliers])
