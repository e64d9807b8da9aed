"""Tries to drive a plant out of its box under mode "lookahead", every bound attained, by one who knows the plan."""

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, NCSEnv, cart_pole
from ncs_gym.network.contract import contract_of
from shields import SafeLoop, SafetyShield
from shields.runtime.backup_plans import plan_check as plan_test
from shields.runtime.backup_plans.plan_check import tightenings
from shields.runtime.guarantee import NOT_KNOWN_INSIDE, OLD_SAMPLE, OTHER_INPUT
from tests.certificates import certificate_of
from tests.shields.backup_plans.adversary import CASES, OUTSIDE, WeakestPoint, attack, box_ellipsoid, case, extremal_env
from tests.shields.backup_plans.test_plan_search import FAILURES, break_solver

POLICIES = ("random", "outwards", "constant")
MOST_TRIED = "cruise", "cart-pole", "batch reactor"


def attack_for_long(env):
    for seed in range(8):
        for policy in POLICIES:
            attack(env, policy, seed, 10, 60)


def total(counts):
    return {key: sum(each[key] for each in counts) for key in counts[0]}


@pytest.mark.parametrize("episodes", [3, pytest.param(120, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("name", "channel"), CASES)
def test_no_state_that_is_guaranteed_leaves_the_box(name, channel, episodes):
    env = extremal_env(name, channel)
    counts = [attack(env, policy, seed, episodes, 60) for seed, policy in enumerate(POLICIES)]
    assert total(counts)["guaranteed"] > 0
    # In these every input that matters passes the one-step test, of the ellipsoid or of the polytope.
    assert total(counts)["planned"] > 0 or name in ("n=3 m=2", "n=6 m=2, polytope")


@pytest.mark.parametrize("name", [*MOST_TRIED, "cart-pole, polytope", "batch reactor, polytope"])
def test_the_attack_comes_close_and_lives_from_plans_and_stored_tails(name):
    env = extremal_env(name, "overtaking")
    counts = total([attack(env, policy, 7, 10, 60) for policy in POLICIES])
    assert counts["closest"] / len(POLICIES) > 0.98
    assert counts["outside S"] > (0.1 if name.endswith("polytope") else 0.2) * counts["guaranteed"]
    assert counts["stored"] > 20
    if name not in ("cruise", "batch reactor, polytope"):  # there the safe set fills most of the box
        assert counts["starts"] > 0


@pytest.mark.parametrize("how", FAILURES)
def test_no_failure_of_the_solver_leaves_the_box(how, monkeypatch):
    break_solver(monkeypatch, how, np.random.default_rng(0))
    for name in ("cart-pole", "batch reactor"):
        counts = attack(extremal_env(name, "overtaking"), "random", 3, 3, 50)
        assert counts["guaranteed"] > 0


def without_tightening(prediction, shapes):
    """Box rows as if states were known and nothing disturbed them."""
    known = tightenings(prediction, shapes)
    return known._replace(row_limits=np.ones_like(known.row_limits))


def without_a_step_of_disturbance(prediction, shapes):
    """The last step's disturbance is left out of every row."""
    known, plant = tightenings(prediction, shapes), prediction.plant
    return known._replace(row_limits=known.row_limits + plant.disturbance.support(prediction.rows))


@pytest.mark.parametrize("mutation", [without_tightening, without_a_step_of_disturbance])
@pytest.mark.parametrize("name", [*MOST_TRIED, "cart-pole, polytope", "batch reactor, polytope"])
def test_plans_checked_with_less_are_caught_leaving_the_box(name, mutation, monkeypatch):
    monkeypatch.setattr(plan_test, "tightenings", mutation)
    env = extremal_env(name, "overtaking" if name != "cruise" else "blackout")
    with pytest.raises(AssertionError, match=OUTSIDE):
        attack_for_long(env)


@pytest.mark.parametrize("name", ["cruise", "cart-pole", "batch reactor"])
def test_plans_changed_afterwards_are_caught_leaving_the_box(name):
    env = extremal_env(name, "overtaking" if name != "cruise" else "blackout")
    advance = env._monitored.advance

    def changed(*arguments):
        advance(*arguments)
        env._monitored._stored = -env._monitored._stored

    env._monitored.advance = changed
    with pytest.raises(AssertionError, match=OUTSIDE):
        attack_for_long(env)


@pytest.mark.parametrize("name", ["cart-pole", "batch reactor"])
def test_broken_contract_ends_the_guarantee_before_the_box_is_left(name):
    plant, horizon, channel, contract = case(name, "overtaking")
    silent, adversary = Channel(loss=1.0), WeakestPoint()
    inner = NCSEnv(plant, silent, disturbance=adversary, contract=contract, initial_set=box_ellipsoid(plant, 0.7))
    env = adversary.shield = SafetyShield(inner, certificate_of(plant, contract), "lookahead", horizon=horizon)
    assert contract.is_kept_by(channel)
    outside, reasons = 0, set()
    for seed in range(4):
        env.reset(seed=seed)
        for _ in range(80):
            *_, info = env.step(env.action_space.sample())
            assert not (info["cost"] and info["shield_guaranteed"])
            outside += info["cost"]
            reasons.add(info["shield_reason"])
    assert outside > 0
    assert OLD_SAMPLE in reasons


def test_start_outside_the_safe_set_is_guaranteed_exactly_if_a_first_plan_is_certified():
    name = "batch reactor"
    env = extremal_env(name, "constant delay", 0.9)
    plant, safe = env.filter.plant, env.certificate.safe_set
    rng, seen = np.random.default_rng(0), set()
    inner = SafetyShield(NCSEnv(plant, Channel(delay=3), contract=case(name, "constant delay")[3]), env.certificate,
                         "lookahead", horizon=6)  # fmt: skip
    for seed in range(60):
        start = rng.uniform(-1.0, 1.0, plant.n) * plant.half_widths * rng.choice([0.3, 0.9, 1.05])
        _, info = inner.reset(seed=seed, options={"state": start})
        outside = not safe.contains(start)
        if (np.abs(plant.box_rows @ start) > 1.0).any():
            assert not info["shield_guaranteed"]
            assert info["shield_reason"] == NOT_KNOWN_INSIDE
        elif outside:
            assert info["shield_guaranteed"] == (info["shield_plan_length"] > 0)
        else:
            assert info["shield_guaranteed"]
            assert info["shield_plan_length"] == 0
        seen.add((outside, info["shield_guaranteed"]))
        for _ in range(6 if info["shield_guaranteed"] else 0):
            *_, info = inner.step(inner.action_space.sample())
            assert info["shield_guaranteed"]
            assert not info["cost"]
    assert seen == {(False, True), (True, True), (True, False)}


def test_an_input_other_than_the_decided_one_drops_the_stored_plan():
    env = extremal_env("batch reactor", "constant delay", 0.9)
    for seed in range(30):
        _, info = env.reset(seed=seed)
        if info["shield_plan_length"] > 2:
            break
    report = env._monitored.report
    env._monitored.decide(np.zeros(2))
    env._monitored.advance(np.full(2, 0.123), True, report)
    assert env._monitored.plan_length == 0
    assert env._monitored.reason == OTHER_INPUT


def test_reset_clears_what_was_stored():
    env = extremal_env("cruise", "bursts")
    env.reset(seed=0)
    lengths = set()
    for _ in range(60):
        *_, info = env.step(np.ones(1, np.float32))
        lengths.add(info["shield_plan_length"])
    assert max(lengths) > 0
    _, info = env.reset(seed=1, options={"state": np.zeros(2)})
    assert info["shield_plan_length"] == env._monitored.plan_length == 0


def test_loop_without_gymnasium_keeps_the_plan_between_steps():
    plant = cart_pole()
    channel = Channel(loss=0.4, max_consecutive_losses=1, jitter=2)
    contract = contract_of(channel)
    loop = SafeLoop(certificate_of(plant, contract), plant, channel, "lookahead", horizon=12)
    rng, found = np.random.default_rng(0), []
    while len(found) < 200 and not (loop.guaranteed and loop.plan_length > 1):
        found.append(plant.half_widths * rng.uniform(-0.9, 0.9, 4))
        loop.start(found[-1])
    assert not loop.filter.knows_inside(found[-1], loop.error_shape)
    assert loop.guaranteed
    first = loop.plan_length
    loop.receive()
    decision = loop.decide(None)  # a controller that failed: the stored plan goes on
    assert decision.reason == "stored"
    assert loop.plan_length == first - 1
    loop.receive()
    assert loop.guaranteed


@pytest.mark.parametrize("env_id", ["TruckTrailerCruise-v0", "CartPole-v0", "BatchReactor-v0"])
def test_registered_environments_stay_in_their_boxes(env_id):
    env = SafetyShield(gym.make(f"ncs_gym/{env_id}", disturbance="adversarial"), mode="lookahead")
    rng, planned = np.random.default_rng(0), 0
    for seed in range(3):
        env.reset(seed=seed)
        ended = False
        while not ended:
            *_, terminated, truncated, info = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
            ended = terminated or truncated
            planned += info["shield_plan_length"] > 0
            assert info["shield_guaranteed"]
        assert info["episode_violations"] == 0.0
    assert planned > 0
