"""`ncs reproduce`: simulates Section 5 of the paper."""

from __future__ import annotations

import json
from dataclasses import asdict

from tqdm import tqdm

from experiments.paper.reproduction import Outcome, designs, reproduction_figures, simulate
from experiments.runs import claim_folder, prepare_output
from experiments.settings import ReproduceSettings
from experiments.terminal import text_table
from shields.atomic_write import write_atomically


def reproduce(settings: ReproduceSettings) -> None:
    """Runs `ncs reproduce`."""
    with claim_folder("reproduce", settings):
        prepare_output(settings.out)
        with tqdm(total=3 * settings.starts, unit="start", mininterval=1.0) as bar:
            simulations = [simulate(design, settings, bar) for design in designs()]
        for name, png in reproduction_figures(simulations).items():
            write_atomically(settings.out / "figures" / f"{name}.png", png)
        outcomes = {simulation.design.name: simulation.outcome for simulation in simulations}
        summary = {name: asdict(outcome) for name, outcome in outcomes.items()}
        write_atomically(settings.out / "summary.json", json.dumps(summary, indent=1) + "\n")
        print(_table(outcomes))
        print(f"files: {settings.out}")


def _table(outcomes: dict[str, Outcome]) -> str:
    rows = [
        ("steps outside the safe set", lambda o: f"{o.outside_set:,} of {o.steps:,}"),
        ("steps outside the safe box", lambda o: f"{o.outside_box:,} of {o.steps:,}"),
        ("inputs asked beyond the limit", lambda o: f"{o.input_asked_beyond:,} of {o.steps:,}"),
        ("largest x'Mx", lambda o: f"{o.largest_level:.4f}"),
        ("largest |K x_hat| [m/s^2]", lambda o: f"{o.largest_input:.3f}"),
        ("largest e'e", lambda o: f"{o.largest_error:.5f}"),
        ("claimed epsilon", lambda o: "-" if o.epsilon is None else f"{o.epsilon:.5f}"),
        ("largest e_up'e_up", lambda o: f"{o.largest_estimation_error:.5f}"),
    ]
    cells = [[name, *map(show, outcomes.values())] for name, show in rows]
    return text_table([["", *outcomes], *cells])
