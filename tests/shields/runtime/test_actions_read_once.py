"""What is tested is what is applied, whatever an action is made of and whoever writes into it meanwhile."""

import numpy as np
import pytest

from ncs_gym import Ellipsoid, truck_trailer
from tests.certificates import certificate_of
from tests.product import loop_env, safe_loop, safety_filter, safety_shield, vector_env, vector_shield
from tests.shields.attacks.cases import CHANNELS

PLANT = truck_trailer(mass=4000.0)
COUNT = 3


def scalar(mode="project"):
    S = certificate_of(PLANT).safe_set
    env = loop_env(PLANT, CHANNELS["perfect"], initial_set=Ellipsoid(0.9 * S.shape_matrix), disturbance="adversarial")
    return safety_shield(env, certificate_of(PLANT), mode)


def vector(mode="project"):
    S = certificate_of(PLANT).safe_set
    settings = {"initial_set": Ellipsoid(0.9 * S.shape_matrix), "disturbance": "adversarial"}
    env = vector_env(COUNT, plant=PLANT, channel=CHANNELS["perfect"], **settings)
    return vector_shield(env, certificate_of(PLANT), mode)


class Shifting:
    """An array-like that is harmless when it is asked for numbers first, and full throttle from then on."""

    def __init__(self, shape):
        self.shape, self.asked = shape, 0

    def __array__(self, dtype=None, copy=None):
        self.asked += 1
        return np.full(self.shape, 0.0 if self.asked == 1 else 1.0, dtype or np.float64)


@pytest.mark.cases(4)
@pytest.mark.parametrize("mode", ["project", "lookahead", "monitor"])
@pytest.mark.parametrize("shielded", [scalar, vector])
def test_action_whose_numbers_change_is_asked_for_them_once(shielded, mode):
    env = shielded(mode=mode)
    env.reset(seed=0)
    for _ in range(100):
        action = Shifting(env.action_space.shape)
        *_, info = env.step(action)
        assert action.asked == 1
        assert not np.any(info["input_proposed"])
        assert np.all(info["shield_reason"] == "")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shielded", [scalar, vector])
def test_action_that_another_thread_writes_into_is_applied_as_it_was_tested(shielded, dtype, monkeypatch):
    env = shielded()
    env.reset(seed=0)
    move = env.unwrapped._now.move

    def written_into(*given):
        action[:] = 1.0
        return move(*given)

    monkeypatch.setattr(env.unwrapped._now, "move", written_into)
    for _ in range(50):
        action = np.zeros(env.action_space.shape, dtype)
        *_, info = env.step(action)
        assert action.all()
        np.testing.assert_array_equal(info["input"], info["input_proposed"])
        assert not np.any(info["input"])
        assert np.all(info["shield_guaranteed"])


def test_what_a_filter_and_a_loop_were_given_may_be_written_into_afterwards():
    certificate = certificate_of(PLANT)
    shield, loop = safety_filter(certificate, PLANT), safe_loop(certificate, PLANT, CHANNELS["perfect"])
    estimate, proposed, shape, told = np.zeros(2), np.ones(1), 0.1 * certificate.Sigma, np.ones(1)
    errors, decision = shield.errors_of(shape), shield.decide(estimate, shape, proposed)
    shape[:], estimate[:], proposed[:] = 0.0, 9.0, 4.0
    assert decision.input.tolist() == [1.0]
    np.testing.assert_equal(shield.errors_of(0.1 * certificate.Sigma), errors)
    loop.start(np.zeros(2))
    told = loop.decide(1.0).input.copy()
    seen = loop.receive([], applied=told)
    told[:] = 4.0
    np.testing.assert_array_equal(loop.estimate, seen)
    assert loop.guaranteed
