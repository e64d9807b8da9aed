"""What observations hold and are clipped to, and that clipping is never silent where it hides something."""

import warnings
from functools import partial
from itertools import product

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ncs_gym import Channel, ChannelContract, Task, cart_pole
from ncs_gym.envs.spaces import ClippedObservationWarning
from tests.certificates import certificate_of
from tests.product import gym_env, linear_plant, loop_env, safety_shield, vector_env

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
PLANT = linear_plant(A=[[0.5]], B=[[1.0]], box=[[1.0]], u_max=1.0, dt=0.1, gamma=1e-4, sensor_bound=0, initial_bound=0)


class Far(Task):
    """Its entry grows by one per step; its bound is that of the horizon, or less."""

    def __init__(self, share=1.0):
        self.share = share

    def begin(self, rng, plant):
        return 0.0

    def advance(self, rng, plant, task_state, u):
        return task_state + 1.0

    def observe(self, task_state):
        return np.array([task_state])

    def observation_bound(self, plant, horizon):
        return np.array([self.share * horizon])

    def reward(self, plant, task_state, state, u):
        return 0.0


class Boundless(Far):
    observation_bound = Task.observation_bound


class Wrong(Far):
    def observation_bound(self, plant, horizon):
        return np.ones(3)


def play(env, steps):
    env.reset(seed=0)
    zero = np.zeros(env.action_space.shape, np.float32)
    return [env.step(zero)[0] for _ in range(steps)]


@pytest.mark.parametrize("make", [loop_env, lambda **settings: vector_env(2, **settings)])
def test_entries_beyond_their_bound_are_told_of_once(make):
    env = make(plant=PLANT, task=Far(0.1), horizon=100)
    with pytest.warns(ClippedObservationWarning, match="entry 0 of Far is beyond .* of 10.1") as caught:
        play(env, 30)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error", ClippedObservationWarning)
        assert np.ravel(play(env, 30)[-1])[-1] == np.float32(10.1)
        play(make(plant=PLANT, task=Far(), horizon=30), 30)


def test_longer_vector_episodes_have_a_longer_horizon_and_longer_scalar_ones_a_warning():
    env = gym_env(plant=PLANT, task=Far(), max_episode_steps=300)
    with pytest.warns(ClippedObservationWarning, match="give horizon=... if episodes are longer"):
        play(env, 300)
    long = gym_env(plant=PLANT, task=Far(), max_episode_steps=300, horizon=300)
    many = vector_env(2, plant=PLANT, task=Far(), max_episode_steps=300)
    assert many.single_observation_space == long.observation_space
    assert many.horizon == 300
    assert vector_env(2, plant=PLANT, task=Far(), max_episode_steps=20).horizon == 200


def test_task_without_bounds_of_what_it_observes_is_refused_by_name():
    with pytest.raises(ValueError, match="Boundless: observe is defined, observation_bound is not"):
        loop_env(PLANT, task=Boundless())
    with pytest.raises(ValueError, match="Wrong: observe returns 1 entries, observation_bound the bounds of 3"):
        loop_env(PLANT, task=Wrong()).reset()


@pytest.mark.parametrize(
    "name",
    [
        "CartPoleTwoWay",
        "BatchReactor",
    ],
)
def test_boxes_of_unstable_plants_are_of_the_size_of_the_safe_box_and_hold_what_one_step_out_of_it_can_reach(name):
    env = gym.make_vec(f"ncs_gym/{name}-v0", num_envs=32, max_episode_steps=-1).unwrapped
    plant, high = env.plant, env.single_observation_space.high[: env.plant.n]
    assert (high < 100.0 * plant.half_widths).all()
    _, info = env.reset(seed=0)
    ended = 0
    for _ in range(100):  # the environments end with the first violation
        estimates, inside = info["estimate"], info["cost"] == 0.0
        assert (np.abs(estimates[inside]) <= high).all()
        ended += np.count_nonzero(~inside)
        info = env.step(env.action_space.sample())[4]
    assert ended > 10


def test_runaway_states_are_clipped_in_observations_and_not_in_infos():
    env = loop_env(cart_pole(), Channel())
    env.reset(seed=0)
    for _ in range(100):
        observation, *_, info = env.step([1.0])
    assert observation in env.observation_space
    assert (np.abs(info["estimate"]) > env.observation_space.high).any()


@pytest.mark.parametrize("share", [0.0, np.nan])
def test_bounds_that_bound_nothing_are_refused_by_name(share):
    with pytest.raises(ValueError, match="Far: observation_bound must be finite numbers > 0"):
        loop_env(plant=PLANT, task=Far(share))


@pytest.mark.parametrize("env_id", ["ncs_gym/CartPole-v0", "ncs_gym/TruckTrailerCruiseTwoWay-v0"])
def test_age_and_radii_follow_the_tasks_entries(env_id):
    env = gym.make(env_id, observe=("age", "error"))
    plain, n = gym.make(env_id), env.unwrapped.plant.n
    check_env(env.unwrapped, skip_render_check=True)
    observation, info = env.reset(seed=0)
    first = len(plain.reset(seed=0)[0])
    np.testing.assert_array_equal(observation[:first], plain.reset(seed=0)[0])
    assert len(observation) == first + 1 + n
    for _ in range(60):
        radii = np.sqrt(np.diagonal(info["error_shape"]))
        np.testing.assert_allclose(observation[first:], [info["measurement_age"], *radii], rtol=1e-6)
        assert observation in env.observation_space
        observation, _, terminated, _, info = env.step(env.action_space.sample() * 0.1)
        if terminated:
            break


def test_spec_with_a_certificate_and_observations_is_json(tmp_path):
    made = partial(gym.make, CRUISE, observe=("age",))
    certificate = certificate_of(made().unwrapped.plant)
    certificate.save(tmp_path / "certificate.json")
    for given in (certificate, certificate.document, tmp_path / "certificate.json", str(tmp_path / "certificate.json")):
        shield = safety_shield(made(), given)
        again = gym.make(gym.envs.registration.EnvSpec.from_json(shield.spec.to_json()))
        assert shield.certificate.checksum == again.certificate.checksum == certificate.checksum
        np.testing.assert_array_equal(shield.reset(seed=1)[0], again.reset(seed=1)[0])
    altered = certificate.document | {"certificate": certificate.document["certificate"] | {"kappa": 0.5}}
    with pytest.raises(ValueError, match="certificate document was altered"):
        safety_shield(made(), altered)
    with pytest.raises(ValueError, match="certificate must be a Certificate, its document or path"):
        safety_shield(made(), 3)


@pytest.mark.parametrize(
    ("growth", "limits"),
    [
        (1.0, {"state_limits": ([-0.5, -1.0], [9.0, 2.0]), "input_limits": (-2.0, 1.0)}),
        (1.0, {"box": [[0.5, 0.5], [0.5, -0.5]], "u_max": 2.0}),
        (0.9, {"box": [5.0, 4.0], "u_max": 0.01}),
    ],
    ids=["two ends", "sums", "stable and hardly moved by its input"],
)
def test_estimates_in_the_safe_box_and_one_step_out_of_it_are_observed_as_they_are(growth, limits):
    quiet = {"disturbance_bound": 0.01, "sensor_bound": 0.0, "initial_bound": 0.0}
    plant = linear_plant(A=[[growth * 1.02, 0.1], [0.0, growth * 1.01]], B=[[0.5], [0.2]], dt=1.0, **limits, **quiet)
    env = loop_env(plant=plant, channel=Channel(), contract=ChannelContract(0))
    for ends in product(*plant.box_ends.T):
        corner = np.linalg.solve(plant.box, ends)
        observation, _ = env.reset(seed=0, options={"state": corner})
        np.testing.assert_allclose(observation, corner, rtol=1e-6, atol=1e-6)
        for action in (-1.0, 1.0):
            env.reset(seed=0, options={"state": corner})
            observation, *_, info = env.step(np.array([action], np.float32))
            np.testing.assert_allclose(observation, info["estimate"], rtol=1e-6, atol=1e-6)
