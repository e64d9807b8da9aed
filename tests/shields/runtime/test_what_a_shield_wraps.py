"""A shield says at each reset whether what it was made for is what it wraps."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorWrapper
from gymnasium.wrappers import StickyAction

from ncs_gym import Channel, ChannelContract, Ellipsoid, LinearProcess, truck_trailer
from shields.runtime.guarantee import OTHER_STEPS
from tests.certificates import certificate_of
from tests.product import loop_env, safety_shield, vector_env, vector_shield

PLANT = truck_trailer(mass=4000.0)
# Settings of another loop: what only somebody with a will to can put in place of the one that moves.
CHANGED = {
    "plant": truck_trailer(mass=4000.0),
    "channel": Channel(delay=4, quantization_step=0.5),
    "contract": ChannelContract(3),
    "downlink": Channel(delay=2),
    "process": LinearProcess(),
    "initial_set": Ellipsoid(3.0 * np.eye(2)),
}


def scalar(**settings):
    return safety_shield(loop_env(PLANT, **settings), certificate_of(PLANT))


def vector(**settings):
    return vector_shield(vector_env(2, plant=PLANT, **settings), certificate_of(PLANT))


# Where settings are kept: in the environment, inside a vector, or in the vector, which has neither process nor start.
@pytest.mark.parametrize("name", CHANGED)
@pytest.mark.parametrize("shielded", [scalar, vector])
def test_changed_setting_is_said_at_the_next_reset_and_without_one_nothing_is_guaranteed(shielded, name):
    shield = shielded()
    shield.reset(seed=0)
    now = shield.unwrapped._now  # what moves: an environment itself has no settings to be changed
    now.loop = replace(now.loop, **{name: CHANGED[name]})
    for _ in range(2):
        with pytest.raises(ValueError, match="the loop is not the one that the shield was made for"):
            shield.reset()
    *_, info = shield.step(np.zeros(shield.action_space.shape))
    assert np.all(info["shield_reason"] == OTHER_STEPS)


@pytest.mark.parametrize("shielded", [scalar, vector])
def test_another_environment_in_place_of_the_wrapped_one_is_said_at_the_next_reset(shielded):
    shield = shielded()
    shield.reset(seed=0)
    other = shielded().env
    other.reset(seed=0)
    shield.env = other
    with pytest.raises(ValueError, match="the environment is not the one that the shield was made for"):
        shield.reset()


def test_wrapper_put_inside_after_wrapping_is_refused_at_the_next_reset():
    shield = scalar()
    shield.reset(seed=0)
    shield.env = StickyAction(shield.env, 0.5)
    with pytest.raises(ValueError, match="the shield must be inside StickyAction"):
        shield.reset()
    shield.env = gym.Wrapper(shield.env.env)  # that only looks
    assert shield.reset()[1]["shield_guaranteed"]


def test_wrapper_that_changes_a_setting_in_its_reset_is_found_at_the_next_one():
    class Widens(VectorWrapper):
        def reset(self, **keywords):
            now = self.unwrapped._now
            now.loop = replace(now.loop, initial_set=Ellipsoid(3.0 * np.eye(2)))
            return self.env.reset(**keywords)

    shield = vector_shield(Widens(vector_env(2, plant=PLANT)), certificate_of(PLANT))
    with pytest.raises(ValueError, match="the loop is not the one"):
        shield.reset(seed=0)
