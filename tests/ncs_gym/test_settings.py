"""Settings of environments and estimators are read, and never set."""

import inspect

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, NCSEnv
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.plants.library import batch_reactor

ID = "ncs_gym/TruckTrailerCruise-v0"
DOWNLINK = {"downlink": Channel(delay=1), "downlink_contract": ChannelContract(2)}
MAKES = [lambda: gym.make(ID, **DOWNLINK), lambda: gym.make_vec(ID, num_envs=2, **DOWNLINK)]


@pytest.mark.parametrize("make", MAKES, ids=["one", "many"])
def test_settings_of_an_environment_and_its_state_are_not_set(make):
    env = make()
    _, info = env.reset(seed=0)
    inner, before = env.unwrapped, info["state"].copy()
    given = {*inspect.signature(NCSEnv.__init__).parameters} - {"self", "render_mode"}
    for name in given | {"error_set", "certificate_contract", "state"}:
        with pytest.raises(AttributeError):
            setattr(inner, name, getattr(inner, name))
    inner.state[:] = 7.0  # a copy
    np.testing.assert_array_equal(inner.state, before)


def test_what_estimators_share_cannot_be_written_to():
    """Shapes in other units, made in place, once changed those of every environment with the same plant."""
    estimator = Estimator(batch_reactor(), Channel(), certified_error_set(batch_reactor(), ChannelContract(3)))
    estimator.advance(np.zeros(2), [])
    for array in (estimator.shape, estimator.mean):
        with pytest.raises(ValueError, match="read-only"):
            array *= 1e-4
    many = gym.make_vec("ncs_gym/CartPole-v0", num_envs=3).unwrapped
    many.reset(seed=0)
    with pytest.raises(ValueError, match="read-only"):
        many.belief.table.shapes[...] = 1e-4
