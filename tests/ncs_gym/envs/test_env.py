import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import ncs_gym
from ncs_gym import Channel, Ellipsoid, GilbertElliott
from tests.plants import random_plant

IDS = ["ncs_gym/TruckTrailer-v0", "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/LinearNCS-v0"]


def make(env_id: str, **kwargs) -> gym.Env:
    if env_id == "ncs_gym/LinearNCS-v0":
        kwargs.setdefault("plant", random_plant(0, 3, 2, 2))
    return gym.make(env_id, **kwargs)


@pytest.mark.parametrize("env_id", IDS)
def test_gymnasium_and_sb3_checkers_pass_without_a_warning(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(env_id).unwrapped)
        check_env_sb3(make(env_id).unwrapped)


def test_environments_of_an_id_share_its_plant_which_is_made_once():
    alone, many = gym.make("ncs_gym/CartPole-v0"), gym.make_vec("ncs_gym/CartPole-v0", num_envs=2)
    assert alone.unwrapped.plant is many.unwrapped.plant is gym.make("ncs_gym/CartPoleTwoWay-v0").unwrapped.plant


@pytest.mark.cases(2)
@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("noise", ["truncated", "gaussian"])
def test_same_seed_gives_the_same_trajectory_info_included(env_id, noise):
    channel = Channel(loss=GilbertElliott(p_good_to_bad=0.2, p_bad_to_good=0.4), quantization_step=0.05, jitter=2)

    def run(seed):
        env = make(env_id, channel=channel, noise=noise)
        env.action_space.seed(0)
        observation, info = env.reset(seed=seed)
        rows = [observation, *(np.ravel(value) for value in info.values())]
        for _ in range(40):
            observation, reward, _, _, info = env.step(env.action_space.sample())
            rows += [observation, [reward], *(np.ravel(value) for value in info.values())]
        return np.concatenate(rows)

    np.testing.assert_array_equal(run(5), run(5))
    assert (run(5) != run(6)).any()


def test_reset_without_a_seed_goes_on_with_new_draws():
    env = make(IDS[0])
    env.reset(seed=0)
    first, second = env.reset()[1]["state"], env.reset()[1]["state"]
    assert (first != second).any()


def test_step_follows_the_plant_within_its_disturbance_bound():
    env = make(IDS[0], disturbance="sphere")
    plant = env.unwrapped.plant
    _, info = env.reset(seed=0)
    for _ in range(100):
        action = env.action_space.sample()
        *_, after = env.step(action)
        u = 4.0 * action.astype(np.float64)
        np.testing.assert_array_equal(after["input"], u)
        d = after["state"] - plant.A @ info["state"] - plant.B @ u
        assert plant.disturbance.gauge(d) == pytest.approx(1.0, abs=1e-6)
        info = after


def test_actions_are_clipped_and_taken_in_float64():
    env = make(IDS[0])
    env.reset(seed=0)
    assert env.step(np.array([7.0], np.float32))[4]["input"] == pytest.approx([4.0])
    assert env.step(np.array([0.1]))[4]["input"][0] == 4.0 * 0.1


def test_starts_fill_the_disc_of_radius_1_9():
    env = make(IDS[0])
    radii = np.array([np.linalg.norm(env.reset(seed=i)[1]["state"]) for i in range(400)])
    assert radii.max() <= 1.9
    assert np.mean(radii <= 0.95) == pytest.approx(0.25, abs=0.07)


def test_cost_counts_violations_of_the_true_state():
    env = make(IDS[0], initial_set=Ellipsoid(np.zeros((2, 2))))
    _, info = env.reset(options={"state": [2.5, 0.0]})
    assert (info["cost"], info["episode_violations"], info["is_success"]) == (1.0, 1.0, 0.0)
    np.testing.assert_allclose(info["constraint_values"], [0.25, -1.0])
    total = 1.0
    for _ in range(5):
        *_, info = env.step(np.ones(1, np.float32))
        total += info["cost"]
        assert info["cost"] == float(np.abs(info["state"]).max() > 2.0)
    assert info["episode_violations"] == total


def test_violation_terminates_only_if_asked_to():
    for asked in (False, True):
        env = make(IDS[1], terminate_on_violation=asked)
        env.reset(seed=0)
        ended = False
        for _ in range(6):
            if not ended:
                ended = env.step(np.ones(1, np.float32))[2]
        assert ended is asked


def test_a_variant_of_the_truck_keeps_the_case_studys_disturbance_and_starts():
    env = make(IDS[0], plant=ncs_gym.truck_trailer(mass=1500.0)).unwrapped
    assert env.disturbance is ncs_gym.registration.CASE_STUDY_BOX
    assert env.initial_set.shape_matrix[0, 0] == pytest.approx(1.9**2)
