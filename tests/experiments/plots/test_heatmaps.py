from itertools import product

import numpy as np
import pytest

from experiments.plots.heatmaps import QUANTITIES, sweep_figures, sweep_map
from tests.command import without_pictures


def cells(arms, losses=(0.0, 0.3, 0.6), delays=(0, 4), roundings=(None,), bursts=(1.0,), rate=None):
    def numbers(at):
        return {
            "runs": 2,
            "eval_violation_rate": 0.01 * at if rate is None else rate,
            "eval_return_mean": -10.0 * at - 1.5,
            "intervention_rate": 0.02 * at,
        }

    sides = ("loss", "delay", "quantization_step", "burst_length")
    grid = product(losses, delays, roundings, bursts)
    return [
        dict(zip(sides, point, strict=True)) | {"mean_loss": point[0], "arms": {arm: numbers(at) for arm in arms}}
        for at, point in enumerate(grid)
    ]


def panels(figure):
    return [axis for axis in figure.axes if axis.get_visible() and axis.images]


def numbers(axis):
    return [text.get_text() for text in axis.texts]


@pytest.mark.parametrize("count", [1, 2, 4, 5, 11])
def test_every_arm_has_a_panel_and_every_channel_a_field(count):
    arms = [f"arm {i}" for i in range(count)]
    figure = sweep_map(cells(arms), arms, QUANTITIES["violations"])
    assert [axis.get_title() for axis in panels(figure)] == arms
    assert all(len(numbers(axis)) == 6 for axis in panels(figure))


def test_fields_stand_at_their_loss_and_delay():
    axis = panels(sweep_map(cells(["shielded"]), ["shielded"], QUANTITIES["violations"]))[0]
    np.testing.assert_allclose(axis.images[0].get_array(), [[0.0, 2.0, 4.0], [1.0, 3.0, 5.0]])
    assert numbers(axis) == ["0", "2.0", "4.0", "1.0", "3.0", "5.0"]
    assert [tick.get_text() for tick in axis.get_xticklabels()] == ["0", "0.3", "0.6"]
    assert [tick.get_text() for tick in axis.get_yticklabels()] == ["0", "4"]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("loss probability", "delay [steps]")


def test_numbers_are_light_on_dark_fields_and_dark_on_light_ones():
    axis = panels(sweep_map(cells(["shielded"]), ["shielded"], QUANTITIES["return"]))[0]
    colors = {text.get_text(): text.get_color() for text in axis.texts}
    assert colors["\N{MINUS SIGN}1.5"] != "white"  # cividis is yellow at its top
    assert colors["\N{MINUS SIGN}51.5"] == "white"


def test_all_panels_share_one_color_scale():
    grid = cells(["unshielded", "shielded"])
    for cell in grid:
        cell["arms"]["shielded"] = cell["arms"]["shielded"] | {"eval_return_mean": -500.0}
    shown = panels(sweep_map(grid, ["unshielded", "shielded"], QUANTITIES["return"]))
    assert {axis.images[0].get_clim() for axis in shown} == {(-500.0, -1.5)}


def test_no_violations_are_pale_and_few_are_not_as_dark_as_many():
    axis = panels(sweep_map(cells(["shielded"], rate=0.0), ["shielded"], QUANTITIES["violations"]))[0]
    assert axis.images[0].get_clim() == (0.0, 10.0)
    assert set(numbers(axis)) == {"0"}
    axis = panels(sweep_map(cells(["shielded"], rate=0.7), ["shielded"], QUANTITIES["violations"]))[0]
    assert axis.images[0].get_clim() == (0.0, 70.0)


def test_small_rates_have_another_digit():
    grid = cells(["shielded"], losses=(0.0, 0.3), delays=(0,))
    grid[1]["arms"]["shielded"]["intervention_rate"] = 0.0004
    axis = panels(sweep_map(grid, ["shielded"], QUANTITIES["interventions"]))[0]
    assert numbers(axis) == ["0", "0.04"]


def test_quantization_steps_and_bursts_have_panels_of_their_own():
    grid = cells(["unshielded", "shielded"], roundings=(0.05, 0.1), bursts=(0.0, 3.0))
    shown = panels(sweep_map(grid, ["unshielded", "shielded"], QUANTITIES["return"]))
    titles = [axis.get_title().replace(",\n", ", ") for axis in shown]
    assert len(titles) == len(set(titles)) == 8
    assert "shielded\nquantization 0.1, bursts of 3" in titles
    assert "shielded\nquantization 0.1, independent losses" in titles


def test_one_channel_is_a_map_of_one_field():
    grid = cells(["shielded"], losses=(0.3,), delays=(2,))
    axis = panels(sweep_map(grid, ["shielded"], QUANTITIES["return"]))[0]
    assert numbers(axis) == ["\N{MINUS SIGN}1.5"]


def test_interventions_are_those_of_arms_with_a_shield_only():
    arms = ["unshielded", "penalized", "monitor", "shielded"]
    with without_pictures():
        figures = sweep_figures({"cells": cells(arms, losses=(0.0,))}, arms)
        others = sweep_figures({"cells": cells(arms, losses=(0.0,))}, ["unshielded"])
    assert set(figures) == {"violations", "return", "interventions"}
    assert set(others) == {"violations", "return"}


def test_captions_say_over_how_many_runs_and_what_a_monitor_counts():
    grid = cells(["monitor"])
    assert "2 runs per field" in sweep_map(grid, ["monitor"], QUANTITIES["violations"]).caption
    assert "would have overridden" in sweep_map(grid, ["monitor"], QUANTITIES["interventions"]).caption
    assert "would have" not in sweep_map(cells(["shielded"]), ["shielded"], QUANTITIES["interventions"]).caption


def test_losses_of_commands_stand_against_losses_of_samples():
    grid = [cell | {"downlink_loss": loss} for loss in (0.0, 0.4) for cell in cells(["shielded"], delays=(2,))]
    figure = sweep_map(grid, ["shielded"], QUANTITIES["violations"])
    (axis,) = panels(figure)
    np.testing.assert_allclose(axis.images[0].get_array(), [[0.0, 1.0, 2.0]] * 2)
    assert [tick.get_text() for tick in axis.get_yticklabels()] == ["0", "0.4"]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("loss probability", "loss of commands")


def test_delays_have_panels_of_their_own_beside_losses_of_commands():
    grid = [cell | {"downlink_loss": loss} for loss in (0.0, 0.4) for cell in cells(["shielded"])]
    titles = [axis.get_title() for axis in panels(sweep_map(grid, ["shielded"], QUANTITIES["violations"]))]
    assert len(titles) == 2
    assert titles == ["shielded\ndelay 0", "shielded\ndelay 4"]
