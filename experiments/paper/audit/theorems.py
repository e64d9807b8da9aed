"""Rows about Definition 4 at kappa = 1 and about the "only if" of Theorem 5, each with an exact counterexample."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from experiments.paper.audit.claim import Claim, Defect, Verdict
from experiments.paper.audit.invariance import text_of
from experiments.paper.counterexample import worst_step
from experiments.paper.paper_example import PaperExample
from experiments.paper.sets import Ball, Box
from shields.paper.bounds import safety_margin
from shields.verification.rational_matrix import (
    Matrix,
    add,
    congruence,
    is_positive_semidefinite,
    multiply,
    quadratic,
    rational,
    scale,
    subtract,
    to_float,
    transpose,
)

# A contraction factor just below 1.
_ALMOST_ONE = 0.9999


@dataclass(frozen=True)
class OnlyIfExample:
    """A set, a closed loop and bounds on which to try the "only if" of Theorem 5, in rational numbers.

    Attributes:
        M: Matrix of the set {x : x'Mx <= 1}.
        closed_loop: A + B K.
        radius: The square root of gamma, and of epsilon.
        state: A state x of the set, a row, whose image shows how large kappa must be for (Cond.A).
        witness: A point z with z'Mz <= that kappa, a row, from which d + e along `outwards` leave the set.
        outwards: Unit vector, a row.
        weight: Weight of the closed loop's image in the ellipsoid around the sum, in (0, 1).
    """

    M: Matrix
    closed_loop: Matrix
    radius: Fraction
    state: Matrix
    witness: Matrix
    outwards: Matrix
    weight: Fraction

    @property
    def is_invariant(self) -> bool:
        """Whether the set is proved invariant: the sum of the image of the set and of d + e lies in it.

        d + e fills the ball of twice the radius, and the sum lies in the ellipsoid of shape
        image / weight + ball / (1 - weight), for each weight; M is diagonal, and so is inverted exactly.
        """
        size = len(self.M)
        shape = [[1 / self.M[i][i] if i == j else Fraction(0) for j in range(size)] for i in range(size)]
        identity = [[Fraction(i == j) for j in range(size)] for i in range(size)]
        image = scale(1 / self.weight, congruence(self.closed_loop, shape))
        ball = scale((2 * self.radius) ** 2 / (1 - self.weight), identity)
        return is_positive_semidefinite(subtract(subtract(shape, image), ball))

    @property
    def least_kappa(self) -> Fraction:
        """The kappa that (Cond.A) needs at least, from `state`."""
        image = multiply(self.state, transpose(self.closed_loop))
        return quadratic(image, self.M) / quadratic(self.state, self.M)

    @property
    def witness_level(self) -> Fraction:
        """(z + d + e)'M(z + d + e) at the witness of (Cond.B)."""
        return quadratic(add(self.witness, scale(2 * self.radius, self.outwards)), self.M)

    @property
    def breaks_condition(self) -> bool:
        """Whether every kappa that meets (Cond.A) breaks (Cond.B)."""
        return quadratic(self.witness, self.M) <= self.least_kappa and self.witness_level > 1


def _diagonal(first: Fraction, second: Fraction) -> Matrix:
    return [[first, Fraction(0)], [Fraction(0), second]]


ONLY_IF = OnlyIfExample(
    M=_diagonal(Fraction(1), Fraction(100)),
    closed_loop=_diagonal(Fraction(9, 10), Fraction(0)),
    radius=Fraction(1, 50),
    state=[[Fraction(1), Fraction(0)]],
    witness=[[Fraction(0), Fraction(9, 100)]],
    outwards=[[Fraction(0), Fraction(1)]],
    weight=Fraction(5, 6),
)


def margin_claim(example: PaperExample) -> Claim:
    """Returns the row about alpha at kappa = 1."""
    gamma = example.plant.gamma
    at_one = safety_margin(gamma, example.epsilon, 1.0)
    factor = _shown_upwards(least_contracting_gain(example))
    closed = example.A + factor * example.B @ example.K
    step = worst_step(closed, example.M, Box(example.disturbance_half_widths), Ball(0.0))
    fails = at_one == 0.0 and contracts(closed, example.M) and step.confirmed
    return Claim(
        "Definition 4: no margin is needed at kappa = 1",
        "alpha = 0 if kappa = 1; the proof (its case 2): (Cond.B) then holds only if gamma = epsilon = 0",
        f"alpha = {safety_margin(gamma, example.epsilon, _ALMOST_ONE):.2g} at kappa = {_ALMOST_ONE}, {at_one:g} at "
        f"kappa = 1. With {factor:g} K in place of K, (C1) holds at kappa = 1, and with e = 0 and d in the box of "
        f"Section 5 the worst x+'M x+ = {step.level:.4f}; {text_of(step)}",
        Verdict.FAILS if fails else Verdict.UNDECIDED,
        "right if gamma = epsilon = 0; at kappa = 1 epsilon itself is infinite (Theorem 2 divides by 1 - kappa rho)",
        Defect.NO_MARGIN_AT_ONE if fails else "",
    )


def least_contracting_gain(example: PaperExample) -> float:
    """Returns the least t in [0, 1] for which the gain t K meets (C1) at kappa = 1, up to 2^-40 and never too small."""
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        is_enough = contracts(example.A + middle * example.B @ example.K, example.M)
        low, high = (low, middle) if is_enough else (middle, high)
    return high


def _shown_upwards(factor: float) -> float:
    """Returns a factor rounded up to four decimals, so that the row is about the number that it shows."""
    return math.ceil(1e4 * factor) / 1e4


def contracts(closed: np.ndarray, M: np.ndarray) -> bool:
    """Returns whether (A+BK)'M(A+BK) <= M, which is (C1) at kappa = 1, in exact arithmetic."""
    exact_M = rational(M)
    return is_positive_semidefinite(subtract(exact_M, congruence(transpose(rational(closed)), exact_M)))


def equivalence_claim(example: OnlyIfExample = ONLY_IF) -> Claim:
    """Returns the row about "if and only if" in Theorem 5."""
    fails = example.is_invariant and example.breaks_condition
    ball = Ball(float(example.radius**2))
    worst = worst_step(to_float(example.closed_loop), to_float(example.M), ball, ball)
    return Claim(
        "Theorem 5: a set is invariant only if some kappa meets (Cond.A) and (Cond.B)",
        "if and only if there exists a kappa in (0, 1]",
        f"M = {_entries(example.M)}, A+BK = {_entries(example.closed_loop)}, d + e in the ball of radius "
        f"{float(2 * example.radius):g}: the set is {'' if example.is_invariant else 'not proved '}invariant (worst "
        f"x+'M x+ = {worst.level:.3f}), but (Cond.A) needs kappa >= {float(example.least_kappa):g}, and from z = "
        f"{to_float(example.witness)[0].tolist()} (Cond.B) then reaches {float(example.witness_level):.2f} > 1. Both "
        "are shown in exact arithmetic",
        Verdict.FAILS if fails else Verdict.UNDECIDED,
        'the "if" is true, and all that OP needs',
        Defect.ONLY_IF if fails else "",
    )


def _entries(matrix: Matrix) -> str:
    """Returns a diagonal matrix in words."""
    return f"diag({', '.join(f'{float(row[i]):g}' for i, row in enumerate(matrix))})"
