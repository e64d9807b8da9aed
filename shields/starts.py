"""Where the search for an invariant set begins: without a good start, alternation stalls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from shields.semidefinite import (
    Design,
    InvariantSetProgram,
    ScaledProblem,
    nominal_set,
)
from shields.shares import best_input_shares, best_shares

# (lx, le / (1 - lx)) to start from; without good starts the alternation stalls (theory.md section 3).
STARTS = ((0.85, 0.3), (0.85, 0.1), (0.92, 0.3), (0.92, 0.1), (0.75, 0.3), (0.6, 0.2), (0.97, 0.2))
START_INPUT_SHARE = 0.8
# lx and le / (1 - lx) to start from near the invariant set without estimation error, where the others find nothing:
# plants that move slowly through their box need lx near 1.
NOMINAL_STATES = (0.75, 0.85, 0.92, 0.96, 0.98, 0.99, 0.995, 0.998, 0.999)
NOMINAL_PARTS = (0.1, 0.3, 0.6)
# Where they find nothing either, radii are grown from at least this share of those given, by steps of this size.
SMALLEST_SCALE, SMALLEST_STEP, LARGEST_STEP = 0.3, 0.01, 0.15
# Of the disturbance; the second is tried where the first finds nothing.
NOMINAL_GROWTHS = (3.0, 1.2)
# Within this of the box ellipsoid's log det nothing is left to gain.
CLOSE_ENOUGH = 2e-4

Progress = Callable[[str], None]


def best_start(problem: ScaledProblem, program: InvariantSetProgram, progress: Progress) -> Design | None:
    """Returns the best design of the cheapest kind of start that finds one."""
    design = plain_start(problem, program, progress) or nominal_start(problem, program, progress)
    if design is None:
        grown_design, reached = grown_start(problem, program, progress)
        design = grown_design if reached >= 1.0 else None
    return design


def plain_start(problem: ScaledProblem, program: InvariantSetProgram, progress: Progress) -> Design | None:
    """Returns the best design over a handful of shares and two linearizations."""
    last = problem.Sigmas[-1]
    near = last / float(np.linalg.eigvalsh(last)[-1])
    inputs = np.full(problem.m, START_INPUT_SHARE)
    best = None
    starts = list(product(STARTS, (np.eye(problem.n), near)))
    for turn, ((state, part), linearize_at) in enumerate(starts):
        design = program.solve(as_shares(state, part), inputs, linearize_at)
        if design is not None and (best is None or design.log_det > best.log_det):
            best = design
        progress(f"start {turn + 1} of {len(starts)}: {volume_of(best)}")
        if best is not None and -best.log_det < CLOSE_ENOUGH:
            break
    return best


def grown_start(
    problem: ScaledProblem, program: InvariantSetProgram, progress: Progress
) -> tuple[Design | None, float]:
    """Returns a design for smaller radii grown as far as it goes, and the share of the radii it reaches.

    Each turn looks for the design that bears the most disturbance, linearizes there and enlarges the radii.
    """
    scale, design = 1.0, None
    while design is None and scale > SMALLEST_SCALE:
        scale *= 0.7
        design = nominal_start(problem, program, progress, scale)
    step = LARGEST_STEP
    while design is not None and scale < 1.0 and step > SMALLEST_STEP:
        trial = min(1.0, scale * (1.0 + step))
        better = _roomiest(problem, program, design, trial)
        progress(f"growing from smaller radii: {scale:.3f} of those given")
        if better is None:
            step *= 0.5
        else:
            scale, design = trial, better
    return design, scale


def _roomiest(problem: ScaledProblem, program: InvariantSetProgram, design: Design, scale: float) -> Design | None:
    """Returns the design near another that bears the most disturbance with radii scaled by `scale`, if there is one."""
    Sigmas = scale**2 * problem.Sigmas
    shares, _ = best_shares(replace(problem, D=scale**2 * problem.D), Sigmas, design.L, design.K, design.shares)
    choices = ((shares, best_input_shares(Sigmas, design.L, design.K)), (design.shares, design.inputs))
    found = (program.solve(*choice, design.L, scale=scale, roomiest=True) for choice in choices)
    return next((one for one in found if one is not None), None)


def nominal_start(
    problem: ScaledProblem, program: InvariantSetProgram, progress: Progress, scale: float = 1.0
) -> Design | None:
    """Returns the best design linearized at an invariant set without estimation error; None if there is none."""
    problem = replace(problem, D=scale**2 * problem.D)
    inputs, best = np.full(problem.m, START_INPUT_SHARE), None
    for growth, state in product(NOMINAL_GROWTHS, NOMINAL_STATES):
        if best is not None and growth != NOMINAL_GROWTHS[0]:
            break
        linearize_at = nominal_set(problem, state, growth)
        for part in NOMINAL_PARTS if linearize_at is not None else ():
            design = program.solve(as_shares(state, part), inputs, linearize_at, scale=scale)
            if design is not None and (best is None or design.log_det > best.log_det):
                best = design
            progress(f"start near the set without errors, lx = {state}: {volume_of(best)}")
    return best


def as_shares(state: float, part: float) -> tuple[float, float, float]:
    """Returns (lx, le, ld) from lx and le / (1 - lx)."""
    return float(state), float((1.0 - state) * part), float((1.0 - state) * (1.0 - part))


def volume_of(design: Design | None) -> str:
    """Returns how large a design's set is, for people."""
    return "none found yet" if design is None else f"{np.exp(0.5 * design.log_det):.4f} of the box ellipsoid's volume"
