"""What cannot keep the contract of a certificate is pointed out where certificate and channel meet."""

import warnings

import pytest

from ncs_gym import BrokenContractWarning, Channel, ChannelContract, RandomChannel, VectorRandomChannel, cart_pole
from shields import GuaranteeLostWarning
from tests.certificates import certificate_of
from tests.product import loop_env, safe_loop, safety_shield, vector_env, vector_shield

PLANT, CONTRACT = cart_pole(), ChannelContract(4)
DOWNLINK = Channel(loss=0.2, delay=1, max_consecutive_losses=2)  # c = 3


def loop(channel, downlink):
    return safe_loop(certificate_of(PLANT, CONTRACT), PLANT, channel, downlink=downlink)


def shield(channel, downlink):
    env = loop_env(PLANT, channel, contract=CONTRACT, downlink=downlink)
    return safety_shield(env, certificate_of(PLANT, CONTRACT))


def many_shields(channel, downlink):
    env = vector_env(num_envs=2, plant=PLANT, channel=channel, contract=CONTRACT, downlink=downlink)
    return vector_shield(env, certificate_of(PLANT, CONTRACT))


@pytest.mark.parametrize("make", [loop, shield, many_shields])
@pytest.mark.parametrize(
    ("channel", "downlink", "words"),
    [
        (Channel(send_period=3, delay=3), None, "become 5 steps old, but .* allows 4 steps in all"),
        (Channel(delay=2), DOWNLINK, "become 2 steps old, and what is decided takes effect 3 steps later, but"),
    ],
)
def test_channel_that_breaks_the_contract_without_any_loss_is_pointed_out(make, channel, downlink, words):
    with pytest.warns(BrokenContractWarning, match=words) as caught:
        make(channel, downlink)
    assert [each.filename for each in caught] == [__file__]


def test_rounding_that_the_contract_does_not_allow_is_pointed_out():
    env = loop_env(PLANT, Channel(quantization_step=0.01, max_consecutive_losses=0))
    with pytest.warns(BrokenContractWarning, match="the channel rounds measurements to 0.01, but .* allows 0, so"):
        safety_shield(env, certificate_of(PLANT, CONTRACT))


@pytest.mark.parametrize(
    ("make", "channel", "downlink"),
    [(loop, Channel(delay=4), None), (shield, Channel(loss=0.9, jitter=9), None), (loop, Channel(delay=1), DOWNLINK)],
)
def test_channel_that_may_keep_the_contract_is_taken_without_a_warning(make, channel, downlink):
    with warnings.catch_warnings():
        warnings.simplefilter("error", BrokenContractWarning)
        make(channel, downlink)


@pytest.mark.parametrize(
    ("channel", "words"),
    [
        (Channel(loss=0.3, delay=1, max_consecutive_losses=7), "newest sample become 8 steps old"),
        (Channel(loss=0.3, delay=1), "may lose any number of packets in a row"),
    ],
)
def test_real_loop_points_out_losses_that_break_the_contract(channel, words):
    with pytest.warns(BrokenContractWarning, match=words) as caught:
        loop(channel, None)
    assert [each.filename for each in caught] == [__file__]


@pytest.mark.parametrize("make", [shield, many_shields])
def test_channel_of_an_episode_that_breaks_the_contract_is_pointed_out_once(make):
    env, late = make(Channel(), None), Channel(delay=9)
    for _ in range(2):
        with pytest.warns(BrokenContractWarning, match="become 9 steps old") as caught:
            env.reset(seed=0, options={"channel": late})
        assert [each.filename for each in caught if each.category is BrokenContractWarning] == [__file__]
        with warnings.catch_warnings():
            warnings.simplefilter("error", BrokenContractWarning)
            env.reset(options={"channel": late})
            env.reset(options={"channel": Channel(delay=4)})


@pytest.mark.cases(1)
@pytest.mark.parametrize("outside", [True, False])
def test_shield_keeps_its_guarantee_over_drawn_channels_and_says_where_it_is_lost(outside):
    fitting = [Channel(), Channel(loss=0.5, delay=1, max_consecutive_losses=2), Channel(delay=4, quantization_step=0)]

    def shielded(env, vector):
        drawn, safe = (VectorRandomChannel, vector_shield) if vector else (RandomChannel, safety_shield)
        certificate = certificate_of(PLANT, CONTRACT)
        return drawn(safe(env, certificate), fitting) if outside else safe(drawn(env, fitting), certificate)

    many = shielded(vector_env(8, plant=PLANT, contract=CONTRACT, max_episode_steps=20), vector=True)
    many.reset(seed=0)
    for _ in range(100):
        info = many.step(many.action_space.sample())[4]
        assert info["shield_guaranteed"].all()
        assert not info["cost"].any()
    one = shielded(loop_env(PLANT, contract=CONTRACT), vector=False)
    for seed in range(6):
        one.reset(seed=seed)
        assert all(one.step(one.action_space.sample())[4]["shield_guaranteed"] for _ in range(20))
    one.reset(seed=0, options={"channel": Channel(loss=1.0)})
    with pytest.warns(GuaranteeLostWarning, match="older than the contract"):
        [one.step(one.action_space.sample()) for _ in range(10)]
