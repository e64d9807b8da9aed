"""Random plants, channels, tasks and disturbances: environments run, and everything they report is finite."""

import warnings

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st

from ncs_gym import Channel, ChannelContract, ErrorSetError
from tests.fuzz import environment_settings, examples, plants
from tests.product import linear_plant, loop_env, vector_env

# A plant so strongly coupled that float64 holds no error set is refused by name.
REFUSED = (ErrorSetError,)


def assert_reported(env, observation, reward, info):
    assert observation.dtype == np.float32
    assert env.observation_space.contains(observation)
    assert np.isfinite(observation).all()
    assert np.isfinite(reward).all()
    for key, value in info.items():
        assert np.isfinite(np.asarray(value, dtype=np.float64)).all(), key


def made(kind, *arguments, **settings):
    """The environment; None if the plant is refused."""
    try:
        return kind(*arguments, **settings)
    except REFUSED:
        return None


def run_scalar(settings, seed, steps):
    env = made(loop_env, **settings)
    if env is None:
        return
    observation, info = env.reset(seed=seed)
    keys = set(info)
    actions = np.random.default_rng(seed)
    for _ in range(steps):
        action = actions.uniform(-1.5, 1.5, env.plant.m).astype(np.float32)
        observation, reward, terminated, _, info = env.step(action)
        assert_reported(env, observation, reward, info)
        assert set(info) == keys
        assert not info["assumption_violated"]
        error = info["estimation_error"]
        assert error @ np.linalg.pinv(info["error_shape"], rcond=0.0) @ error <= 1.0 + 1e-6 or not_square(error, info)
        if terminated:
            env.reset()


def not_square(error, info):
    """Whether the support function, which needs no inverse, agrees that the error lies in its ellipsoid."""
    shape = info["error_shape"]
    scale = np.sqrt(np.diag(shape))
    return np.linalg.eigvalsh(shape / np.outer(scale, scale) - np.outer(error / scale, error / scale))[0] > -1e-9


def run_vector(settings, seed, steps, mode):
    env = made(vector_env, 3, max_episode_steps=7, autoreset_mode=mode, **settings)
    if env is None:
        return
    observation, info = env.reset(seed=seed)
    actions = np.random.default_rng(seed)
    for _ in range(steps):
        batch = actions.uniform(-1.5, 1.5, (3, env.plant.m)).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(batch)
        flat = {key: value for key, value in info.items() if not key.lstrip("_").startswith("final")}
        assert_reported(env, observation, reward, flat)
        assert not info["assumption_violated"].any()
        assert (terminated | truncated).any() or mode == "SameStep" or "final_info" not in info


@given(settings=environment_settings(), seed=st.integers(0, 1000))
@examples(6)
def test_random_environments_run(settings, seed):
    run_scalar(settings, seed, 25)


@given(settings=environment_settings(), seed=st.integers(0, 1000), mode=st.sampled_from(["NextStep", "SameStep"]))
@examples(4)
def test_random_vector_environments_run(settings, seed, mode):
    run_vector(settings, seed, 16, mode)


@given(settings=environment_settings(most_states=3, units=3.0), seed=st.integers(0, 1000))
@examples(3)
def test_random_environments_pass_the_checks_of_gymnasium(settings, seed):
    env = made(loop_env, **settings)
    if env is not None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(env, skip_render_check=True)


@pytest.mark.slow
@given(settings=environment_settings(), seed=st.integers(0, 10**6), mode=st.sampled_from(["NextStep", "SameStep"]))
@examples(1500, same=False)
def test_many_random_environments_run(settings, seed, mode):
    run_scalar(settings, seed, 100)
    run_vector(settings, seed, 60, mode)


@given(plant=plants(most_states=4, radius=(1.0, 1.5), units=3.0), age=st.integers(0, 3), seed=st.integers(0, 1000))
@examples(3)
def test_unstable_plants_are_refused_or_stay_finite_when_their_contract_is_broken(plant, age, seed):
    contract = ChannelContract(age, quantization_step=0.05)
    settings = {"plant": plant, "channel": Channel(1.0), "contract": contract}
    env, many = made(loop_env, **settings), made(vector_env, 2, **settings)
    assert (env is None) == (many is None)
    if env is not None:
        run_away(env, seed, 100)
        run_away(many, seed, 100)


def run_away(env, seed, steps):
    env.reset(seed=seed)
    action = np.ones(env.action_space.shape, np.float32)
    for step in range(steps):
        observation, reward, _, _, info = env.step(action)
        if step % 97 == 0 or step > steps - 3:
            assert_reported(env, observation, reward, info)
            error, shape = np.atleast_2d(info["estimation_error"]), np.atleast_3d(info["error_shape"].T).T
            assert (np.abs(error) <= np.sqrt(np.diagonal(shape, axis1=1, axis2=2)) * (1.0 + 1e-9)).all()


@pytest.mark.parametrize("many", [False, True])
def test_an_unstable_plant_left_alone_stays_finite_for_ever(many):
    # What doubles at every step is larger than the largest float after 1,100 of them.
    plant = linear_plant(A=[[2.0]], B=[[1.0]], box=[1.0], u_max=3.0, dt=0.1, gamma=1e-6, sensor_bound=1e-3,
                        initial_bound=1e-3)  # fmt: skip
    settings = {"plant": plant, "channel": Channel(1.0), "contract": ChannelContract(1)}
    env = vector_env(2, **settings) if many else loop_env(**settings)
    run_away(env, 0, 1120)
