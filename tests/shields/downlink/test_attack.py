"""Attacks on both directions at once: every bound attained, both channels at the edge of their contracts."""

import numpy as np
import pytest

from shields import VectorSafetyShield
from tests.shields.attacks.test_vector_attack import ExtremalVectorNoise
from tests.shields.backup_plans.adversary import box_ellipsoid
from tests.shields.downlink.adversary import PLANTS, POLICIES, Case, attack, edges

# 3 downlinks by 3 policies per plant: 9 * 1,112 * 100 = 1.0e6 steps each.
SLOW_ENVS, SLOW_STEPS = 1112, 100
UPLINKS = {"late": "overtaking", "runs": "runs", "overtaking": "late"}


def case(name, downlink, input_delay=2):
    """A plant whose uplink is at its edge, too."""
    return Case(PLANTS[name], edges(2)[UPLINKS[downlink]], edges(input_delay)[downlink])


def assert_safe(name, downlink, count, steps):
    outcomes = [
        attack(case(name, downlink), mode, policy, count, steps, seed)
        for seed, (policy, mode) in enumerate(POLICIES.items())
    ]
    assert all(each.exits == 0 and each.level <= 1.0 and each.error <= 1.0 + 1e-9 for each in outcomes), outcomes
    assert max(each.overridden for each in outcomes) > 0.0
    assert min(each.overridden for each in outcomes) < 1.0
    assert sum(each.steps for each in outcomes) == 3 * count * steps


@pytest.mark.parametrize("downlink", UPLINKS)
@pytest.mark.parametrize("name", ["cruise", "cart-pole"])
def test_no_environment_leaves_its_safe_set(name, downlink):
    assert_safe(name, downlink, 30, 60)


@pytest.mark.slow
@pytest.mark.parametrize("downlink", UPLINKS)
@pytest.mark.parametrize("name", PLANTS)
def test_no_environment_leaves_its_safe_set_in_a_million_steps_per_plant(name, downlink):
    assert_safe(name, downlink, SLOW_ENVS, SLOW_STEPS)


@pytest.mark.parametrize("name", ["cruise", "cart-pole"])
def test_a_shield_that_ignores_the_downlink_fails_under_the_same_attack(name):
    known, ignored = (
        attack(case(name, "runs"), "project", "outwards", 30, 100, 0, aware=aware) for aware in (True, False)
    )
    assert known.exits == 0
    assert known.level > 0.9  # it comes close
    assert known.error > 0.5
    assert ignored.exits > 0.05 * ignored.steps, ignored


def test_runs_of_losses_are_exactly_as_long_as_promised():
    env = case("cruise", "runs", input_delay=3).env(5, "random")
    assert env.downlink_protocol.input_delay == 3
    env.reset(seed=0)
    newest = []
    for _ in range(40):
        *_, info = env.step(np.ones((5, 1)))
        assert not info["downlink_broken"].any()
        newest.append(env.steps - 1 - env._downlink_state._newest)
    assert np.max(newest[4:]) == 3  # with one loss more nothing in the buffer would be for now
    assert set(np.ravel(newest[4:])) == {0, 1, 2, 3}


@pytest.mark.parametrize(
    ("count", "steps"), [(10, 40), pytest.param(1000, 1000, marks=pytest.mark.slow)], ids=["some", "many"]
)
@pytest.mark.parametrize(("name", "horizon"), [("cruise", 3), ("cart-pole", 12), ("batch reactor", 6)])
def test_lookahead_keeps_guaranteed_states_in_the_box(name, horizon, count, steps):
    attacked = case(name, "runs")
    env = ExtremalVectorNoise(
        count,
        plant=attacked.plant,
        channel=attacked.uplink,
        contract=attacked.contract,
        downlink=attacked.downlink,
        disturbance="adversarial",  # pushes the row with the least room
        initial_set=box_ellipsoid(attacked.plant, 0.6),
        max_episode_steps=37,
    )
    shield = VectorSafetyShield(env, attacked.certificate, "lookahead", horizon=horizon)
    rng = np.random.default_rng(0)
    _, info = shield.reset(seed=0)
    held, episodes, guaranteed, outside, planned = info["shield_guaranteed"], env.episodes.copy(), 0.0, 0, 0
    for _ in range(steps):
        push = np.sign(info["estimate"] @ env.plant.A.T @ env.plant.weight @ env.plant.B)
        actions = np.where(rng.random((count, 1)) < 0.5, push, rng.uniform(-1, 1, (count, env.plant.m)))
        *_, info = shield.step(actions)
        went_on, episodes = env.episodes == episodes, env.episodes.copy()
        assert not (held & went_on & ~info["shield_guaranteed"]).any(), set(info["shield_reason"])
        held = info["shield_guaranteed"]
        assert (info["constraint_values"][held] <= 0.0).all()
        guaranteed += held.mean() / steps
        planned += np.count_nonzero(info["shield_plan_length"])
        outside += np.count_nonzero(held & (attacked.certificate.safe_set.gauge(info["state"]) > 1.0))
    assert guaranteed > 0.3
    assert planned > 0
    assert outside > 0
