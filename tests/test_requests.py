"""Policies that ask for samples: what they ask for, what the contract adds, and what is counted."""

import gymnasium as gym
import numpy as np
import pytest

from benchmarks.requests import (
    Asking,
    acknowledged,
    at_random,
    best_period,
    every,
    played,
    slack,
    with_rule,
)
from ncs_gym import Channel, ChannelContract, VectorRequestActions
from tests.certificates import certificate_of
from tests.product import vector_shield

ID, COUNT, STEPS = "ncs_gym/LaneKeepingOnRequest-v0", 12, 44


def environments(cost=0.1, **settings):
    envs = gym.make_vec(ID, num_envs=COUNT, max_episode_steps=STEPS, **settings)
    inner = envs.unwrapped
    shield = vector_shield(envs, certificate_of(inner.plant, inner.certificate_contract))
    return VectorRequestActions(shield, cost)


def weakly_pushing(observations, infos):
    return np.full((len(observations), 1), 0.3)


def result_of(rule, **settings):
    env = environments(**settings)
    return played(env, with_rule(Asking(env, weakly_pushing), rule), seed=0)


def test_best_period_keeps_the_contract_and_the_next_one_does_not():
    for losses, delay, age in [(2, 1, 8), (0, 0, 0), (1, 3, 12), (2, 0, 4)]:
        channel, contract = Channel(0.5, delay=delay, max_consecutive_losses=losses), ChannelContract(age)
        period = best_period(channel, contract)
        kept = [
            contract.is_kept_by(Channel(0.5, delay=delay, max_consecutive_losses=losses, send_period=each))
            for each in (period, period + 1)
        ]
        assert kept == [True, False]


@pytest.mark.parametrize(
    ("rule", "low", "high"),
    [
        (every(1), 1.0, 1.0),
        (every(2), 0.5, 0.5),
        (at_random(0.0), 0.3, 0.36),
        (acknowledged(2), 0.3, 0.45),
        (slack(np.inf), 0.5, 0.5),
    ],
)
def test_policies_send_what_they_say_and_the_contract_holds(rule, low, high):
    result = result_of(rule)
    assert low <= result.packets <= high
    assert result.oldest <= 8
    assert (result.violations, result.unproved) == (0, 0)


def test_contract_forces_nothing_on_the_best_period_and_everything_on_who_never_asks():
    assert result_of(every(2)).forced == 0.0
    never = result_of(at_random(0.0))
    assert never.forced == never.packets > 0.0
