"""OP on a grid of (kappa, rho): as printed in cvxpy against its reduced form written for the solver, in one run.

    python benchmarks/optimization_problem_grid.py [--kappas 50] [--rhos 20]

Every form visits the same (kappa, rho); the plant is that of the case study with gamma and Q so small that part of the
grid is feasible. The forms must agree on which part.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from ncs_gym import truck_trailer
from shields.paper.bounds import PaperModel
from shields.paper.optimization_problem import solve_op
from shields.paper.reduced_problem import ReducedProblem


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kappas", type=int, default=50)
    parser.add_argument("--rhos", type=int, default=20)
    options = parser.parse_args()
    plant = truck_trailer(gamma=1e-6, process_noise_cov=1e-6 * np.eye(2))
    model, reduced = PaperModel(plant), ReducedProblem(plant)
    kappas = np.linspace(0.02, 0.99, options.kappas)
    fractions = np.linspace(0.0, 0.99, options.rhos) ** 2
    grid = [model.at(k, 1.0 + (1.0 / k - 1.0) * fraction) for k in kappas.tolist() for fraction in fractions.tolist()]

    forms = {
        "OP as printed, cvxpy": lambda bounds: solve_op(plant, bounds) is not None,
        "reduced, lambda_min(L)": lambda bounds: reduced.largest_eigenvalue(bounds) >= bounds.alpha,
        "reduced, log det L": lambda bounds: bool(np.isfinite(reduced.largest_log_det(bounds))),
    }
    reference = None
    print(f"{'form':24s}{'seconds':>10s}{'ms/point':>10s}{'ratio':>8s}{'feasible':>10s}{'differ':>8s}", flush=True)
    for name, is_feasible in forms.items():
        start = time.perf_counter()
        results = [is_feasible(bounds) for bounds in grid]
        seconds = time.perf_counter() - start
        reference = reference or (seconds, results)
        differ = sum(a != b for a, b in zip(results, reference[1], strict=True))
        print(
            f"{name:24s}{seconds:10.2f}{1e3 * seconds / len(grid):10.2f}{reference[0] / seconds:7.1f}x"
            f"{sum(results):10d}{differ:8d}",
            flush=True,
        )


if __name__ == "__main__":
    main()
