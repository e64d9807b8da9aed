"""What agents of the benchmark see besides the estimate, and a shield that knows no age."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from benchmarks.suite_observations import OneErrorSet, Remembered, Shown
from experiments.baselines.observer import DisturbanceObserver
from experiments.baselines.tuned import tuned_weights
from ncs_gym.envs.env import ncs_env
from shields import certificate_for
from tests.product import safety_filter

CASE = "ncs_gym/CSTR-v0"
STEPS, COUNT = 12, 3


def played(envs, masks=()):
    """Observations, infos and actions of some steps, with the resets of a mask after steps that `masks` names."""
    observations, infos = envs.reset(seed=3)
    told, rng = [(observations, infos, None)], np.random.default_rng(4)
    for step in range(STEPS):
        actions = rng.uniform(-0.1, 0.1, (COUNT, 1)).astype(np.float32)
        observations, _, _, _, infos = envs.step(actions)
        told.append((observations, infos, actions))
        if step in masks:
            mask = np.arange(COUNT) == masks[step]
            observations, infos = envs.reset(options={"reset_mask": mask})
            told.append((observations, infos, mask))
    return told


def made():
    return gym.make_vec(CASE, num_envs=COUNT, autoreset_mode=AutoresetMode.DISABLED)


@pytest.mark.parametrize("observed", [Shown(CASE), Remembered(3)])
def test_observations_come_first_and_have_the_space_that_is_said(observed):
    bare, more = played(made()), played(envs := observed(made()))
    width = bare[0][0].shape[1]
    for (own, _, _), (seen, _, _) in zip(bare, more, strict=True):
        assert np.array_equal(seen[:, :width], own)
        assert envs.observation_space.contains(seen)


def test_the_disturbance_is_the_observers_in_parts_of_its_largest_value():
    single = ncs_env(gym.make(CASE))
    observer = DisturbanceObserver(single, tuned_weights(CASE, "lqr:observer").disturbance)
    for observations, infos, _ in played(Shown(CASE)(made())):
        expected = observer.see(infos)[1] / observer.largest
        np.testing.assert_allclose(observations[:, -single.plant.n :], expected, atol=1e-6)
    assert np.abs(expected).max() > 0.01


def test_memory_is_what_was_seen_and_applied_before():
    n, told = ncs_env(gym.make(CASE)).plant.n, played(Remembered(3)(made()))
    estimates = [told[0][0][:, :n]] * 3 + [each[:, :n] for each, _, _ in told[:-1]]
    actions = [np.zeros((COUNT, 1))] * 3 + [each for _, _, each in told[1:]]
    for step, (observations, _, _) in enumerate(told[1:], 1):
        past = [np.hstack([estimates[step + k], actions[step + k]]) for k in range(3)]
        np.testing.assert_allclose(observations[:, -3 * (n + 1) :], np.hstack(past), atol=1e-6)


@pytest.mark.parametrize("observed", [Shown(CASE), Remembered(3)])
def test_a_loop_that_begins_again_forgets_and_the_others_do_not_move(observed):
    told, n = played(envs := observed(made()), {6: 1}), ncs_env(gym.make(CASE)).plant.n
    before, after = told[7][0], told[8][0]
    assert np.array_equal(after[[0, 2]], before[[0, 2]])
    width = envs.env.single_observation_space.shape[0]
    first = np.append(after[1, :n], 0.0) if isinstance(observed, Remembered) else np.zeros(n)
    assert np.array_equal(after[1, width:], np.tile(first, (len(after[1]) - width) // len(first)).astype(np.float32))
    assert not np.array_equal(after[1, width:], before[1, width:])


def test_a_shield_with_one_error_set_lets_pass_what_is_safe_at_every_age():
    convoy = ncs_env(gym.make("ncs_gym/Convoy-v0"))  # of whose error sets none holds the others
    certificate = certificate_for(convoy.plant, convoy.certificate_contract)
    shield = OneErrorSet(certificate)(gym.make_vec("ncs_gym/Convoy-v0", num_envs=2))
    rng, own = np.random.default_rng(0), safety_filter(certificate, convoy.plant)
    estimates = rng.uniform(-0.8, 0.8, (400, convoy.plant.n)) * convoy.plant.half_widths
    inputs = rng.uniform(*convoy.plant.input_ends, (400, convoy.plant.m))
    one = shield.filter.decide_many(estimates, certificate.error_shapes[0], inputs)
    ages = [own.decide_many(estimates, shape, inputs).intervened for shape in certificate.error_shapes]
    assert np.array_equal(one.intervened, np.any(ages, axis=0))
    assert 2 * ages[0].sum() < one.intervened.sum() < 400
    shield.reset(seed=0)
    assert shield.step(np.zeros((2, 1), np.float32))[-1]["shield_guaranteed"].all()
