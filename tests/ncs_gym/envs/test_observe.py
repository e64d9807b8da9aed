"""Observations may hold the age of information and the radii of the error."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from shields import SafetyShield
from tests.certificates import certificate_of
from tests.ncs_gym.envs.same_draws import compare

CRUISE = "ncs_gym/TruckTrailerCruise-v0"


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


def test_only_what_is_asked_for_is_observed_in_its_order():
    error_first = gym.make(CRUISE, observe=["error", "age"]).reset(seed=0)[0]
    age_first = gym.make(CRUISE, observe=("age", "error")).reset(seed=0)[0]
    np.testing.assert_array_equal(error_first[[0, 1, 2, 5, 3, 4]], age_first)
    assert gym.make(CRUISE, observe=["age"]).observation_space.shape == (4,)


def test_vector_observes_the_same():
    compare(gym.make_vec(CRUISE, num_envs=3, observe=("age", "error"), max_episode_steps=31).unwrapped, 70)


def test_spec_with_a_certificate_and_observations_is_json(tmp_path):
    env = gym.make(CRUISE, observe=("age",))
    certificate = certificate_of(env.unwrapped.plant)
    certificate.save(tmp_path / "certificate.json")
    for given in (certificate, certificate.document, tmp_path / "certificate.json", str(tmp_path / "certificate.json")):
        shield = SafetyShield(env, given)
        again = gym.make(gym.envs.registration.EnvSpec.from_json(shield.spec.to_json()))
        assert shield.certificate.checksum == again.certificate.checksum == certificate.checksum
        np.testing.assert_array_equal(shield.reset(seed=1)[0], again.reset(seed=1)[0])
    altered = certificate.document | {"certificate": certificate.document["certificate"] | {"kappa": 0.5}}
    with pytest.raises(ValueError, match="certificate document was altered"):
        SafetyShield(env, altered)
    with pytest.raises(ValueError, match="certificate must be a Certificate, its document or path"):
        SafetyShield(env, 3)
