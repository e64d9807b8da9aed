"""`ncs reproduce`: simulates Section 5 of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from experiments.paper.reproduction import designs, reproduction_figures, simulate
from experiments.runs.output_folder import claim_folder, write_results
from experiments.settings import require_limits
from experiments.terminal import progress_bar, text_table


@dataclass(frozen=True, kw_only=True)
class ReproduceSettings:
    """Simulates Section 5 of Liu et al. with three designs: printed, certified, and OP's.

    OP's is at the nearest feasible bounds. Random initial states in each safe set meet all four network impairments.
    Prints a table and leaves figures and summary.json.

    Attributes:
        out: Output folder.
        starts: Number of random initial states per design.
        steps: Steps of each simulation.
        force: Replace finished results of other settings in the output folder, which otherwise is refused.
        seed: Seed of initial states, disturbances and channel, the same for all designs.
    """

    out: Path = Path("runs/reproduce")
    starts: int = 100
    steps: int = 200
    force: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        require_limits(self, starts=1, steps=1, seed=0)


def reproduce(settings: ReproduceSettings) -> None:
    """Runs `ncs reproduce`."""
    claim_folder("reproduce", settings)
    with progress_bar(3 * settings.starts, "simulation", "start") as bar:
        simulations = [simulate(design, settings.starts, settings.steps, settings.seed, bar) for design in designs()]
    outcomes = {simulation.design.name: simulation.outcome for simulation in simulations}
    write_results(settings.out, outcomes, figures=reproduction_figures(simulations))
    print(table_of(outcomes))
    print(f"files: {settings.out}")


def table_of(outcomes: dict[str, dict[str, float | None]]) -> str:
    """Returns what happened in each simulation as a table."""
    rows = [
        ("steps outside the safe set", "{outside_set:,} of {steps:,}"),
        ("steps outside the safe box", "{outside_box:,} of {steps:,}"),
        ("inputs asked beyond the limit", "{input_asked_beyond:,} of {steps:,}"),
        ("largest x'Mx", "{largest_level:.4f}"),
        ("largest |K x_hat| [m/s^2]", "{largest_input:.3f}"),
        ("largest e'e", "{largest_error:.5f}"),
        ("claimed epsilon", "{epsilon:.5f}"),
        ("largest e_up'e_up", "{largest_estimation_error:.5f}"),
    ]
    cells = [[name, *(_shown(text, outcome) for outcome in outcomes.values())] for name, text in rows]
    return text_table([["", *outcomes], *cells])


def _shown(text: str, outcome: dict[str, float | None]) -> str:
    return "-" if outcome["epsilon"] is None and "epsilon" in text else text.format(**outcome)
