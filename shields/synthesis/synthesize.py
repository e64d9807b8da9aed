"""The certified method: the largest verified invariant ellipsoid, with its gain."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import version

import numpy as np

from ncs_gym import ErrorSet, LinearPlant
from ncs_gym.network.contract import ChannelContract
from ncs_gym.validation import shown
from shields.certificate import AgeProof, Certificate
from shields.errors import Infeasible
from shields.paper.certificate import paper_certificate
from shields.synthesis.design_problem import GROWTH, design_problem
from shields.synthesis.diagnosis import diagnosis, with_what_works
from shields.synthesis.initial_designs import (
    CLOSE_ENOUGH,
    Progress,
    as_shares,
    best_start,
    volume_of,
)
from shields.synthesis.multipliers import as_multipliers, best_input_shares, best_shares, rounded_down
from shields.synthesis.semidefinite_programs import (
    Design,
    InvariantSetProgram,
    ScaledProblem,
    best_gain,
)
from shields.verification.verify import verify

# Slow cases still gain 1 % a turn after ten.
ALTERNATIONS = 40
# An alternation that gains less than this in log det has converged.
SMALLEST_GAIN = 1e-4
# Room for exact verification, tried in turn.
SLACKS = (1e-6, 1e-5, 1e-4, 1e-3)


def synthesize(
    plant: LinearPlant,
    method: str = "certified",
    *,
    contract: ChannelContract | None = None,
    progress: Progress | None = None,
    dkappa: float = 0.02,
    drho: float = 0.05,
    search: str = "first",
) -> Certificate:
    """Returns a verified certificate.

    "certified" (docs/theory.md section 3) looks for the largest ellipsoid with hard bounds; "paper" solves OP of Liu et
    al. as printed with their Algorithm 1, whose certificate carries no error set (docs/paper.md).

    Args:
        plant: The plant with its bounds, Schur stable for "certified" without a contract.
        method: "certified" or "paper".
        contract: The channel's promise, under which the error sets depend on the newest sample's age ("certified").
        progress: Called with a line of text per start and per alternation ("certified").
        dkappa: Step of kappa ("paper").
        drho: Step of rho ("paper").
        search: "first" feasible pair, as printed, or "largest" volume over the grid ("paper").

    Raises:
        Infeasible: If no certificate is found; says what binds and by how much.
        ValueError: If an argument is out of range.
    """
    if not isinstance(plant, LinearPlant):
        raise ValueError(f"plant must be a LinearPlant, got {type(plant).__name__}")
    if not (isinstance(method, str) and method in ("certified", "paper")):
        raise ValueError(f"method must be 'certified' or 'paper', got {shown(method)}")
    if method == "paper":
        certificate = paper_certificate(plant, dkappa=dkappa, drho=drho, search=search)
        exact = {"exact_conditions_hold": _is_certifiable(plant, certificate.L, certificate.K)}
        return replace(certificate, provenance=certificate.provenance | exact)
    if contract is not None and not isinstance(contract, ChannelContract):
        raise ValueError(f"contract must be a ChannelContract or None, got {shown(contract)}")
    return _certified(plant, contract, progress or (lambda line: None))


def _certified(plant: LinearPlant, contract: ChannelContract | None, progress: Progress) -> Certificate:
    """Returns the certificate of the certified method."""
    try:
        problem, errors = design_problem(plant, contract)
    except Infeasible as infeasible:
        raise with_what_works(infeasible, plant, contract) from infeasible
    failure = None
    for slack in SLACKS:
        design = _largest_set(problem, slack, progress)
        if design is None:
            break
        certificate = _certificate(plant, problem, design, errors, slack)
        report = verify(certificate, plant)
        if report.valid:
            return certificate
        failed = next(condition for condition in report.conditions if not condition.holds)
        failure = Infeasible(
            f"a candidate was found, but in exact arithmetic {failed.name} fails by {-failed.margin:.3g}",
            failed.name.split()[0].strip("():"),
            -failed.margin,
        )
    raise failure or with_what_works(diagnosis(problem), plant, contract)


def certify(plant: LinearPlant, L: np.ndarray, K: np.ndarray) -> Certificate | None:
    """Returns a verified certificate for a given set and gain, or None if no multipliers were found that prove it.

    Args:
        plant: The plant with its bounds.
        L: Shape of the safe set, (n, n).
        K: Gain, (m, n).

    Raises:
        Infeasible: If the plant has no error set or its box is unbounded.
    """
    problem, errors = design_problem(plant)
    inverse = np.linalg.inv(problem.transform)
    scaled_L, scaled_K = inverse @ L @ inverse.T, (K @ problem.transform) / problem.u_max[:, None]
    shares, _ = best_shares(problem, problem.Sigmas, scaled_L, scaled_K, (0.9, 0.03, 0.07))
    inputs = best_input_shares(problem.Sigmas, scaled_L, scaled_K)
    design = Design(scaled_L, scaled_K, shares, inputs, float(np.linalg.slogdet(scaled_L)[1]))
    certificate = _certificate(plant, problem, design, errors, 0.0, shape=L, gain=K)
    return certificate if verify(certificate, plant).valid else None


def _is_certifiable(plant: LinearPlant, L: np.ndarray, K: np.ndarray) -> bool:
    """Returns whether our exact conditions hold for a set and gain, as far as multipliers were found."""
    try:
        return certify(plant, L, K) is not None
    except Infeasible:
        return False


def _largest_set(problem: ScaledProblem, slack: float, progress: Progress) -> Design | None:
    """Returns the best design of several starts, improved by alternation and finished; None if no start works."""
    program = InvariantSetProgram(problem, slack)
    best = best_start(problem, program, progress)
    if best is None:
        return None
    step = 0.3
    for turn in range(ALTERNATIONS):
        if -best.log_det < CLOSE_ENOUGH:
            break
        better = _alternate(problem, program, best, step)
        progress(f"alternation {turn + 1} of at most {ALTERNATIONS}: {volume_of(better)}")
        if better.log_det - best.log_det < SMALLEST_GAIN:
            step /= 3.0
            if step < 0.03:
                break
        best = better
    return _finish(problem, best)


def _alternate(problem: ScaledProblem, program: InvariantSetProgram, best: Design, step: float) -> Design:
    """Linearizes at the best L, then tries its own, re-optimized and shifted shares; never returns a worse design."""
    K = best.K
    inputs = best_input_shares(problem.Sigmas, best.L, K)
    tuned, _ = best_shares(problem, problem.Sigmas, best.L, K, best.shares)
    anchor = best.L
    for shares, mu in ((best.shares, best.inputs), (tuned, inputs)):
        best = _better(best, program.solve(shares, mu, anchor))
    lx, le, _ = best.shares
    part = le / (1.0 - lx)
    for factor, shift in ((1.0 + step, 0.0), (1.0 / (1.0 + step), 0.0), (1.0, step), (1.0, -step)):
        state = 1.0 - np.clip((1.0 - lx) * factor, 1e-4, 0.99)
        share = np.clip(part * (1.0 + shift), 1e-3, 0.99)
        best = _better(best, program.solve(as_shares(state, share), best.inputs, best.L))
    return best


def _finish(problem: ScaledProblem, best: Design) -> Design:
    """Keeps L, chooses the gain with the most room, and polishes all shares for it."""
    gains = (best_gain(problem, best), best.K)
    finished = []
    for K in gains:
        shares, worst = best_shares(problem, problem.Sigmas, best.L, K, best.shares)
        inputs = best_input_shares(problem.Sigmas, best.L, K)
        error_effort = np.sqrt(((K @ problem.Sigmas) * K).sum(axis=-1)).max(axis=0)
        effort = (np.sqrt(((K @ best.L) * K).sum(axis=1)) + error_effort).max()
        finished.append((max(worst, effort), replace(best, K=K, shares=shares, inputs=inputs)))
    return min(finished, key=lambda pair: pair[0])[1]


def _certificate(
    plant: LinearPlant,
    problem: ScaledProblem,
    design: Design,
    errors: ErrorSet,
    slack: float,
    *,
    shape: np.ndarray | None = None,
    gain: np.ndarray | None = None,
) -> Certificate:
    """Returns the certificate of a design; `shape` and `gain` replace its own L and K where they were given."""
    L, K = problem.physical(design.L, design.K)
    ages = None
    if errors.ages is not None:
        proofs = [_tuned(problem, design, Sigma[None]) for Sigma in problem.Sigmas]
        shares = np.array([rounded_down(proof.shares) for proof in proofs])
        ages = AgeProof(sets=errors.ages, shares=shares, inputs=np.array([proof.inputs for proof in proofs]))
        design = proofs[-1]
    return Certificate(
        L=L if shape is None else shape,
        K=K if gain is None else gain,
        Sigma=errors.Sigma,
        D=GROWTH * plant.disturbance.shape,
        multipliers=as_multipliers(problem, design, errors.rate),
        ages=ages,
        method="certified",
        fingerprint=plant.fingerprint,
        provenance={
            "source": "docs/theory.md section 3",
            "solver": f"Clarabel {version('clarabel')} through cvxpy {version('cvxpy')}",
            "slack": slack,
            "volume_of_box_ellipsoid": float(np.exp(0.5 * design.log_det)),
        },
    )


def _tuned(problem: ScaledProblem, design: Design, Sigmas: np.ndarray) -> Design:
    """Returns a design with the shares that suit some of its error sets best."""
    shares, _ = best_shares(problem, Sigmas, design.L, design.K, design.shares)
    return replace(design, shares=shares, inputs=best_input_shares(Sigmas, design.L, design.K))


def _better(best: Design, other: Design | None) -> Design:
    return other if other is not None and other.log_det > best.log_det else best
