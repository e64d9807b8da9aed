"""Where the search for an invariant set begins: without a good start, alternation stalls."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from shields.synthesis.max_margin_gain import RoomyGain, roomiest_gain
from shields.synthesis.multipliers import best_input_shares
from shields.synthesis.semidefinite_programs import Design, InvariantSetProgram, ScaledProblem

# (lx, le / (1 - lx)) to start from; without good starts the alternation stalls (theory.md section 3).
STARTS = ((0.85, 0.3), (0.85, 0.1), (0.92, 0.3), (0.92, 0.1), (0.75, 0.3), (0.6, 0.2), (0.97, 0.2))
START_INPUT_SHARE = 0.8
# The invariant set of the gain that bears most is enlarged by at most this to start from.
LARGEST_GROWTH = 100.0
# It counts if exact verification has this much room.
ENOUGH = 1.0 + 1e-5
# Within this of the box ellipsoid's log det nothing is left to gain.
CLOSE_ENOUGH = 2e-4

Progress = Callable[[str], None]


def best_start(problem: ScaledProblem, program: InvariantSetProgram, progress: Progress) -> Design | None:
    """Returns the design of the cheapest kind of start that finds one; None if there is none."""
    design = plain_start(problem, program, progress) if len(problem.Sigmas) == 1 else None
    return design or roomy_start(problem, program, progress)


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


def roomy_start(problem: ScaledProblem, program: InvariantSetProgram, progress: Progress) -> Design | None:
    """Returns a design near the gain that bears the largest radii; None if they are smaller than those given."""
    for Sigma in (problem.Sigmas[-1], problem.covering) if len(problem.Sigmas) > 1 else problem.Sigmas:
        gain = roomiest_gain(problem, Sigma)
        reach = 0.0 if gain is None else gain.reach
        progress(f"start at the gain that bears most: {reach:.3f} of the radii given")
        if gain is None or reach < ENOUGH:
            continue
        L = min(reach**2, LARGEST_GROWTH) * gain.L
        design = program.solve(gain.shares, best_input_shares(Sigma[None], L, gain.K), L)
        if design is not None:
            return design
    # Thickened error sets by age may leave the program nothing where the sets themselves leave something.
    several = len(problem.Sigmas) > 1
    return _as_design(gain, problem.covering) if several and gain is not None and reach >= ENOUGH else None


def _as_design(gain: RoomyGain, Sigma: np.ndarray) -> Design:
    """Returns the gain's own set, with half the room it has left on either side, as a design."""
    L = gain.reach * gain.L
    inputs = best_input_shares(Sigma[None], L, gain.K)
    return Design(L, gain.K, gain.shares, inputs, float(np.linalg.slogdet(L)[1]))


def as_shares(state: float, part: float) -> tuple[float, float, float]:
    """Returns (lx, le, ld) from lx and le / (1 - lx)."""
    return float(state), float((1.0 - state) * part), float((1.0 - state) * (1.0 - part))


def volume_of(design: Design | None) -> str:
    """Returns how large a design's set is, for people."""
    return "none found yet" if design is None else f"{np.exp(0.5 * design.log_det):.4f} of the box ellipsoid's volume"
