"""The audit of Liu et al.: each claim of the paper beside what its own numbers give, all computed here.

`CLAIMS` is the table, in order, with a function per row; the texts refer to one another by row number. docs/paper.md
discusses the outcome.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from fractions import Fraction

import numpy as np

from experiments.paper.counterexample import (
    ONLY_IF,
    Ball,
    Box,
    OneStep,
    OnlyIfExample,
    contracts,
    stays_inside,
    worst_step,
)
from experiments.paper.late_packets import STARTS, STEPS, discarded, largest_error, replayed, taken_as_current
from experiments.paper.paper_example import PaperExample
from ncs_gym.ellipsoid import truncation_energy
from shields.paper.bounds import PaperBounds, PaperModel, safety_margin
from shields.paper.feasibility import FeasibilityScan, largest_scale
from shields.paper.optimization_problem import OptimizationProblem
from shields.verification.rational_matrix import Matrix, to_float

# Agreement within the last printed digit of a four-digit number.
_PRINTED_DIGITS = 5e-5
# A contraction factor just below 1.
_ALMOST_ONE = 0.9999
# How often the filters are simulated with late packets.
_SEEDS = 4
# Variances of the sensor noise that the paper does not print; its row shows what they change.
_NOISE_VARIANCES = (1e-5, 1e-4, 1e-3)


class Verdict(StrEnum):
    """What became of a claim: undecided depends on a choice left open, vacuous holds without what it should show."""

    HOLDS = "holds"
    ROUNDED = "holds, rounded"
    FAILS = "does not hold"
    UNDECIDED = "undecided"
    NOT_PRINTED = "not printed"
    VACUOUS = "vacuous"

    @classmethod
    def of(cls, holds: bool) -> Verdict:
        """Returns HOLDS or FAILS."""
        return cls.HOLDS if holds else cls.FAILS


class Defect(StrEnum):
    """What is wrong with the paper; several rows can show the same."""

    INPUT_LIMIT = "the printed K is OP's optimum for |u| <= 6, not for the limit of 4"
    MARGIN = "(C2), the margin for disturbance and error, is not met and cannot be met at the printed bounds"
    EPSILON = "the printed epsilon is not the one that Theorems 2 and 3 give"
    NO_MARGIN_AT_ONE = "Definition 4 demands no margin at kappa = 1, against its own proof"
    ONLY_IF = "the condition of Theorem 5 is sufficient, but not necessary"
    BALL_OR_BOX = "Delta(gamma) is a ball in (3) and a box in Section 5"


@dataclass(frozen=True)
class Claim:
    """One claim of the paper and its verdict.

    Attributes:
        claim: What the paper says.
        printed: What the paper prints.
        computed: What follows from the paper's own numbers.
        verdict: A `Verdict`.
        charitable: Under which other reading it would hold, or how near it comes; empty if there is none.
        defect: The `Defect` that the row shows where the claim does not hold.
    """

    claim: str
    printed: str
    computed: str
    verdict: str
    charitable: str = ""
    defect: str = ""

    def __post_init__(self) -> None:
        if self.verdict != Verdict.FAILS:
            object.__setattr__(self, "defect", "")


def audited_claims(example: PaperExample) -> Iterator[Claim]:
    """Yields the claims in order, all computed from the printed numbers."""
    return (claim(example) for claim in CLAIMS)


def defects(claims: Sequence[Claim]) -> dict[str, list[int]]:
    """Returns the distinct defects in order of appearance, each with the numbers, from 1, of the rows that show it."""
    found: dict[str, list[int]] = {}
    for number, claim in enumerate(claims, 1):
        if claim.verdict == Verdict.FAILS:
            found.setdefault(claim.defect, []).append(number)
    return found


def _discretization(example: PaperExample) -> Claim:
    plant = example.plant
    gap = max(np.abs(plant.A - example.A).max(), np.abs(plant.B - example.B).max())
    return Claim(
        "A and B discretize the spring-damper coupling with dt = 0.5 s",
        f"A = {example.A.tolist()}, B = {example.B.ravel().tolist()}",
        f"the exact zero-order hold differs by at most {gap:.1e}",
        Verdict.of(gap <= _PRINTED_DIGITS),
    )


def _contraction(example: PaperExample) -> Claim:
    """Of (C1), with the smallest kappa for which (A+BK)'M(A+BK) <= kappa M."""
    closed_loop, root = example.closed_loop, np.linalg.cholesky(example.M)
    inner = np.linalg.solve(root, closed_loop.T @ example.M @ closed_loop)
    kappa = float(np.linalg.eigvals(np.linalg.solve(root, inner.T).T).real.max())
    is_rounding = 0.0 < kappa - example.kappa <= 2 * _PRINTED_DIGITS
    return Claim(
        "(C1) the closed loop contracts by kappa",
        f"kappa = {example.kappa}",
        f"the largest eigenvalue of (A+BK)'M(A+BK) against M is {kappa:.5f}",
        Verdict.ROUNDED if is_rounding else Verdict.of(kappa <= example.kappa),
        "the excess is within a unit of the last printed digit" if is_rounding else "",
    )


def _margin(example: PaperExample) -> Claim:
    gamma = example.plant.gamma
    alpha = safety_margin(gamma, example.epsilon, example.kappa)
    smallest = float(np.linalg.eigvalsh(example.L)[0])
    root = smallest**0.5 * (1.0 - example.kappa**0.5) - example.epsilon**0.5
    return Claim(
        "(C2) L >= alpha I, the margin for disturbance and error",
        f"gamma = {gamma:g}, epsilon = {example.epsilon}, kappa = {example.kappa}",
        f"alpha = {alpha:.3f}, but lambda_min(L) = {smallest:.3f}",
        Verdict.of(smallest >= alpha),
        f"it would hold for gamma <= {max(root, 0.0) ** 2:.2g}, or with gamma in place of its square root (alpha = "
        f"{_misread_alpha(example):.2f}), with which row 12 reproduces K and M",
        Defect.MARGIN,
    )


def _misread_alpha(example: PaperExample) -> float:
    return ((example.plant.gamma + example.epsilon**0.5) / (1.0 - example.kappa**0.5)) ** 2


def _safe_box(example: PaperExample) -> Claim:
    plant, L = example.plant, example.L
    largest = max(float(row @ L @ row) for row in plant.box)
    rounded = max(float(row @ np.linalg.inv(example.M - _PRINTED_DIGITS * np.eye(2)) @ row) for row in plant.box)
    is_rounding = 1.0 < largest <= rounded
    return Claim(
        "(C3) the set lies in the safe box",
        "|x1| <= 2 m, |x2| <= 2 m/s",
        f"the largest c_j L c_j' is {largest:.6f}",
        Verdict.ROUNDED if is_rounding else Verdict.of(largest <= 1.0),
        f"M is printed to four digits: up to {rounded:.4f} is their rounding" if is_rounding else "",
    )


def _half_input_limit(example: PaperExample) -> Claim:
    effort, half = _effort(example.K, example.L), float(example.plant.largest_input[0]) ** 2 / 2
    claim = "(C5) half of the squared input limit covers K x", f"u_max^2 / 2 = {half:g}", f"K L K' = {effort:.2f}"
    return _limited(*claim, effort <= half)


def _input_limit(example: PaperExample) -> Claim:
    largest, limit = _effort(example.K, example.L) ** 0.5, float(example.plant.largest_input[0])
    computed = f"the largest |K x| on the set is {largest:.2f}, without any estimation error"
    return _limited("the input stays within its limit on the set", f"|u| <= {limit:g}", computed, largest <= limit)


def _effort(K: np.ndarray, L: np.ndarray) -> float:
    """Returns K L K', the largest (K x)^2 on the set."""
    return float((K @ L @ K.T).item())


def _limited(claim: str, printed: str, computed: str, holds: bool) -> Claim:
    explained = "" if holds else "row 12 explains rows 5 and 6 together: K is OP's optimum for another limit"
    return Claim(claim, printed, computed, Verdict.of(holds), explained, Defect.INPUT_LIMIT)


def invariance(example: PaperExample) -> Claim:
    """Returns the row about Definition 3 with every error."""
    closed_loop, M, ball = example.closed_loop, example.M, Ball(example.plant.gamma)
    step = worst_step(closed_loop, M, Box(example.disturbance_half_widths), Ball(example.epsilon))
    alone = worst_step(closed_loop, M, Box(example.disturbance_half_widths), Ball(0.0)).level
    stays = not step.confirmed and stays_inside(closed_loop, M, ball, Ball(example.epsilon))
    return Claim(
        "the set is (gamma, epsilon)-RSI (Definition 3): every e with e'e <= epsilon",
        "x+ in S for all x in S, d, e",
        f"worst x+'M x+ = {step.level:.4f} with d in the box of Section 5, {alone:.3f} with e = 0; {_text_of(step)}",
        Verdict.FAILS if step.confirmed else Verdict.HOLDS if stays else Verdict.UNDECIDED,
        "row 8 reads Definition 3 with the errors that can occur" if step.confirmed else "",
        Defect.MARGIN,
    )


def _reachable_invariance(example: PaperExample) -> Claim:
    closed_loop, M, ball = example.closed_loop, example.M, Ball(example.plant.gamma)
    reachable = Ball(example.epsilon, along=example.B[:, 0])
    level = worst_step(closed_loop, M, ball, reachable).level
    stays = stays_inside(closed_loop, M, ball, reachable)
    return Claim(
        "the same for the errors that can occur: e = B K e_up lies in the range of B",
        "x+ in S for all x in S, d, e",
        f"worst x+'M x+ = {level:.3f} with d in the whole ball of (3), if the input is not limited"
        + (" (proved in exact arithmetic)" if stays else ""),
        Verdict.HOLDS if stays else Verdict.UNDECIDED,
    )


def _text_of(step: OneStep) -> str:
    x, d, e, end = (v.tolist() for v in (step.state, step.disturbance, step.error, np.round(step.following, 4)))
    start = f"x = {x}, d = {d}" + (f", e = {e}" if np.any(step.error) else "")
    confirmed = "confirmed in exact arithmetic" if step.confirmed else "not confirmed exactly"
    return f"for example {start} go to x+ = {end} ({confirmed})"


def _error_bound(example: PaperExample) -> Claim:
    model, norm = PaperModel(example.plant), _gain_norm(example)
    least, tight = model.at(example.kappa, 1.0).epsilon, example.kappa * float(np.linalg.cond(example.L))
    return Claim(
        "epsilon is the bound of Theorems 2 and 3 at the printed P0, Q, gamma and delta",
        f"epsilon = {example.epsilon}",
        f"with g_bar^2 = kappa rho >= {example.kappa} the theorems give epsilon >= {least:.3f}",
        Verdict.of(least <= example.epsilon),
        f"a valid bound once K is known: with the actual |BK| = {norm:.3f} in place of Theorem 3's bound on it "
        f"{norm**2 * model.epsilon_up(tight):.4f} for g_bar^2 = kappa cond(L)",
        Defect.EPSILON,
    )


def simulated_error(example: PaperExample) -> Claim:
    """Returns the row about the largest error of the paper's simulation."""
    least, norm = PaperModel(example.plant).at(example.kappa, 1.0), _gain_norm(example)
    needed = example.largest_error / norm**2
    implied, read_otherwise = example.epsilon * least.epsilon_up / least.epsilon, example.epsilon / norm**2
    return Claim(
        "the largest simulated error agrees with the bounds",
        f"max e'e = {example.largest_error} < epsilon = {example.epsilon}",
        f"it needs e_up'e_up >= {needed:.4f}; the printed epsilon implies at most {implied:.4f} through Theorem 3, but "
        f"up to {read_otherwise:.3f} under the reading of row 9, with the actual |BK|",
        Verdict.HOLDS if needed <= implied else Verdict.UNDECIDED if needed <= read_otherwise else Verdict.FAILS,
        f"no contradiction under either reading if {example.largest_error} is a norm, not its square",
        Defect.EPSILON,
    )


def _gain_norm(example: PaperExample) -> float:
    return float(np.linalg.norm(example.B @ example.K, 2))


def _feasibility(example: PaperExample) -> Claim:
    """Of OP as printed, and under the most charitable reading of its bounds."""
    plant = example.plant
    scan = FeasibilityScan(plant)
    best, tail = scan.best(plant), truncation_energy(1.0 - plant.delta, plant.n)
    fails, model = best.ratio < 1.0, PaperModel(plant, quantile=tail)
    at_tail, is_feasible = scan.best(plant, model), scan.full_ratio(plant, model) >= 1.0
    return Claim(
        "OP is feasible at the printed parameters",
        "Algorithm 1 returned K and M",
        f"{'in' * fails}feasible under the theorem as printed: over all (kappa, rho) the largest lambda_min(L)/alpha "
        f"is {best.ratio:.3f}, at least 1 is needed; feasible with gamma, Q and P0 all scaled by "
        f"{largest_scale(scan, plant):.3f}",
        Verdict.of(not fails),
        f"with the tail taken at delta instead of 1 - delta (chi2 = {tail:.3f} instead of "
        f"{plant.process_noise.energy:.2f}), the ratio is {at_tail.ratio:.2f} and OP is "
        f"{'' if is_feasible else 'not '}feasible, though with epsilon = "
        f"{model.at(at_tail.kappa, at_tail.rho).epsilon:.4f} and another K",
        Defect.MARGIN,
    )


def design(example: PaperExample) -> Claim:
    """Returns the row about K and M as the optimum of OP at the printed kappa."""
    asked, limit = (2.0 * _effort(example.K, example.L)) ** 0.5, float(example.plant.largest_input[0])
    printed, complete = optimum(example, limit), optimum(example, float(round(asked)), with_misread_margin=True)
    reproduced = np.abs(complete[1] - example.K).max() <= _PRINTED_DIGITS
    return Claim(
        f"K and M are the optimum of OP at kappa = {example.kappa}",
        _design_text(example.L, example.K),
        f"without (C2) and (C4), which alpha enters, the optimum at u_max = {limit:g} has {_design_text(*printed)}. As "
        f"sqrt(2 K L K') = {asked:.3f}, try u_max = {round(asked)}, and gamma in place of its square root in alpha "
        f"(alpha = {_misread_alpha(example):.2f}): all of OP gives {_design_text(*complete)}",
        Verdict.of(bool(np.abs(printed[1] - example.K).max() <= _PRINTED_DIGITS)),
        f"within the rounding of kappa they are OP's optimum for u_max = {round(asked)} and that alpha: the first "
        "explains rows 5 and 6, the second rows 3 and 7"
        if reproduced
        else "",
        Defect.INPUT_LIMIT,
    )


def optimum(example: PaperExample, u_max: float, *, with_misread_margin: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Returns L, shape (2, 2), and K, (1, 2), of the largest set that OP finds at the printed kappa and another u_max.

    With the misread margin all of OP counts, with gamma in place of its square root in alpha; without it neither (C2)
    nor (C4), which alpha enters, and so no communication error in the input limit.

    Raises:
        ArithmeticError: If the solver finds no optimum.
    """
    plant = replace(example.plant, limits=replace(example.plant.limits, input=u_max))
    # The smallest rho, to two digits, that (C7) allows for the printed set.
    rho = float(np.ceil(100.0 * np.linalg.cond(example.L)) / 100.0)
    g_bar = (example.kappa * rho) ** 0.5
    epsilon_up = example.epsilon / (g_bar + float(np.linalg.norm(plant.A, 2))) ** 2  # Theorem 3, solved for epsilon_up
    if not with_misread_margin:
        rho = 1.0 / example.kappa
    bounds = PaperBounds(example.kappa, rho, epsilon_up, example.epsilon, _misread_alpha(example))
    found = OptimizationProblem(plant).solution(bounds, with_error=with_misread_margin)
    if found is None:
        raise ArithmeticError(f"the solver found no optimum of OP at u_max = {u_max:g}")
    return found.L, found.K


def _design_text(L: np.ndarray, K: np.ndarray) -> str:
    gain = ", ".join(f"{entry:.4f}" for entry in K.ravel())
    return f"K = [{gain}], M12 = {float(np.linalg.inv(L)[0, 1]):.2e}, K L K' = {_effort(K, L):.2f}"


def margin_at_one(example: PaperExample) -> Claim:
    """Returns the row about alpha at kappa = 1."""
    gamma = example.plant.gamma
    at_one = safety_margin(gamma, example.epsilon, 1.0)
    factor = math.ceil(1e4 * least_contracting_gain(example)) / 1e4  # the row is about the number that it shows
    closed = example.A + factor * example.B @ example.K
    step = worst_step(closed, example.M, Box(example.disturbance_half_widths), Ball(0.0))
    fails = at_one == 0.0 and contracts(closed, example.M) and step.confirmed
    return Claim(
        "Definition 4: no margin is needed at kappa = 1",
        "alpha = 0 if kappa = 1; the proof (its case 2): (Cond.B) then holds only if gamma = epsilon = 0",
        f"alpha = {safety_margin(gamma, example.epsilon, _ALMOST_ONE):.2g} at kappa = {_ALMOST_ONE}, {at_one:g} at "
        f"kappa = 1. With {factor:g} K in place of K, (C1) holds at kappa = 1, and with e = 0 and d in the box of "
        f"Section 5 the worst x+'M x+ = {step.level:.4f}; {_text_of(step)}",
        Verdict.FAILS if fails else Verdict.UNDECIDED,
        "right if gamma = epsilon = 0; at kappa = 1 epsilon itself is infinite (Theorem 2 divides by 1 - kappa rho)",
        Defect.NO_MARGIN_AT_ONE,
    )


def least_contracting_gain(example: PaperExample) -> float:
    """Returns the least t in [0, 1] for which the gain t K meets (C1) at kappa = 1, up to 2^-40 and never too small."""
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        is_enough = contracts(example.A + middle * example.B @ example.K, example.M)
        low, high = (low, middle) if is_enough else (middle, high)
    return high


def equivalence(_: PaperExample, example: OnlyIfExample = ONLY_IF) -> Claim:
    """Returns the row about "if and only if" in Theorem 5, which an example of our own decides."""
    ball = Ball(float(example.radius**2))
    worst = worst_step(to_float(example.closed_loop), to_float(example.M), ball, ball)
    return Claim(
        "Theorem 5: a set is invariant only if some kappa meets (Cond.A) and (Cond.B)",
        "if and only if there exists a kappa in (0, 1]",
        f"M = {_diagonal_text(example.M)}, A+BK = {_diagonal_text(example.closed_loop)}, d + e in the ball of radius "
        f"{float(2 * example.radius):g}: the set is {'' if example.is_invariant else 'not proved '}invariant (worst "
        f"x+'M x+ = {worst.level:.3f}), but (Cond.A) needs kappa >= {float(example.least_kappa):g}, and from z = "
        f"{to_float(example.witness)[0].tolist()} (Cond.B) then reaches {float(example.witness_level):.2f} > 1. Both "
        "are shown in exact arithmetic",
        Verdict.FAILS if example.is_invariant and example.breaks_condition else Verdict.UNDECIDED,
        'the "if" is true, and all that OP needs',
        Defect.ONLY_IF,
    )


def _diagonal_text(matrix: Matrix) -> str:
    return f"diag({', '.join(f'{float(row[i]):g}' for i, row in enumerate(matrix))})"


def disturbance_set(example: PaperExample) -> Claim:
    """Returns the row about Delta(gamma), a ball in (3) and a box in Section 5."""
    gamma, widths = example.plant.gamma, example.disturbance_half_widths
    box = " x ".join(f"[-{width:g}, {width:g}]" for width in widths)
    fraction = float(np.prod(2.0 * widths) / (np.pi * gamma))
    return Claim(
        "Delta(gamma) is the same set in (3) and in Section 5",
        f"Delta(gamma) = {{d : d'd <= gamma}} in (3), {box} in Section 5; gamma is not printed",
        f"one is a ball, the other a box; the smallest ball around the box has gamma = {widths @ widths:g}, and the "
        f"box fills {100 * fraction:.0f} % of its area",
        Verdict.of(fraction >= 1.0),
        f"the audit reads gamma = {gamma:g}, and in rows 7 and 13 the box itself, where that favors the paper",
        Defect.BALL_OR_BOX,
    )


def late_packets(example: PaperExample) -> Claim:
    """Returns the row about the error bound under delay, simulated with each reading of Definition 1's filter."""
    current, skipped, again = (
        [largest_error(example, make, seed=seed) for seed in range(_SEEDS)]
        for make in (taken_as_current, discarded, replayed)
    )
    holds = max(current + skipped + again) <= example.epsilon
    return Claim(
        "the error stays within epsilon with packets that arrive two steps late",
        f"e'e < epsilon = {example.epsilon}, with the filter of Definition 1, which has no late packets",
        f"simulated with the printed K ({_SEEDS} times {STARTS} starts, {STEPS} steps): max e'e = {min(current):.3f} "
        f"to {max(current):.3f} if the filter takes late packets as current; at most {max(skipped):.5f} if it discards "
        f"them, and {max(again):.5f} if it goes back to the step of the sample and replays",
        Verdict.HOLDS if holds else Verdict.UNDECIDED,
        "" if holds else "the paper does not say what its filter does with a late packet",
    )


def sensor(example: PaperExample) -> Claim:
    """Returns the row about H and R, which the paper does not print."""
    assumed = float(example.plant.sensor_noise.covariance[0, 0])
    errors = [largest_error(example, taken_as_current, noise_variance=variance) for variance in _NOISE_VARIANCES]
    return Claim(
        "the sensor of the simulation (H and R of Definition 1)",
        "neither H nor R",
        f"H = I and R = {assumed:g} I are our assumptions. Row 16 alone rests on them: with R = "
        f"{_NOISE_VARIANCES[0]:g} I to {_NOISE_VARIANCES[-1]:g} I its max e'e with late packets taken as current is "
        f"{min(errors):.3f} to {max(errors):.3f}",
        Verdict.NOT_PRINTED,
    )


def demonstration(example: PaperExample) -> Claim:
    """Returns the row about what the case study can demonstrate."""
    widths, reached = _half_widths(example), farthest_without_input(example)
    proved = box_is_invariant(example)
    return Claim(
        "the simulation demonstrates that the controller keeps the state safe over the network",
        "all trajectories remain within the set, under packet loss, quantization, delay and a transmission period of 2",
        f"with u = 0 and no packet at all no state leaves the safe box: from every state of |x1| <= {widths[0]:g} m, "
        f"|x2| <= {widths[1]:g} m/s, |x1+| <= {reached[0]:.3f} m and |x2+| <= {reached[1]:.3f} m/s for every "
        f"disturbance and truncated process noise ({'shown' if proved else 'not shown'} in exact arithmetic)",
        Verdict.VACUOUS if proved else Verdict.UNDECIDED,
        "the printed ellipsoid is a smaller set, whose invariance rows 7 and 8 are about" if proved else "",
    )


def farthest_without_input(example: PaperExample) -> np.ndarray:
    """Returns the largest |A_i x + d_i| over the safe box, sum_j |A_ij| w_j + sqrt(D_ii), shape (2,)."""
    plant = example.plant
    return np.abs(example.A) @ _half_widths(example) + np.sqrt(np.diag(plant.disturbance.shape_matrix))


def box_is_invariant(example: PaperExample) -> bool:
    """Returns whether exact arithmetic shows that with u = 0 no state leaves the safe box |x_i| <= w_i."""
    widths = [Fraction(float(width)) for width in _half_widths(example)]
    for row, variance, own in zip(example.A, np.diag(example.plant.disturbance.shape_matrix), widths, strict=True):
        left = own - sum(abs(Fraction(float(entry))) * width for entry, width in zip(row, widths, strict=True))
        if left < 0 or left**2 < Fraction(float(variance)):
            return False
    return True


def _half_widths(example: PaperExample) -> np.ndarray:
    """Returns the half-widths w_i of the safe box, whose rows are c_i = e_i / w_i with powers of two, shape (2,)."""
    return 1.0 / np.diag(example.plant.box)


CLAIMS: tuple[Callable[[PaperExample], Claim], ...] = (
    *(_discretization, _contraction, _margin, _safe_box, _half_input_limit),  # 1 to 5
    *(_input_limit, invariance, _reachable_invariance, _error_bound, simulated_error),  # to 10
    *(_feasibility, design, margin_at_one, equivalence, disturbance_set),  # to 15
    *(late_packets, sensor, demonstration),
)
