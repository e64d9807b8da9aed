"""The rule of forced requests keeps the contract whatever is asked for, lost and late; one step later breaks it."""

from itertools import product

import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, cart_pole, truck_trailer
from ncs_gym.network.requests import Requests, spare_samples
from tests.product import loop_env, vector_env

# Longest runs of losses, shortest and longest delays, steps that a contract allows beyond what they need, and leads.
SETTINGS = [
    (losses, shortest, longest, beyond, input_delay)
    for losses, shortest, longest, beyond, input_delay in product(
        (0, 1, 2), (0, 1, 2), (0, 1, 2), (0, 1, 2, 3), (0, 1, 2)
    )
    if shortest <= longest and losses + longest + beyond + input_delay <= 7
]


def oldest_age(kind, losses, shortest, longest, beyond, input_delay):
    """The largest age over all requests, losses and delays, and how many states were seen; ends beyond the contract.

    A state is the age, what was requested of the samples up to k + c, the packets on their way (how old their samples
    are, and in how many steps they arrive), and how many were lost in a row.
    """
    h = losses + longest + beyond
    channel = Channel(0.5, delay=shortest, jitter=longest - shortest, max_consecutive_losses=losses, on_request=True)
    first = tuple(kind(channel, ChannelContract(h), input_delay, 1)._flags[:, 0].tolist())
    seen = frontier = {(0, first, frozenset(), 0)}
    oldest = 0
    while frontier:
        # Each state twice: nobody asks, somebody does.
        states = [state for state in frontier for _ in range(2)]
        requests = kind(channel, ChannelContract(h), input_delay, len(states))
        requests._flags = np.array([flags for _, flags, _, _ in states]).T
        requests.ask(np.arange(len(states)) % 2 == 1)
        requests.decide(np.array([age for age, _, _, _ in states]))
        sent, following = requests.decided[0].tolist(), set()
        for (age, _, flying, lost), flags, sends in zip(states, requests._flags.T.tolist(), sent, strict=True):
            flying = {(old + 1, left - 1) for old, left in flying}
            outcomes = [(flying, lost)]
            if sends:
                outcomes = [(flying | {(0, delay)}, 0) for delay in range(shortest, longest + 1)]
                outcomes += [(flying, lost + 1)] if lost < losses else []
            for packets, in_a_row in outcomes:
                now = min([age + 1, *(old for old, left in packets if left == 0)])
                oldest = max(oldest, now)
                newer = frozenset((old, left) for old, left in packets if left > 0 and old < now)
                following.add((now, tuple(flags), newer, in_a_row))
        if oldest > h:
            break
        frontier = following - seen
        seen = seen | frontier
    return oldest, len(seen)


@pytest.mark.cases(1)
@pytest.mark.parametrize("input_delay", [0, 1, 2])
def test_no_requests_losses_and_delays_make_a_sample_older_than_the_contract_allows(input_delay):
    count = 0
    for setting in (each for each in SETTINGS if each[-1] == input_delay):
        losses, _, longest, beyond, _ = setting
        oldest, states = oldest_age(Requests, *setting)
        assert oldest == losses + longest + beyond, setting  # and no less: the rule forces no sooner than it has to
        count += states
    print(f"input delay {input_delay}: {count:,} states")


def cart_pole_loop(kind, *count, **settings):
    """The cart-pole with samples on request, of which five steps' worth may be left out."""
    channel = Channel(0.5, delay=1, jitter=1, max_consecutive_losses=2, quantization_step=1e-4, on_request=True)
    return kind(*count, plant=cart_pole(), channel=channel, contract=ChannelContract(9, 1e-4), **settings)


def test_samples_are_taken_only_where_asked_or_forced():
    env = cart_pole_loop(loop_env)
    _, info = env.reset(seed=0)
    assert (info["requested"], info["request_forced"], info["packets"]) == (False, False, 0)
    ages, packets = [], 0
    for step in range(120):
        asks = step % 17 == 3
        env.request(asks)
        info = env.step(np.zeros(1, np.float32))[-1]
        assert info["requested"] == (asks or info["request_forced"])
        packets += info["requested"]
        assert info["packets"] == packets
        ages.append(info["measurement_age"])
        assert not info["contract_broken"]
    assert max(ages) > 6
    assert packets < 60


def test_first_sample_that_is_needed_is_that_after_the_spare_ones():
    own = loop_env(plant=cart_pole(), channel=Channel(0.5, delay=1, max_consecutive_losses=2, on_request=True))
    for env, spare in ((cart_pole_loop(loop_env), 5), (own, 0)):
        env.reset(seed=0)
        forced = [env.step(np.zeros(1, np.float32))[-1]["request_forced"] for _ in range(6)]
        assert forced == [False] * spare + [True] * (1 if spare else 6)
        assert spare_samples(env.channel, env.contract) == spare


def test_outstanding_samples_are_those_requested_and_newer_than_the_newest():
    env = cart_pole_loop(loop_env)
    env.reset(seed=0)
    stamps = []
    for step in range(1, 200):
        if step % 3:
            env.request()
        info = env.step(np.zeros(1, np.float32))[-1]
        stamps += [step] * info["requested"]
        assert env.outstanding == sum(stamp > step - info["measurement_age"] for stamp in stamps)


def test_outstanding_samples_without_a_contract_are_those_that_may_still_arrive():
    env = loop_env(plant=truck_trailer(), channel=Channel(loss=1.0, delay=2, on_request=True))
    env.reset(seed=0)
    for step in range(1, 9):
        env.request()
        env.step(np.zeros(1, np.float32))
        assert env.outstanding == min(step, 2)


def test_stable_plant_without_a_contract_is_never_forced_to_a_sample():
    env = vector_env(3, plant=truck_trailer(), channel=Channel(0.3, delay=2, on_request=True))
    env.reset(seed=0)
    for _ in range(60):
        *_, info = env.step(np.zeros((3, 1), np.float32))
    assert info["packets"].tolist() == [0, 0, 0]
    assert info["measurement_age"].tolist() == [60, 60, 60]
    env.request(np.array([True, False, True]))
    *_, info = env.step(np.zeros((3, 1), np.float32))
    assert info["packets"].tolist() == [1, 0, 1]
    *_, info = env.step(np.zeros((3, 1), np.float32))  # a request is about one sample
    assert info["packets"].tolist() == [1, 0, 1]


@pytest.mark.parametrize("kind", [loop_env, vector_env])
def test_contract_is_kept_over_an_episode_channel_that_loses_and_delays_more(kind):
    settings = {"loss": 0.9, "quantization_step": 1e-4, "on_request": True}
    narrow, wide = Channel(max_consecutive_losses=0, **settings), Channel(delay=3, max_consecutive_losses=3, **settings)
    many = kind is vector_env
    env = kind(*[4] * many, plant=cart_pole(), channel=narrow, contract=ChannelContract(9, 1e-4))
    assert env.contract.is_kept_by(wide)
    actions = np.zeros((4, 1) if many else 1, np.float32)
    env.reset(seed=0, options={"channel": [wide, narrow, wide, None] if many else wide})
    ages = np.array([env.step(actions)[-1]["measurement_age"] for _ in range(300)])
    assert (ages.max(axis=0) == 9).all()
    env.reset()  # and its own channel again leaves as many samples out as before
    forced = np.array([env.step(actions)[-1]["request_forced"] for _ in range(10)])
    assert (forced.sum(axis=0) == 1).all()


def test_samples_are_sent_where_the_downlink_broke_its_contract():
    downlink = Channel(loss=1.0, delay=1)
    env = cart_pole_loop(loop_env, downlink=downlink, downlink_contract=ChannelContract(2))
    env.reset(seed=0)
    infos = [env.step(np.zeros(1, np.float32))[-1] for _ in range(8)]
    assert [info["downlink_broken"] for info in infos] == [False] * 2 + [True] * 6
    assert [info["packets"] for info in infos] == list(range(1, 9))


def test_requests_behind_a_downlink_take_effect_when_the_input_does():
    env = cart_pole_loop(loop_env, downlink=Channel(delay=3))
    env.reset(seed=0)
    env.request()
    packets = [env.step(np.zeros(1, np.float32))[-1]["packets"] for _ in range(5)]
    assert packets == [1, 2, 3, 4, 4]  # three by agreement, and the one asked for
