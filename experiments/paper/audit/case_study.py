"""Rows about the case study itself: its disturbance, its sensor, and what it can demonstrate."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from experiments.paper.audit.claim import Claim, Defect, Verdict
from experiments.paper.audit.late_packets import largest_error, taken_as_current
from experiments.paper.paper_example import PaperExample

# Variances of the sensor noise that the paper does not print; its row shows what they change.
_NOISE_VARIANCES = (1e-5, 1e-4, 1e-3)


def disturbance_claim(example: PaperExample) -> Claim:
    """Returns the row about Delta(gamma), a ball in (3) and a box in Section 5."""
    gamma, widths = example.plant.gamma, example.disturbance_half_widths
    box = " x ".join(f"[-{width:g}, {width:g}]" for width in widths)
    fraction = float(np.prod(2.0 * widths) / (np.pi * gamma))
    fails = fraction < 1.0
    return Claim(
        "Delta(gamma) is the same set in (3) and in Section 5",
        f"Delta(gamma) = {{d : d'd <= gamma}} in (3), {box} in Section 5; gamma is not printed",
        f"one is a ball, the other a box; the smallest ball around the box has gamma = {widths @ widths:g}, and the "
        f"box fills {100 * fraction:.0f} % of its area",
        Verdict.of(not fails),
        f"the audit reads gamma = {gamma:g}, and in rows 7 and 13 the box itself, where that favors the paper",
        Defect.BALL_OR_BOX if fails else "",
    )


def sensor_claim(example: PaperExample) -> Claim:
    """Returns the row about H and R, which the paper does not print."""
    assumed = float(example.plant.measurement_noise_cov[0, 0])
    errors = [largest_error(example, taken_as_current, noise_variance=variance) for variance in _NOISE_VARIANCES]
    return Claim(
        "the sensor of the simulation (H and R of Definition 1)",
        "neither H nor R",
        f"H = I and R = {assumed:g} I are our assumptions. Row 16 alone rests on them: with R = "
        f"{_NOISE_VARIANCES[0]:g} I to {_NOISE_VARIANCES[-1]:g} I its max e'e with late packets taken as current is "
        f"{min(errors):.3f} to {max(errors):.3f}",
        Verdict.NOT_PRINTED,
    )


def box_claim(example: PaperExample) -> Claim:
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
    """Returns the largest |x_i+| = |A_i x + d_i| over the safe box with u = 0, shape (2,).

    It is sum_j |A_ij| w_j + sqrt(D_ii), with w_j the half-widths of the box and E(D) the bound of the disturbance and
    the truncated process noise together.
    """
    plant = example.plant
    return np.abs(example.A) @ _half_widths(example) + np.sqrt(np.diag(plant.disturbance.shape))


def box_is_invariant(example: PaperExample) -> bool:
    """Returns whether exact arithmetic shows that with u = 0 no state leaves the safe box |x_i| <= w_i."""
    widths = [Fraction(float(width)) for width in _half_widths(example)]
    for row, variance, own in zip(example.A, np.diag(example.plant.disturbance.shape), widths, strict=True):
        left = own - sum(abs(Fraction(float(entry))) * width for entry, width in zip(row, widths, strict=True))
        if left < 0 or left**2 < Fraction(float(variance)):
            return False
    return True


def _half_widths(example: PaperExample) -> np.ndarray:
    """Returns the half-widths w_i of the safe box, whose rows are c_i = e_i / w_i with powers of two, shape (2,)."""
    return 1.0 / np.diag(example.plant.C)
