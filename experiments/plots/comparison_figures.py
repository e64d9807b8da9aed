"""The figures of the comparison."""

from __future__ import annotations

from typing import Any

from experiments.plots.phase_plane import phase_figure
from experiments.plots.scatter import scatter_figure
from experiments.plots.time_series import episode_figure
from experiments.plots.training_curves import training_figure
from experiments.runs.arms import ResultsByArm
from ncs_gym import LinearPlant
from shields import Certificate


def comparison_figures(
    plant: LinearPlant, certificate: Certificate, summary: dict[str, Any], results: ResultsByArm
) -> dict[str, tuple[str, bytes]]:
    """Returns caption and PNG file of every figure by name, what the findings are about first.

    Args:
        plant: Plant of the environment.
        certificate: Certificate of the safe set.
        summary: Content of summary.json; its arms are shown in its order.
        results: Results of the runs of every arm.
    """
    arms = {name: results[name] for name in summary["arms"]}
    trained = {name: runs for name, runs in arms.items() if runs[0].history}
    figures = {"scatter": scatter_figure(summary["arms"], arms)}
    if trained:
        figures["training"] = training_figure(trained)
    figures["episode"] = episode_figure(plant, arms)
    if plant.n > 1:  # a single state has no phase plane
        figures["phase"] = phase_figure(plant, certificate, arms)
    return {name: (figure.caption, figure.png) for name, figure in figures.items()}
