"""What an environment is made with is read, also of many at once, and never set."""

import gymnasium as gym
import pytest

from ncs_gym import Channel, ChannelContract
from ncs_gym.envs.env import NCSEnv

ID = "ncs_gym/TruckTrailerCruise-v0"
DOWNLINK = {"downlink": Channel(delay=1), "downlink_contract": ChannelContract(2)}
NAMES = (
    "plant", "channel", "task", "disturbance", "initial_set", "terminate_on_violation", "allow_assumption_violation",
    "contract", "horizon", "noise", "process", "downlink", "downlink_contract",
)  # fmt: skip
MADE = {
    "gym.make(id, channel=...)": lambda: gym.make(ID, **DOWNLINK).unwrapped,
    "gym.make_vec(id, num_envs, channel=...)": lambda: gym.make_vec(ID, num_envs=2, **DOWNLINK),
}


@pytest.mark.parametrize("way", MADE)
@pytest.mark.parametrize("name", NAMES)
def test_setting_is_read_and_setting_it_says_how_to_make_another(way, name):
    env = MADE[way]()
    value = getattr(env, name)
    with pytest.raises(AttributeError) as refused:
        setattr(env, name, value)
    kind = type(env).__name__
    sentence = f"{name} is a setting of {kind} and cannot be changed: make another {kind} with it, as in {way}"
    assert str(refused.value) == sentence
    assert getattr(env, name) is value
    one = env if isinstance(env, NCSEnv) else env.single
    assert getattr(one, name) is value


@pytest.mark.parametrize("way", MADE)
def test_contract_of_the_downlink_is_the_one_given_or_what_its_settings_guarantee(way):
    assert MADE[way]().downlink_contract == ChannelContract(2)
    assert NCSEnv(MADE[way]().plant, downlink=Channel(delay=1)).downlink_contract == ChannelContract(1)
    assert NCSEnv(MADE[way]().plant).downlink_contract is None
