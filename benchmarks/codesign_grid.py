"""Algorithm 1's grid: OP rebuilt in cvxpy at each point against numbers updated inside the solver, in one run.

    python benchmarks/codesign_grid.py [--kappas 50] [--rhos 20]

Every arm visits the same (kappa, rho); the plant is that of the case study with gamma and Q so small that part of it
is feasible. The arms must agree on which points are.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from ncs_gym import truck_trailer
from shields.paper.bounds import PaperModel
from shields.paper.optimization_problem import MarginProgram, VolumeProgram, solve_op


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kappas", type=int, default=50)
    parser.add_argument("--rhos", type=int, default=20)
    options = parser.parse_args()
    plant = truck_trailer(gamma=1e-6, process_noise_cov=1e-6 * np.eye(2))
    model = PaperModel(plant)
    kappas = np.linspace(0.02, 0.99, options.kappas)
    shares = np.linspace(0.0, 0.99, options.rhos) ** 2
    grid = [model.at(k, 1.0 + (1.0 / k - 1.0) * s) for k in kappas.tolist() for s in shares.tolist()]

    def rebuilt() -> list[bool]:
        return [solve_op(plant, bounds) is not None for bounds in grid]

    def margins() -> list[bool]:
        program = MarginProgram(plant)
        return [program.largest(bounds) >= bounds.alpha for bounds in grid]

    def volumes() -> list[bool]:
        program = VolumeProgram(plant)
        return [bool(np.isfinite(program.largest(bounds))) for bounds in grid]

    results, reference = {}, None
    arms = {"OP rebuilt in cvxpy": rebuilt, "feasibility, updated": margins, "log det, updated": volumes}
    print(f"{'arm':24s}{'seconds':>10s}{'ms/point':>10s}{'ratio':>8s}{'feasible':>10s}{'differ':>8s}", flush=True)
    for name, arm in arms.items():
        start = time.perf_counter()
        results[name] = arm()
        seconds = time.perf_counter() - start
        reference = reference or (seconds, results[name])
        differ = sum(a != b for a, b in zip(results[name], reference[1], strict=True))
        print(
            f"{name:24s}{seconds:10.2f}{1e3 * seconds / len(grid):10.2f}{reference[0] / seconds:7.1f}x"
            f"{sum(results[name]):10d}{differ:8d}",
            flush=True,
        )


if __name__ == "__main__":
    main()
