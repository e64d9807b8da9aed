"""Conditions of evaluation: what they change, and what is kept of them."""

import json
from dataclasses import replace

import gymnasium as gym

from agents.loop import LoopConfig
from experiments.analysis.episodes import arm_summary
from experiments.report import summary_text
from experiments.runs.loops import other_scenarios, scenario_named, under, worse_channel
from ncs_gym import AdversarialDisturbance, Channel, ChannelContract, GilbertElliott
from ncs_gym.envs.env import ncs_env
from tests.experiments.results import run

CRUISE, CART_POLE = "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/CartPole-v0"
ATTACKS = ("attacked", "attacked on an ideal channel")
ALL = ("worst-case disturbance", "worse channel", "gaussian")


def test_names_take_hyphens_and_the_condition_of_training_is_no_other_one():
    assert scenario_named("worst-case-disturbance") == "worst-case disturbance"
    assert other_scenarios(("as-trained", "worse-channel", "worse channel")) == ("worse channel",)


def test_each_condition_changes_one_thing_in_both_kinds_of_environment():
    loop = LoopConfig(env=CRUISE)
    assert under("as trained", loop) is loop
    for single in (lambda x: ncs_env(x.single()), lambda x: x.vector(2).unwrapped.single):
        own = single(loop)
        disturbed, late, unbounded = (single(under(name, loop)) for name in ALL)
        assert isinstance(disturbed.disturbance, AdversarialDisturbance)
        assert (disturbed.channel, disturbed.noise) == (own.channel, own.noise)
        assert late.channel == replace(own.channel, loss=0.65, delay=4)
        assert type(late.disturbance) is type(own.disturbance)
        assert (unbounded.noise, unbounded.channel) == ("gaussian", own.channel)


def test_worse_channel_uses_what_the_contract_leaves_and_bursts_get_denser():
    env = ncs_env(gym.make(CART_POLE))
    worse = worse_channel(env.channel, env.contract)
    assert env.contract.is_kept_by(worse)
    assert worse == replace(env.channel, loss=0.6, delay=env.channel.longest_delay, jitter=0)
    bursts = GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.5, loss_good=0.0, loss_bad=0.6)
    channel = Channel(loss=bursts, send_period=2, max_consecutive_losses=1)
    worse = worse_channel(channel, ChannelContract(max_age=4))
    assert (worse.loss.loss_good, worse.loss.loss_bad, worse.delay) == (0.5, 0.8, 1)
    assert worse_channel(Channel(), None) == Channel(loss=0.5, delay=1)
    assert worse_channel(Channel(), ChannelContract(max_age=3)) == Channel(delay=1)


def test_summary_and_table_have_a_block_per_scenario():
    results = {name: run(name) for name in ("lqr", "lqr+trusting", "lqr+shielded")}
    for name, result in results.items():
        count = 5 if name == "lqr+trusting" else 0
        result.scenarios["worst-case disturbance"] = run(name, violations=(count, count)).episodes
    modes = {"lqr": None, "lqr+trusting": "trusting", "lqr+shielded": "project"}
    arms = {name: arm_summary([results[name]], mode, fixed_policy=True) for name, mode in modes.items()}
    json.dumps(arms, allow_nan=False)
    assert {name: arm["shielded"] for name, arm in arms.items()} == dict.fromkeys(modes, False) | {"lqr+shielded": True}
    pushed = arms["lqr+trusting"]["conditions"]["worst-case disturbance"]
    assert pushed["eval_violation_steps"] > arms["lqr+trusting"]["eval_violation_steps"]
    _, text = summary_text(arms, {}).split("\nworst-case disturbance\n")
    assert f" {pushed['eval_violation_steps']:,} " in text


def test_attack_is_as_strong_as_the_contract_allows_and_on_an_ideal_channel_the_network_alone_is_missing():
    loop = LoopConfig(env="ncs_gym/CSTR-v0")
    own, attacked, without = (ncs_env(each.single()) for each in (loop, *(under(name, loop) for name in ATTACKS)))
    assert attacked.channel == replace(own.channel, loss=1.0)
    assert attacked.contract.is_kept_by(attacked.channel)
    assert without.channel == Channel()
    for env in (attacked, without):
        assert isinstance(env.disturbance, AdversarialDisturbance)
        assert (env.noise, env.contract) == ("extreme", own.contract)
    ideal = ncs_env(under("ideal channel", loop).single())
    assert (ideal.channel, ideal.noise, type(ideal.disturbance)) == (Channel(), own.noise, type(own.disturbance))
