"""The largest disturbance with an initial design, against the age a contract allows, per unstable plant.

    python benchmarks/contracts.py [--ages 1 4 8 16] [--out contracts.png]

Disturbance radii are in percent of the half-widths of the safe box; sensor noise and initial error are a hundredth of
that. They are found by bisection to 1 %: once there is an initial design, the rest of the synthesis enlarges its set.
Seconds are those of a whole synthesis, with exact verification, at two thirds of that radius.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np

from experiments.plots.figure_style import STYLE, CaptionedFigure, label, legend_below
from ncs_gym import ChannelContract, LinearPlant, batch_reactor, cart_pole
from ncs_gym.uncertainty.truncated_gaussian import truncation_energy
from shields import Infeasible, synthesize
from shields.synthesis.design_problem import design_problem
from shields.synthesis.initial_designs import initial_design
from shields.synthesis.invariant_set_program import InvariantSetProgram

PLANTS = {
    "cart-pole, full state": cart_pole(),
    "cart-pole, position and angle": cart_pole(full_state=False),
    "batch reactor, two outputs": batch_reactor(),
}
# Colors of the plants in the figure, apart for color-blind readers (Okabe and Ito).
COLORS = ("#0072b2", "#e69f00", "#009e73")
PRECISION = 1.01
# Relative tightening of the semidefinite program, the smallest one that the synthesis tries.
SLACK = 1e-6


def with_radius(plant: LinearPlant, radius: float) -> LinearPlant:
    """The plant with a disturbance of that fraction of the box, and a hundredth of it elsewhere."""
    half_widths, n = plant.half_widths, plant.n
    outputs = np.abs(plant.H) @ half_widths
    return replace(
        plant,
        process_noise_cov=np.diag((radius * half_widths) ** 2) / truncation_energy(0.05, n),
        measurement_noise_cov=np.diag((0.01 * radius * outputs) ** 2) / truncation_energy(0.05, plant.p),
        initial_cov=(0.01 * radius * half_widths.min()) ** 2 / truncation_energy(0.05, n) * np.eye(n),
    )


def has_initial_design(plant: LinearPlant, contract: ChannelContract) -> bool:
    try:
        problem, _ = design_problem(plant, contract)
    except Infeasible:
        return False
    return initial_design(problem, InvariantSetProgram(problem, SLACK), lambda stage, share: None) is not None


def largest_radius(plant: LinearPlant, contract: ChannelContract) -> float:
    low, high = 1e-5, 0.1
    while high / low > PRECISION:
        middle = (low * high) ** 0.5
        low, high = (middle, high) if has_initial_design(with_radius(plant, middle), contract) else (low, middle)
    return low


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ages", type=int, nargs="+", default=[1, 4, 8, 16])
    parser.add_argument("--out", default=None, help="file for a figure of it")
    options = parser.parse_args()
    print(f"{'plant':32s}{'max_age':>8s}{'radius / box':>14s}{'vol/ellipsoid':>14s}{'synthesis [s]':>15s}", flush=True)
    radii_of: dict[str, np.ndarray] = {}
    for name, plant in PLANTS.items():
        radii = []
        for age in options.ages:
            contract = ChannelContract(age)
            radii.append(largest_radius(plant, contract))
            start = time.perf_counter()
            certificate = synthesize(with_radius(plant, radii[-1] / 1.5), contract=contract, safe_set="ellipsoid")
            seconds = time.perf_counter() - start
            volume = certificate.provenance["volume_of_box_ellipsoid"]
            print(f"{name:32s}{age:8d}{radii[-1]:14.3%}{volume:14.2f}{seconds:15.1f}", flush=True)
        radii_of[name] = 100.0 * np.array(radii)
    if options.out is not None:
        Path(options.out).write_bytes(drawn(options.ages, radii_of).png)


def drawn(ages: list[int], radii_of: dict[str, np.ndarray]) -> CaptionedFigure:
    """The largest radius against the contract's age, for every plant."""
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((8.0, 3.8))
        axes, handles = figure.subplots(), {}
        for (name, radii), color, marker in zip(radii_of.items(), COLORS, "os^", strict=False):
            (handles[name],) = axes.semilogy(ages, radii, marker=marker, color=color, lw=1.5)
        label(
            axes,
            "largest age of the newest sample that the contract allows [steps]",
            "largest disturbance [% of the box]",
        )
        axes.set_xticks(ages)
        axes.set_yticks([0.1, 0.3, 1.0, 3.0])
        axes.yaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        legend_below(figure, handles)
        return figure


if __name__ == "__main__":
    main()
