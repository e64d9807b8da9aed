"""The guard stands inside: no wrapper comes between it and the plant."""

import copy
import pickle
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.vector import VectorActionWrapper
from gymnasium.wrappers.vector import DictInfoToList
from stable_baselines3.common.monitor import Monitor

from ncs_gym import AdversarialDisturbance, Channel, VectorRequestActions, truck_trailer
from shields import SafetyShield
from shields.runtime.guard import OTHER_INPUT, OTHER_STEPS
from tests.certificates import certificate_of, metric
from tests.product import loop_env, safety_shield, vector_env, vector_shield

PLANT = truck_trailer(mass=4000.0)
CERTIFICATE = certificate_of(PLANT)
CRUISE = "ncs_gym/TruckTrailerCruise-v0"
COPIES = copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))


def scalar(**settings):
    return safety_shield(loop_env(PLANT), CERTIFICATE, **settings)


def vector(**settings):
    return vector_shield(vector_env(2, plant=PLANT), CERTIFICATE, **settings)


class Backwards(gym.ActionWrapper):
    """Does the opposite of what it is told."""

    def action(self, action):
        return -action


class Backwards2(VectorActionWrapper):
    """The same of many."""

    def actions(self, actions):
        return -actions


class WarmUp(gym.Wrapper):
    """Moves before an episode is handed on, and restarts in the middle of it."""

    def reset(self, **given):
        self.env.reset(**given)
        observation, *_, info = self.env.step(np.ones(1, np.float32))
        return observation, info


class InPlace(gym.Wrapper):
    """Writes into the action while it is applied, and into all arrays that come back."""

    def step(self, action):
        action = np.array(action)
        result = self.env.step(action)
        action[...] = 1.0
        for value in result[-1].values():
            if isinstance(value, np.ndarray) and value.flags.writeable:
                value[...] = 7.0
        return result


# What wrappers may do to actions, resets and infos, on the way to the environment.
INSIDE = {
    "clips": wrappers.ClipAction,
    "rescales": lambda env: wrappers.RescaleAction(env, np.float32(-3.0), np.float32(5.0)),
    "sticks": lambda env: wrappers.StickyAction(env, 0.5),
    "repeats": lambda env: Repeats(env),
    "skips": lambda env: wrappers.MaxAndSkipObservation(env, 3),
    "begins by itself": wrappers.Autoreset,
    "reverses": Backwards,
    "moves first": WarmUp,
    "writes": InPlace,
    "counts": Monitor,
}


class Repeats(gym.Wrapper):
    """Applies every action four times."""

    def step(self, action):
        for _ in range(4):
            result = self.env.step(action)
        return result


@pytest.mark.cases(6)
@pytest.mark.parametrize("mode", ["project", "lookahead"])
@pytest.mark.parametrize("name", INSIDE)
def test_no_wrapper_inside_the_shield_breaks_its_promise(name, mode):
    nature = AdversarialDisturbance(metric(CERTIFICATE))
    env = safety_shield(INSIDE[name](loop_env(PLANT, disturbance=nature)), CERTIFICATE, mode)
    bare = loop_env(PLANT, disturbance=nature)
    rng, broken = np.random.default_rng(0), 0
    for seed in range(2):
        env.reset(seed=seed)
        bare.reset(seed=seed)
        for step in range(60):
            action = np.full(1, rng.choice([-1.0, 1.0]) if step % 20 < 5 else 1.0, np.float32)
            env.step(action)
            belief = env.unwrapped.belief
            assert np.abs(PLANT.box @ env.unwrapped.state).max() <= 1.0
            assert env.unwrapped.guard.code == 0
            assert belief.applied.flags.writeable is False
            broken += bare.step(action)[4]["cost"]
    assert broken > 0


class Shifting:
    """An array-like that is harmless when it is asked for numbers first, and full throttle from then on."""

    def __init__(self, shape):
        self.shape, self.asked = shape, 0

    def __array__(self, dtype=None, copy=None):
        self.asked += 1
        return np.full(self.shape, 0.0 if self.asked == 1 else 1.0, dtype or np.float64)


@pytest.mark.parametrize("mode", ["lookahead", "monitor"])
@pytest.mark.parametrize("made", [scalar, vector])
def test_action_whose_numbers_change_is_asked_for_them_once(made, mode):
    env = made(mode=mode)
    env.reset(seed=0)
    for _ in range(20):
        action = Shifting(env.action_space.shape)
        *_, info = env.step(action)
        assert action.asked == 1
        assert not np.any(info["input_proposed"])
        assert np.all(info["shield_guaranteed"])


def test_list_of_infos_inside_is_refused_with_where_to_put_the_wrapper():
    asking = DictInfoToList(vector_env(2, plant=PLANT, channel=Channel(on_request=True)))
    words = "VectorRequestActions reads .* makes a list .* outside of VectorRequestActions"
    with pytest.raises(ValueError, match=words):
        VectorRequestActions(asking).reset()


@pytest.mark.parametrize("order", ["inside", "outside"])
def test_an_action_counts_as_it_arrives_whatever_wrappers_make_of_it(order):
    env = vector_env(2, plant=PLANT)
    env = (
        vector_shield(Backwards2(env), CERTIFICATE)
        if order == "inside"
        else Backwards2(vector_shield(env, CERTIFICATE))
    )
    env.reset(seed=0)
    for _ in range(30):
        *_, info = env.step(np.ones((2, 1), np.float32))
        np.testing.assert_array_equal(info["input_proposed"], np.tile(PLANT.input_ends[0], (2, 1)))
        assert info["shield_guaranteed"].all()
    assert info["episode_interventions"].all()


@pytest.mark.parametrize("made", [scalar, vector])
def test_a_loop_that_moves_without_its_guard_proves_nothing_until_the_next_reset(made):
    shield = made(on_unproved="ignore")
    env, action = shield.unwrapped, np.zeros(shield.action_space.shape)
    for _ in range(2):
        assert np.all(shield.reset(seed=0)[1]["shield_guaranteed"])
        assert np.all(shield.step(action)[-1]["shield_guaranteed"])
        env._now.move(env.np_random, np.zeros(np.shape(env.belief.applied)))
        for states in (3, 4, 5):
            info = shield.step(action)[-1]
            assert np.all(info["shield_reason"] == OTHER_STEPS)
            assert not np.any(info["shield_guaranteed"])
            assert np.all(info["episode_guaranteed"] == 2 / states)


@pytest.mark.parametrize("made", [scalar, vector])
def test_another_input_than_the_one_decided_is_seen(made, monkeypatch):
    shield = made(on_unproved="ignore")
    env, action = shield.unwrapped, np.full(shield.action_space.shape, 0.1)
    shield.reset(seed=0)
    move = env._now.move
    assert np.all(shield.step(action)[-1]["shield_guaranteed"])
    with monkeypatch.context() as patch:
        patch.setattr(env._now, "move", lambda rng, u: move(rng, 0.9 * u))
        assert np.all(shield.step(action)[-1]["shield_reason"] == OTHER_INPUT)
    assert np.all(shield.step(action)[-1]["shield_reason"] == OTHER_INPUT)
    assert np.all(shield.reset()[1]["shield_guaranteed"])


@pytest.mark.parametrize("mode", ["project", "lookahead"])
@pytest.mark.parametrize("made", [scalar, vector])
def test_an_input_that_is_decided_and_not_applied_ends_the_claim(made, mode):
    shield = made(mode=mode, on_unproved="ignore")
    env, action = shield.unwrapped, np.zeros(shield.action_space.shape)
    shield.reset(seed=0)
    env.guard.decide(np.zeros(np.shape(env.belief.applied)))
    for _ in range(2):
        assert np.all(shield.step(action)[-1]["shield_reason"] == OTHER_STEPS)
    assert np.all(shield.reset()[1]["shield_guaranteed"])
    assert np.all(shield.step(action)[-1]["shield_guaranteed"])
    u = env.guard.decide(np.zeros(np.shape(env.belief.applied))).input
    env._now.move(env.np_random, u)
    assert np.all(shield.step(action)[-1]["shield_reason"] == OTHER_STEPS)


@pytest.mark.parametrize("moves", [False, True])
def test_an_input_without_its_step_ends_the_claim_also_where_others_begin(moves):
    shield = vector(on_unproved="ignore")
    env = shield.unwrapped
    shield.reset(seed=0)
    u = env.guard.decide(np.zeros((1, 2))).input
    if moves:
        env._now.move(env.np_random, u)
    info = shield.reset(options={"reset_mask": np.array([True, False])})[1]
    assert info["shield_reason"].tolist() == ["", OTHER_STEPS]
    info = shield.step(np.zeros((2, 1)))[-1]
    assert info["shield_reason"].tolist() == ["", OTHER_STEPS]


@pytest.mark.parametrize("copied", [lambda env: env, copy.copy, *COPIES])
@pytest.mark.parametrize("made", [scalar, vector])
def test_nobody_writes_into_what_a_guard_decides_from(made, copied):
    shield = made()
    shield.reset(seed=0)
    shield.step(np.ones(shield.action_space.shape))
    env = copied(shield).unwrapped
    assert not hasattr(env, "estimator")
    for belief in (env.belief, env.guard.belief, copied(env.belief)):
        arrays = [each for each in belief if isinstance(each, np.ndarray)]
        assert len(arrays) == (9 if made is vector else 3)
        assert not any(each.flags.writeable for each in arrays)
    assert env.belief.table is env.guard.belief.table is env._now.estimator.table


@pytest.mark.parametrize("made", [scalar, vector])
def test_another_environment_in_place_of_the_wrapped_one_is_said_at_the_next_reset(made):
    shield, other = made(), made().env
    shield.reset(seed=0)
    shield.env = other
    with pytest.raises(ValueError, match="the environment is not the one that the shield was made for"):
        shield.reset()


def test_a_shield_that_is_refused_leaves_the_environment_bare():
    env = loop_env(PLANT)
    for wrong in ({"penalty": -1.0}, {"certificate": "missing.json"}):
        with pytest.raises(ValueError, match=r".+"):
            safety_shield(env, **({"certificate": CERTIFICATE} | wrong))
    with pytest.raises(TypeError, match="Expected env"):
        safety_shield(SimpleNamespace(unwrapped=env), CERTIFICATE)
    assert env.guard is None
    shield = safety_shield(env, CERTIFICATE)
    assert env.guard is shield.unwrapped.guard is not None


@pytest.mark.cases(3)
@pytest.mark.parametrize("copied", COPIES)
@pytest.mark.parametrize("mode", ["project", "lookahead"])
@pytest.mark.parametrize("made", [scalar, vector])
def test_a_copy_goes_on_alike_with_a_guard_of_its_own(made, mode, copied):
    shield = made(mode=mode, penalty=0.5)
    shield.reset(seed=0)
    action = np.ones(shield.action_space.shape, np.float32)
    for _ in range(5):
        shield.step(action)
    twin = copied(shield)
    assert twin.unwrapped.guard is not shield.unwrapped.guard
    assert twin.filter is twin.unwrapped.guard.filter
    for _ in range(10):
        one, other = shield.step(action), twin.step(action)
        np.testing.assert_array_equal(one[1], other[1])
        assert one[-1].keys() == other[-1].keys()
        for key, value in one[-1].items():
            np.testing.assert_array_equal(value, other[-1][key], err_msg=key)
    twin.penalty = 0.0
    assert shield.penalty == 0.5
    twin.reset()


def test_specification_makes_the_shield_again():
    shield = gym.make(safety_shield(gym.make(CRUISE), CERTIFICATE, "switch", 0.25).spec)
    assert isinstance(shield, SafetyShield)
    assert (shield.mode, shield.penalty, shield.unwrapped.guard.penalty) == ("switch", 0.25, 0.25)
    assert shield.filter is shield.unwrapped.guard.filter
