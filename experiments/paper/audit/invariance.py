"""Rows about the robust safety invariance of the printed set (Definition 3)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from experiments.paper.audit.claim import Claim, Defect, Verdict
from experiments.paper.counterexample import OneStep, stays_inside, worst_step
from experiments.paper.paper_example import PaperExample
from experiments.paper.sets import Ball, Box, Segment


def invariance_claims(example: PaperExample) -> Iterator[Claim]:
    """Yields the rows about every error, and about the errors that can occur."""
    closed_loop, M, ball = example.closed_loop, example.M, Ball(example.plant.gamma)
    every = worst_step(closed_loop, M, Box(example.disturbance_half_widths), Ball(example.epsilon))
    stays = not every.confirmed and stays_inside(closed_loop, M, ball, Ball(example.epsilon))
    yield Claim(
        "the set is (gamma, epsilon)-RSI (Definition 3): every e with e'e <= epsilon",
        "x+ in S for all x in S, d, e",
        f"worst x+'M x+ = {every.level:.4f} with d in the box of Section 5" + (f"; {text_of(every)}"),
        Verdict.FAILS if every.confirmed else Verdict.HOLDS if stays else Verdict.UNDECIDED,
        "row 8 reads Definition 3 with the errors that can occur" if every.confirmed else "",
        Defect.MARGIN if every.confirmed else "",
    )
    reachable = Segment(example.B[:, 0], example.epsilon)
    level = worst_step(closed_loop, M, ball, reachable).level
    stays = stays_inside(closed_loop, M, ball, reachable)
    yield Claim(
        "the same for the errors that can occur: e = B K e_up lies in the range of B",
        "x+ in S for all x in S, d, e",
        f"worst x+'M x+ = {level:.3f} with d in the whole ball of (3), if the input is not limited"
        + (" (that it stays inside is proved in exact arithmetic)" if stays else ""),
        Verdict.HOLDS if stays else Verdict.UNDECIDED,
    )


def text_of(step: OneStep) -> str:
    """Returns the step in words; an error of zero is left out. All but the end is shown as it was confirmed."""
    x, d, e, end = (v.tolist() for v in (step.state, step.disturbance, step.error, np.round(step.following, 4)))
    start = f"x = {x}, d = {d}" + (f", e = {e}" if np.any(step.error) else "")
    confirmed = "confirmed in exact arithmetic" if step.confirmed else "not confirmed exactly"
    return f"for example {start} go to x+ = {end} ({confirmed})"
