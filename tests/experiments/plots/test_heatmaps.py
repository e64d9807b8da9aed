from itertools import product

import numpy as np
import pytest

from experiments.plots.heatmaps import sweep_map


def cells(arms, losses=(0.0, 0.3, 0.6), delays=(0, 4), roundings=(None,), bursts=(1.0,), rate=None):
    def numbers(at):
        return {"runs": 2, "eval_violation_rate": 0.01 * at if rate is None else rate}

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
    figure = sweep_map(cells(arms), arms)
    assert [axis.get_title() for axis in panels(figure)] == arms
    assert all(len(numbers(axis)) == 6 for axis in panels(figure))


def test_fields_stand_at_their_loss_and_delay():
    axis = panels(sweep_map(cells(["shielded"]), ["shielded"]))[0]
    np.testing.assert_allclose(axis.images[0].get_array(), [[0.0, 2.0, 4.0], [1.0, 3.0, 5.0]])
    assert numbers(axis) == ["0", "2.0", "4.0", "1.0", "3.0", "5.0"]
    assert [tick.get_text() for tick in axis.get_xticklabels()] == ["0", "0.3", "0.6"]
    assert [tick.get_text() for tick in axis.get_yticklabels()] == ["0", "4"]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("loss probability", "delay [steps]")


def test_numbers_are_light_on_dark_fields_and_all_panels_share_one_color_scale():
    grid = cells(["unshielded", "shielded"])
    grid[-1]["arms"] |= {"unshielded": {"runs": 2, "eval_violation_rate": 0.9}}
    first, second = panels(sweep_map(grid, ["unshielded", "shielded"]))
    assert first.images[0].get_clim() == second.images[0].get_clim() == (0.0, 90.0)
    colors = {text.get_text(): text.get_color() for text in first.texts}
    assert colors["90.0"] == "white"  # dark red
    assert colors["1.0"] != "white"


def test_no_violations_are_pale_and_few_are_not_as_dark_as_many():
    axis = panels(sweep_map(cells(["shielded"], rate=0.0), ["shielded"]))[0]
    assert axis.images[0].get_clim() == (0.0, 10.0)
    assert set(numbers(axis)) == {"0"}
    axis = panels(sweep_map(cells(["shielded"], rate=0.7), ["shielded"]))[0]
    assert axis.images[0].get_clim() == (0.0, 70.0)


def test_quantization_steps_and_bursts_have_panels_of_their_own():
    grid = cells(["unshielded", "shielded"], roundings=(0.05, 0.1), bursts=(0.0, 3.0))
    shown = panels(sweep_map(grid, ["unshielded", "shielded"]))
    titles = [axis.get_title().replace(",\n", ", ") for axis in shown]
    assert len(titles) == len(set(titles)) == 8
    assert "shielded\nquantization 0.1, bursts of 3" in titles
    assert "shielded\nquantization 0.1, independent losses" in titles


def test_one_channel_is_a_map_of_one_field():
    figure = sweep_map(cells(["shielded"], losses=(0.3,), delays=(2,), rate=0.015), ["shielded"])
    assert numbers(panels(figure)[0]) == ["1.5"]
    assert "2 runs per field" in figure.caption


def test_losses_of_commands_stand_against_losses_of_samples():
    grid = [cell | {"downlink_loss": loss} for loss in (0.0, 0.4) for cell in cells(["shielded"], delays=(2,))]
    figure = sweep_map(grid, ["shielded"])
    (axis,) = panels(figure)
    np.testing.assert_allclose(axis.images[0].get_array(), [[0.0, 1.0, 2.0]] * 2)
    assert [tick.get_text() for tick in axis.get_yticklabels()] == ["0", "0.4"]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("loss probability", "loss of commands")


def test_delays_have_panels_of_their_own_beside_losses_of_commands():
    grid = [cell | {"downlink_loss": loss} for loss in (0.0, 0.4) for cell in cells(["shielded"])]
    titles = [axis.get_title() for axis in panels(sweep_map(grid, ["shielded"]))]
    assert len(titles) == 2
    assert titles == ["shielded\ndelay 0", "shielded\ndelay 4"]
