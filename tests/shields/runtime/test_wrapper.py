import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from shields import SafetyShield
from shields.runtime.guard import (
    NOT_KNOWN_INSIDE,
)
from tests.product import safety_shield

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
KEYS = {
    "shield_intervened": bool,
    "input_proposed": np.ndarray,
    "shield_correction": float,
    "shield_margin": float,
    "shield_guaranteed": bool,
    "shield_reason": str,
    "episode_interventions": int,
    "episode_guaranteed": float,
}


def shielded(certificate, mode="project", penalty=0.0, **kwargs) -> SafetyShield:
    return safety_shield(gym.make(CRUISE, **kwargs), certificate, mode=mode, penalty=penalty)


def play(env, policy, steps=200, **reset):
    """All infos of one episode, the reset's first."""
    infos = [env.reset(**reset)[1]]
    for _ in range(steps):
        *_, truncated, info = env.step(policy(infos[-1]))
        infos.append(info)
        if truncated:
            break
    return infos


def full(info):
    return np.ones(1, np.float32)


def test_checkers_pass_on_the_shielded_environment(certificate):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*is different from the unwrapped version.*")
        check_env(safety_shield(gym.make(CRUISE).unwrapped, certificate))
        check_env_sb3(safety_shield(gym.make(CRUISE).unwrapped, certificate))


def test_info_gains_the_same_keys_and_types_always(certificate):
    plain = gym.make(CRUISE).reset(seed=0)[1]
    for info in play(shielded(certificate), full, seed=0):
        assert set(info) == set(plain) | set(KEYS)
        assert {key: type(info[key]) for key in KEYS} == KEYS
        assert info["shield_correction"] == pytest.approx(np.linalg.norm(info["input"] - info["input_proposed"]))
        assert info["shield_guaranteed"] is (info["shield_reason"] == "")


def test_idle_shield_is_the_identity_bit_for_bit(certificate):
    actions = np.random.default_rng(0).uniform(-0.05, 0.05, (200, 1)).astype(np.float32)
    plain, shield = gym.make(CRUISE), shielded(certificate)
    first, second = plain.reset(seed=1), shield.reset(seed=1)
    np.testing.assert_array_equal(first[0], second[0])
    for action in actions:
        one, other = plain.step(action), shield.step(action)
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1:4] == other[1:4]
        for key, value in one[4].items():
            np.testing.assert_array_equal(value, other[4][key])
        assert not other[4]["shield_intervened"]


@pytest.mark.parametrize("mode", ["project", "monitor"])
def test_penalty_is_paid_per_intervention_only(certificate, mode):
    free, paid = shielded(certificate, mode), shielded(certificate, mode, penalty=0.5)
    free.reset(seed=0)
    paid.reset(seed=0)
    for _ in range(30):
        _, reward, *_, info = free.step(full(None))
        _, other, *_ = paid.step(full(None))
        assert other == pytest.approx(reward - 0.5 * info["shield_intervened"])


def test_monitor_is_the_unshielded_environment_bit_for_bit(certificate):
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.2, 1.2, (200, 1))  # float64 and beyond the limits: passed on as they are
    bare, watched = gym.make(CRUISE), shielded(certificate, mode="monitor")
    np.testing.assert_array_equal(bare.reset(seed=3)[0], watched.reset(seed=3)[0])
    counted, doubted = 0, False
    for action in actions:
        expected, (*result, info) = bare.step(action), watched.step(action)
        np.testing.assert_array_equal(expected[0], result[0])
        assert expected[1:4] == tuple(result[1:])
        np.testing.assert_array_equal(info["input"], info["input_proposed"])
        assert info["shield_correction"] == 0.0
        counted += info["shield_intervened"]
        assert info["episode_interventions"] == counted
        doubted |= info["shield_reason"] == NOT_KNOWN_INSIDE
    assert 10 < counted < 150
    assert doubted
