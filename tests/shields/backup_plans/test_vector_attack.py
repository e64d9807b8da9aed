"""Many environments at once under mode "lookahead", with every bound attained: none leaves its box while guaranteed."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from shields import VectorSafetyShield
from tests.certificates import certificate_of
from tests.shields.attacks.test_vector_attack import ExtremalVectorNoise
from tests.shields.backup_plans.adversary import box_ellipsoid, case

CASES = [
    ("cruise", "bursts"),
    ("cruise", "blackout"),
    ("n=4 m=1", "overtaking"),
    ("n=6 m=2", "blackout"),
    ("cart-pole", "overtaking"),
    ("cart-pole, position and angle", "longest gap each time"),
    ("batch reactor", "constant delay"),
]


def attack(name, channel, count, steps, seed, autoreset):
    """Shares of steps that were guaranteed and lived from a plan; fails if a guaranteed state is outside the box."""
    plant, horizon, network, contract = case(name, channel)
    env = ExtremalVectorNoise(
        count,
        plant=plant,
        channel=network,
        contract=contract,
        disturbance="adversarial",  # pushes the row with the least room
        initial_set=box_ellipsoid(plant, 0.95),
        max_episode_steps=17,  # resets in mid-plan
        autoreset_mode=autoreset,
    )
    shield = VectorSafetyShield(env, certificate_of(plant, contract), "lookahead", horizon=horizon)
    rng = np.random.default_rng(seed)
    _, info = shield.reset(seed=seed)
    guaranteed = planned = outside = 0.0
    held, episodes = info["shield_guaranteed"], env.episodes.copy()
    for step in range(steps):
        push = np.sign(info["estimate"] @ plant.A.T @ plant.weight @ plant.B)
        actions = np.where(rng.random((count, 1)) < 0.5, push, rng.uniform(-1, 1, (count, plant.m)))
        if step == steps // 2:  # some are reset by hand
            shield.reset(options={"reset_mask": np.arange(count) % 3 == 0})
            held = shield._monitor.reasons(shield._state) == 0
            episodes = env.episodes.copy()
        *_, info = shield.step(actions)
        went_on = env.episodes == episodes
        episodes = env.episodes.copy()
        assert not (held & went_on & ~info["shield_guaranteed"]).any(), set(info["shield_reason"])
        held = info["shield_guaranteed"]
        assert (info["constraint_values"][held] <= 0.0).all()
        levels = certificate_of(plant, contract).safe_set.gauge(info["state"])
        guaranteed, planned = guaranteed + held.mean(), planned + (info["shield_plan_length"] > 0).mean()
        outside += (held & (levels > 1.0)).mean()
    return guaranteed / steps, planned / steps, outside / steps


@pytest.mark.parametrize(
    ("count", "steps"), [(12, 50), pytest.param(256, 400, marks=pytest.mark.slow)], ids=["some", "many"]
)
@pytest.mark.parametrize("autoreset", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP], ids=["next", "same"])
@pytest.mark.parametrize(("name", "channel"), CASES)
def test_no_environment_leaves_its_box_while_guaranteed(name, channel, autoreset, count, steps):
    guaranteed, planned, outside = attack(name, channel, count, steps, 0, autoreset)
    assert guaranteed > 0.3
    assert planned > 0.0
    assert outside > 0.0


def test_final_info_says_what_the_last_decision_stored():
    env = gym.make_vec("ncs_gym/BatchReactor-v0", num_envs=8, max_episode_steps=5, autoreset_mode="SameStep")
    certificate = certificate_of(env.unwrapped.plant, env.unwrapped.certificate_contract, safe_set="ellipsoid")
    shield, lengths = VectorSafetyShield(env, certificate, mode="lookahead"), []
    shield.reset(seed=0)
    for step in range(40):
        *_, truncated, info = shield.step(np.ones((8, 2), np.float32))
        assert info["shield_plan_length"].dtype == np.int64
        if truncated.any():
            assert step % 5 == 4
            lengths += info["final_info"]["shield_plan_length"].tolist()
            assert (info["shield_plan_length"] == 0).all()  # starts are in S
            assert info["final_info"]["_shield_plan_length"].all()
    assert max(lengths) > 0
