import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from ncs_gym import Ellipsoid, SpeedTracking, truck_trailer
from ncs_gym.disturbances import BallDisturbance
from tests.product import library_plant, vector_env


def make(name, count, **settings):
    return gym.make_vec(f"ncs_gym/{name}-v0", num_envs=count, **settings)


def test_interface_is_gymnasiums():
    env = make("TruckTrailerCruise", 5)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert env.observation_space == gym.vector.utils.batch_space(env.single_observation_space, 5)
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    action = env.action_space.sample()
    observation, reward, terminated, truncated, stepped = env.step(action)
    assert observation in env.observation_space
    assert set(info) == set(stepped)
    assert all(value.shape[0] == 5 for value in stepped.values())
    assert [array.shape for array in (reward, terminated, truncated)] == [(5,)] * 3
    assert [array.dtype for array in (reward, terminated, truncated)] == [np.float64, np.bool_, np.bool_]
    single = gym.make("ncs_gym/TruckTrailerCruise-v0")
    assert env.single_observation_space == single.observation_space
    assert set(info) == set(single.reset(seed=0)[1])


def test_seeds_determine_everything_and_block_sizes_do_not_matter_to_one_seed():
    runs = []
    for seed in (7, 7, 8, [1, 2, 3, 4], [1, 2, 3, 5]):
        env = make("CartPole", 4)
        rng = np.random.default_rng(0)
        states = [env.reset(seed=seed)[1]["state"]]
        states += [env.step(rng.uniform(-1, 1, (4, 1)).astype(np.float32))[4]["state"] for _ in range(60)]
        runs.append(np.array(states))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not any(np.array_equal(runs[0], run) for run in runs[2:])
    assert not np.array_equal(runs[3], runs[4])


def test_next_step_autoreset_ignores_the_action_and_starts_anew():
    env = make("TruckTrailerCruise", 3, max_episode_steps=5)
    env.reset(seed=0)
    for step in range(1, 20):
        _, reward, terminated, truncated, info = env.step(np.ones((3, 1), np.float32))
        assert not terminated.any()
        assert truncated.all() == (step % 6 == 5)
        if step % 6 == 0:
            assert not reward.any()
            assert not info["input"].any()
            assert not info["measurement_age"].any()
            assert (info["episode_violations"] == info["cost"]).all()
            np.testing.assert_allclose(info["error_shape"][0], env.unwrapped.plant.initial_error.shape_matrix)
        assert (env.unwrapped.steps == step % 6).all()
    np.testing.assert_array_equal(env.unwrapped.episodes, 4)


def test_same_step_autoreset_hands_over_the_last_observation():
    one, other = (make("CartPole", 20, autoreset_mode=mode) for mode in ("SameStep", "Disabled"))
    assert one.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    one.reset(seed=0)
    other.reset(seed=0)
    for _ in range(400):
        result, plain = (env.step(np.ones((20, 1), np.float32)) for env in (one, other))
        done = plain[2] | plain[3]
        if done.any():
            break
    info, last = result[4], plain[4]
    np.testing.assert_array_equal(info["_final_obs"], done)
    np.testing.assert_array_equal(info["final_obs"][done], plain[0][done])
    np.testing.assert_array_equal(result[0][~done], plain[0][~done])
    assert not np.array_equal(result[0][done], plain[0][done])
    for key, value in last.items():
        np.testing.assert_array_equal(info["final_info"][key][done], value[done])
        np.testing.assert_array_equal(info["final_info"][f"_{key}"], done)
        np.testing.assert_array_equal(info[key][~done], value[~done])
    assert not info["measurement_age"][done].any()
    np.testing.assert_array_equal(result[2], plain[2])


def test_disabled_autoreset_wants_the_finished_environments_reset():
    env = make("TruckTrailer", 3, max_episode_steps=2, autoreset_mode="Disabled")
    env.reset(seed=0)
    env.step(np.zeros((3, 1), np.float32))
    mask = np.array([True, False, False])
    _, info = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(env.unwrapped.steps, [0, 1, 1])
    *_, truncated, _ = env.step(np.zeros((3, 1), np.float32))
    np.testing.assert_array_equal(truncated, ~mask)
    with pytest.raises(gym.error.ResetNeeded, match="reset_mask"):
        env.step(np.zeros((3, 1), np.float32))
    before = info["state"][0]
    _, info = env.reset(options={"reset_mask": ~mask, "state": np.full((3, 2), 0.5)})
    np.testing.assert_array_equal(info["state"][~mask], 0.5)
    assert not np.array_equal(info["state"][0], before)
    env.step(np.zeros((3, 1), np.float32))


def test_what_a_users_subclass_changes_counts():
    class Fixed(SpeedTracking):
        def reward(self, plant, task_state, state, u):
            return 42.0 + task_state[0]

    class Quiet(BallDisturbance):
        def draw(self, rng, plant, nominal_next, step, memory):
            return np.full(plant.n, 1e-3)

    plant = library_plant(truck_trailer, process_noise_cov=np.zeros((2, 2)))
    env = vector_env(4, plant=plant, task=Fixed(), disturbance=Quiet(), max_episode_steps=3)
    _, info = env.reset(seed=0)
    for step in range(1, 10):
        before = info["state"]
        _, reward, _, _, info = env.step(np.zeros((4, 1), np.float32))
        if step % 4:
            assert (reward >= 42.0).all()
            np.testing.assert_allclose(info["state"], before @ plant.A.T + 1e-3)


def test_an_episode_that_begins_outside_the_box_does_not_end_before_its_first_step():
    far = Ellipsoid(25.0 * np.eye(2))
    settings = {"plant": truck_trailer(), "initial_set": far, "terminate_on_violation": True, "max_episode_steps": 1}
    env, ended = vector_env(40, **settings), []
    env.reset(seed=0)
    for _ in range(6):
        _, _, terminated, truncated, info = env.step(np.zeros((40, 1), np.float32))
        ended.append(terminated.any() | truncated.any())
        assert info["cost"].any()
    assert ended == [True, False] * 3
