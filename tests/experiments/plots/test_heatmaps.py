from itertools import product

import numpy as np
import pytest

from experiments.plots.heatmaps import sweep_map


def cells(arms, losses=(0.0, 0.3, 0.6), delays=(0, 4)):
    return [
        {"loss": loss, "delay": delay, "arms": {arm: {"runs": 2, "eval_violation_rate": 0.01 * at} for arm in arms}}
        for at, (loss, delay) in enumerate(product(losses, delays))
    ]


def panels(figure):
    return [axis for axis in figure.axes if axis.get_visible() and axis.images]


def numbers(axis):
    return [text.get_text() for text in axis.texts]


@pytest.mark.parametrize("count", [1, 5])
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
