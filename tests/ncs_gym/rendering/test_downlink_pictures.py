"""A picture shows that the downlink broke its contract, and which input was decided rather than applied."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract
from ncs_gym.rendering import theme

pytest.importorskip("pygame")


def test_picture_says_that_the_downlink_broke():
    settings = {"downlink": Channel(loss=0.5), "downlink_contract": ChannelContract(1), "render_mode": "rgb_array"}
    env = gym.make("ncs_gym/TruckTrailerCruiseTwoWay-v0", **settings)
    env.reset(seed=0)
    renderer, missing = env.unwrapped.renderer, 0
    for _ in range(30):
        *_, info = env.step(np.array([0.5], np.float32))
        missing += info["downlink_broken"]
        frame = renderer.frame_record()
        assert frame.missing_inputs == missing
        assert frame.input_missing == info["downlink_broken"]
        np.testing.assert_array_equal(frame.committed, info["input_committed"])
        np.testing.assert_array_equal(frame.input, info["input"])
    assert missing > 0
    picture = env.render()
    renderer._picture.draw(replace(frame, missing_inputs=0))
    without = renderer._picture._canvas.pixels()
    row, end = int(theme.HEADER.h) + 13, 200
    changed = (picture != without).any(axis=-1)
    assert changed[row - 8 : row + 8, 16:end].any()
    changed[row - 12 : row + 12] = False
    assert not changed.any()
