"""A guarantee that is lost is said: once per episode and reason, where the caller stands, after everything else."""

import warnings

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from ncs_gym import Channel, truck_trailer
from shields import GuaranteeLostError, GuaranteeLostWarning
from shields.runtime.guard import NOT_KNOWN_INSIDE, OTHER_INPUT, OTHER_STEPS
from tests.certificates import certificate_of
from tests.product import loop_env, loop_step, safe_loop, safety_shield, vector_env, vector_shield

PLANT = truck_trailer(mass=4000.0)
OUTSIDE = 0.99 / np.abs(PLANT.box).max(axis=0)


def scalar(**settings):
    return safety_shield(loop_env(PLANT), certificate_of(PLANT), **settings)


def vector(**settings):
    return vector_shield(vector_env(3, plant=PLANT), certificate_of(PLANT), **settings)


def loop(**settings):
    return safe_loop(certificate_of(PLANT), PLANT, Channel(), **settings)


def still(shield):
    return np.zeros(shield.action_space.shape, np.float32)


def lose(shield, seed=0):
    """Begins an episode in which the loop moves without its guard: nothing is proved till the next."""
    shield.reset(seed=seed)
    env = shield.unwrapped
    env._now.move(env.np_random, np.zeros(np.shape(env.belief.applied)))


def said(call):
    """The warnings of a call: what they say and where."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call()
    assert {each.category for each in caught} <= {GuaranteeLostWarning}
    return [(str(each.message), each.filename) for each in caught]


@pytest.mark.parametrize("shielded", [scalar, vector])
def test_shield_warns_once_in_each_episode_of_each_reason(shielded):
    shield = shielded()

    def episode():
        lose(shield)
        for _ in range(3):
            *_, info = shield.step(still(shield))
            assert np.all(info["shield_reason"] == OTHER_STEPS)

    text = f"the state is not proved safe now: {OTHER_STEPS}"
    assert said(episode) == [(text, __file__)]
    assert said(episode) == [(text, __file__)]
    starts = said(lambda: shield.reset(options={"state": OUTSIDE}))
    assert [NOT_KNOWN_INSIDE in text for text, _ in starts] == [True]
    assert said(lambda: shield.reset(seed=0)) == []


@pytest.mark.parametrize("shielded", [scalar, vector])
def test_shield_raises_when_the_step_has_been_taken_and_goes_on(shielded):
    shield = shielded(on_unproved="raise")
    lose(shield)
    with pytest.raises(GuaranteeLostError, match=OTHER_STEPS):
        shield.step(still(shield))
    assert np.all(shield.unwrapped.steps == 2)
    *_, info = shield.step(still(shield))
    assert np.all(info["shield_reason"] == OTHER_STEPS)
    with pytest.raises(GuaranteeLostError, match=NOT_KNOWN_INSIDE):
        shield.reset(options={"state": OUTSIDE})
    shield.step(still(shield))


def test_one_environment_of_many_is_enough_and_says_it_in_its_own_episode():
    shield = vector()
    states = np.zeros((3, PLANT.n))
    states[1] = OUTSIDE
    assert len(said(lambda: shield.reset(seed=0, options={"state": states}))) == 1
    mask = np.array([True, False, True])
    assert said(lambda: shield.reset(options={"reset_mask": mask})) == []
    assert len(said(lambda: shield.reset(options={"reset_mask": ~mask, "state": states}))) == 1


def test_guarantee_lost_in_the_last_step_of_an_episode_is_said_though_the_next_has_begun(monkeypatch):
    env = vector_env(2, plant=PLANT, max_episode_steps=1, autoreset_mode=AutoresetMode.SAME_STEP)
    shield, move = vector_shield(env, certificate_of(PLANT)), env._now.move
    monkeypatch.setattr(env._now, "move", lambda rng, u: move(rng, 0.5 * u))
    shield.reset(seed=0)
    (text, _), *others = said(lambda: shield.step(np.full(shield.action_space.shape, 0.01, np.float32)))
    assert OTHER_INPUT in text
    assert others == []
    assert len(said(lambda: shield.step(np.full(shield.action_space.shape, 0.01, np.float32)))) == 1


def test_loop_warns_its_caller_once_in_each_episode_of_each_reason():
    real = loop()

    def episode():
        real.start(np.zeros(PLANT.n))
        loop_step(real, np.zeros(PLANT.m))
        for _ in range(3):
            real.receive(applied=PLANT.largest_input)
            real.decide(np.zeros(PLANT.m))

    for _ in range(2):
        (text, place), *others = said(episode)
        assert OTHER_INPUT in text
        assert place == __file__
        assert others == []
    with pytest.warns(GuaranteeLostWarning, match=NOT_KNOWN_INSIDE):
        real.start(OUTSIDE)


@pytest.mark.parametrize("kind", [GuaranteeLostError, GuaranteeLostWarning])
def test_loop_takes_nothing_back_when_a_lost_guarantee_is_raised(kind):
    real = loop(on_unproved="raise" if kind is GuaranteeLostError else "warn")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(kind, match=NOT_KNOWN_INSIDE):
            real.start(OUTSIDE)
        real.start(np.zeros(PLANT.n))
        loop_step(real, np.zeros(PLANT.m))
        with pytest.raises(kind, match=OTHER_INPUT):
            real.receive(applied=PLANT.largest_input)
        assert (real.steps, real.reason) == (1, OTHER_INPUT)
        assert real.estimate @ real.estimate > 0.0  # it has followed what was applied
        real.decide(np.zeros(PLANT.m))
        loop_step(real, np.zeros(PLANT.m))
