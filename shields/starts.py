"""Where the search for an invariant set begins: without a good start, alternation stalls."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from itertools import product

import numpy as np

from ncs_gym.ellipsoid import joined
from shields.gain_search import roomiest_gain
from shields.semidefinite import Design, InvariantSetProgram, ScaledProblem
from shields.shares import best_input_shares

# (lx, le / (1 - lx)) to start from; without good starts the alternation stalls (theory.md section 3).
STARTS = ((0.85, 0.3), (0.85, 0.1), (0.92, 0.3), (0.92, 0.1), (0.75, 0.3), (0.6, 0.2), (0.97, 0.2))
START_INPUT_SHARE = 0.8
# The invariant set of the gain that bears most is enlarged by at most this to start from.
LARGEST_GROWTH = 100.0
# Within this of the box ellipsoid's log det nothing is left to gain.
CLOSE_ENOUGH = 2e-4

Progress = Callable[[str], None]


def best_start(problem: ScaledProblem, program: InvariantSetProgram, progress: Progress) -> Design | None:
    """Returns the design of the cheapest kind of start that finds one; None if there is none."""
    return plain_start(problem, program, progress) or roomy_start(problem, program, progress)


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
    last, covering = problem.Sigmas[-1], reduce(joined, problem.Sigmas)
    for Sigma in (last,) if len(problem.Sigmas) == 1 else (last, covering):
        gain = roomiest_gain(problem, Sigma)
        reach = 0.0 if gain is None else gain.reach
        progress(f"start at the gain that bears most: {reach:.3f} of the radii given")
        for size in (reach**2, reach, 1.0) if reach >= 1.0 else ():
            L = min(size, LARGEST_GROWTH) * gain.L
            design = program.solve(gain.shares, best_input_shares(Sigma[None], L, gain.K), L)
            if design is not None:
                return design
    return None


def as_shares(state: float, part: float) -> tuple[float, float, float]:
    """Returns (lx, le, ld) from lx and le / (1 - lx)."""
    return float(state), float((1.0 - state) * part), float((1.0 - state) * (1.0 - part))


def volume_of(design: Design | None) -> str:
    """Returns how large a design's set is, for people."""
    return "none found yet" if design is None else f"{np.exp(0.5 * design.log_det):.4f} of the box ellipsoid's volume"
