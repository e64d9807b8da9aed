"""What the shield tells the picture."""

import gymnasium as gym
import numpy as np

from ncs_gym.rendering import theme
from tests.product import safety_shield

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
FULL_THROTTLE = np.ones(1, np.float32)


def shielded(certificate, mode="project", render_mode="rgb_array"):
    env = safety_shield(gym.make(CRUISE, render_mode=render_mode), certificate, mode=mode)
    env.reset(seed=0)
    return env


def count(pixels, color, rect, off=6):
    x, y, w, h = (round(value) for value in rect)
    part = pixels[y : y + h, x : x + w].astype(int)
    return int((np.abs(part - np.array(color)).max(axis=-1) <= off).sum())


def test_safe_set_is_in_the_picture_from_reset_on(certificate):
    env = shielded(certificate)
    bare = gym.make(CRUISE, render_mode="rgb_array")
    bare.reset(seed=0)
    for _ in range(2):
        assert count(env.render(), theme.SAFE_FILL, theme.PLANE) > 10_000
        assert count(bare.render(), theme.SAFE_FILL, theme.PLANE) == 0
        env.step(FULL_THROTTLE)
        bare.step(FULL_THROTTLE)


def test_an_intervention_shows_in_its_frame_and_in_no_other(certificate):
    env = shielded(certificate)
    seen = set()
    for k in range(12):
        info = env.step(FULL_THROTTLE if k < 7 else np.zeros(1, np.float32))[4]
        tinted = count(env.render(), theme.SHIELD_FILL, theme.PLANT_VIEW) > 10_000
        assert tinted == info["shield_intervened"]
        seen.add(tinted)
    assert seen == {True, False}
