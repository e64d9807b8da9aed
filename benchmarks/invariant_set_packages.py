"""The largest robustly invariant polytope by other packages, on the same closed loop and disturbance.

    pip install polytope ampyc
    python -m benchmarks.invariant_set_packages [--ids BatchReactor] [--longest 300]

All of them get A+BK, the box with the rows of the input limits, and W, the smallest box around what errors of the
estimate and disturbances do in a step: the packages take polytopes only. "ours" is the search of `synthesize` with this
W, "polytope" the textbook iteration with that package's intersection and reduction, "ampyc" its `compute_mrpi`. "exact"
says whether the result is invariant in rational arithmetic: for every face f with f x <= 1 there are multipliers with
sum(lambda) + sum |f (A+BK) - lambda F|_k w_k + support of W <= 1, found by a linear program and not trusted; if not, by
how much the worst face fails. CPU time; what takes longer than `--longest` seconds is stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import signal
import time
from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from scipy.optimize import linprog
from scipy.stats import qmc

import ncs_gym  # noqa: F401  (registers the environments)
from shields import Infeasible, synthesize
from shields.synthesis.invariant_polytope import Faces, in_half_ranges, invariant_faces
from shields.verification import ACTION_ROUNDING

IDS = ("TruckTrailerCruise", "BatchReactor", "Pendulum", "CartPole")
# What our search keeps from every face for the rounding of rows and multipliers, as in the synthesis.
RESERVE = 1e-6


class Case(NamedTuple):
    """A closed loop in units of the box: z+ = A z + w with |rows z| <= 1 and |w_k| <= W_k."""

    A: np.ndarray
    rows: np.ndarray
    W: np.ndarray


def case_of(name: str) -> Case:
    env = gym.make(f"ncs_gym/{name}-v0").unwrapped
    plant, certificate = env.plant, synthesize(env.plant, contract=env.certificate_contract, safe_set="ellipsoid")
    widths, K = plant.half_widths, certificate.K
    reach = np.sqrt(np.einsum("ij,kjl,il->ki", K, certificate.error_shapes, K).max(axis=0))
    inputs = K / (plant.u_max * (1.0 - float(ACTION_ROUNDING)) - reach)[:, None]
    pushed = plant.B @ K
    errors = np.sqrt(np.einsum("ij,kjl,il->ki", pushed, certificate.error_shapes, pushed).max(axis=0))
    W = errors + np.sqrt(np.diag(certificate.D))
    return Case(
        (plant.A + pushed) * widths / widths[:, None], np.concatenate([plant.box_rows, inputs]) * widths, W / widths
    )


def ours(case: Case) -> np.ndarray:
    def predecessor(faces: Faces) -> Faces:
        taken = RESERVE + np.abs(faces.rows) @ case.W
        return in_half_ranges(faces.rows @ case.A, faces.low + taken, faces.high - taken)

    ones = np.ones(len(case.rows))
    rows = invariant_faces(Faces(case.rows, -ones, ones), predecessor, case.A.shape[0]).rows
    return np.concatenate([rows, -rows])


def by_polytope(case: Case) -> np.ndarray:
    import polytope

    now = polytope.Polytope(np.concatenate([case.rows, -case.rows]), np.ones(2 * len(case.rows)))
    while True:
        left = now.b - np.abs(now.A) @ case.W
        following = polytope.reduce(polytope.Polytope(np.vstack([now.A, now.A @ case.A]), np.append(now.b, left)))
        if polytope.is_subset(now, following):
            return now.A / now.b[:, None]
        now = following


def by_ampyc(case: Case) -> np.ndarray:
    from ampyc.utils import Polytope
    from ampyc.utils.set_computation import compute_mrpi

    n, count = len(case.W), len(case.rows)
    start = Polytope(np.concatenate([case.rows, -case.rows]), np.ones(2 * count))
    W = Polytope(np.concatenate([np.eye(n), -np.eye(n)]), np.tile(case.W, 2))
    with contextlib.redirect_stdout(io.StringIO()):
        found = compute_mrpi(start, case.A, W, max_iter=10_000)
    return found.A / found.b[:, None]


def shortfall(faces: np.ndarray, case: Case) -> Fraction:
    """Returns by how much the worst face fails in rational arithmetic; at most zero if the set is invariant."""
    worst = Fraction(-1)
    exact = [[Fraction(float(entry)) for entry in face] for face in faces]
    A, W = ([[Fraction(float(entry)) for entry in row] for row in matrix] for matrix in (case.A.T, case.W[:, None]))
    for face in exact:
        image = [sum(a * f for a, f in zip(column, face, strict=True)) for column in A]
        found = linprog(-np.array(image, float), A_ub=faces, b_ub=np.ones(len(faces)), bounds=(None, None))
        if found.status != 0:
            return Fraction(1)
        multipliers = [Fraction(max(0.0, -float(price))) for price in found.ineqlin.marginals]
        rest = list(image)
        for multiplier, other in zip(multipliers, exact, strict=True):
            if multiplier:
                rest = [left - multiplier * entry for left, entry in zip(rest, other, strict=True)]
        support = sum(abs(f) * w for f, (w,) in zip(face, W, strict=True))
        worst = max(worst, sum(multipliers) + sum(map(abs, rest)) + support - 1)
    return worst


def row(name: str, tool: str, find: Callable[[Case], np.ndarray], case: Case, longest: int) -> str:
    def stop(*_: object) -> None:
        raise TimeoutError

    signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, longest)
    begin = time.process_time()
    try:
        faces = find(case)
    except TimeoutError:
        return f"{name:20}{tool:10}stopped after {time.process_time() - begin:.0f} s of CPU time"
    except Infeasible as none:
        return f"{name:20}{tool:10}{none}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    seconds = time.process_time() - begin
    points = 2.0 * qmc.Sobol(len(case.W), scramble=False).random_base2(16) - 1.0
    share = ((points @ faces.T).max(axis=1) <= 1.0).mean()
    failing = shortfall(faces, case)
    verdict = "holds" if failing <= 0 else f"fails by {float(failing):.1e}"
    return f"{name:20}{tool:10}{seconds:8.2f} {len(faces):6d} {share:8.1%}   {verdict}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ids", nargs="*", default=IDS)
    parser.add_argument("--longest", type=int, default=300, help="longest CPU time of a search [s]")
    options = parser.parse_args()
    print(f"{'id':20}{'by':10}{'seconds':>8} {'faces':>6} {'of box':>8}   exact")
    for name in options.ids:
        case = case_of(name)
        for tool, find in (("ours", ours), ("polytope", by_polytope), ("ampyc", by_ampyc)):
            print(row(name, tool, find, case, options.longest), flush=True)


if __name__ == "__main__":
    main()
