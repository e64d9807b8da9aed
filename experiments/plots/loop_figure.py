"""The log of a loop over a network as a figure: states against their box, inputs, and what is not proved."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd

from experiments.network_loop.log import rows_of
from experiments.plots.figure_style import STYLE, CaptionedFigure, input_labels, label, state_labels, with_unit
from ncs_gym import LinearPlant
from ncs_gym.plants.past_inputs import inputs_under_way


def loop_log_figure(folder: Path, plant: LinearPlant, steps: int) -> CaptionedFigure:
    """Returns the last steps of the newest episode in the logs of `ncs loop`: its plant's, its controller's, or both.

    Raises:
        ValueError: If there are no rows, or they are of another plant.
    """
    logs = {name: pd.DataFrame(deque(rows_of(folder, name), steps)) for name in ("plant", "controller")}
    logs = {name: log for name, log in logs.items() if len(log)}
    if not logs:
        raise ValueError(f"no logs of ncs loop in {folder}: plant-000.csv or controller-000.csv")
    columns = {"plant": "x_", "controller": "x_hat_"}
    for name, log in logs.items():
        if missing := [each for each in plant.state_names if columns[name] + each not in log]:
            raise ValueError(f"the logs in {folder} are of another plant, without {', '.join(missing)}: give its --env")
    logs = {name: log[log["episode"] == log["episode"].iloc[-1]] for name, log in logs.items()}
    own = plant.n - inputs_under_way(plant)  # past inputs are inputs of rows before
    names, units = [*plant.state_names[:own], *plant.input_names], [*plant.state_units[:own], *plant.input_units]
    unproved = np.empty(0)
    if "controller" in logs:
        unproved = logs["controller"][logs["controller"]["guaranteed"] == "0"]["step"].astype(int)
    labels = *state_labels(plant)[:own], *input_labels(plant)
    ends = np.hstack([plant.own_limits[:, :own], plant.input_ends]).T.tolist()
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure(
            (11.0, 1.0 + 1.4 * len(names)), f"{folder.name}: the dashed lines are the box and the input limits."
        )
        axes = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        for i, (axis, name, text, unit, limits) in enumerate(zip(axes, names, labels, units, ends, strict=True)):
            for log, rows in logs.items():
                column = columns[log] + name if i < own else f"u_{name}"
                style = {"plant": "-", "controller": ":"}[log]
                axis.plot(rows["step"].astype(int), rows[column].astype(float), style, lw=1.2, label=log)
            for end in filter(np.isfinite, limits):
                axis.axhline(end, color="#222222", lw=1.0, ls=(0, (6.0, 3.0)))
            if len(unproved):
                height = {"transform": axis.get_xaxis_transform(), "label": "not proved"}
                axis.vlines(unproved, 0.0, 1.0, color="#cc3311", alpha=0.2, **height)
            label(axis, "", with_unit(text, unit).replace(" [", "\n["))
        axes[-1].set_xlabel("step")
        axes[0].set_title("what the controller estimates and decides at a step is about that at which it takes effect")
        axes[0].legend(loc="upper right", ncols=3)
        return figure
