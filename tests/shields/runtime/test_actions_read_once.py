"""What is tested is what is applied, whatever an action is made of and whoever writes into it meanwhile."""

from copy import deepcopy
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import VectorWrapper

from ncs_gym import Ellipsoid, NCSEnv, NCSVectorEnv, truck_trailer
from shields import SafeLoop, SafetyFilter, SafetyShield, VectorSafetyShield
from tests.certificates import certificate_of
from tests.interruptions import at, places, tracing
from tests.shields.attacks.cases import CHANNELS

PLANT = truck_trailer(mass=4000.0)
COUNT = 3


def scalar(wrapper=lambda env: env, mode="project"):
    S = certificate_of(PLANT).safe_set
    env = NCSEnv(PLANT, CHANNELS["perfect"], initial_set=Ellipsoid(0.9 * S.shape_matrix), disturbance="adversarial")
    return SafetyShield(wrapper(env), certificate_of(PLANT), mode)


def vector(wrapper=lambda env: env, mode="project"):
    S = certificate_of(PLANT).safe_set
    settings = {"initial_set": Ellipsoid(0.9 * S.shape_matrix), "disturbance": "adversarial"}
    env = NCSVectorEnv(COUNT, plant=PLANT, channel=CHANNELS["perfect"], **settings)
    return VectorSafetyShield(wrapper(env), certificate_of(PLANT), mode)


class Shifting:
    """An array-like that is harmless when it is asked for numbers first, and full throttle from then on."""

    def __init__(self, shape):
        self.shape, self.asked = shape, 0

    def __array__(self, dtype=None, copy=None):
        self.asked += 1
        return np.full(self.shape, 0.0 if self.asked == 1 else 1.0, dtype or np.float64)


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


class ScalarWriter(gym.Wrapper):
    """Another thread that writes into the caller's action between the shield and the environment."""

    def step(self, action):
        self.buffer[:] = 1.0
        return self.env.step(action)


class VectorWriter(VectorWrapper):
    step = ScalarWriter.step


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("shielded", "writer"), [(scalar, ScalarWriter), (vector, VectorWriter)])
def test_action_that_another_thread_writes_into_is_applied_as_it_was_tested(shielded, writer, dtype):
    env = shielded(writer)
    env.reset(seed=0)
    for _ in range(50):
        env.env.buffer = action = np.zeros(env.action_space.shape, dtype)
        *_, info = env.step(action)
        assert action.all()
        np.testing.assert_array_equal(info["input"], info["input_proposed"])
        assert not np.any(info["input"])
        assert np.all(info["shield_guaranteed"])


@pytest.mark.parametrize("shielded", [scalar, vector])
def test_action_written_into_at_any_line_of_a_step_is_applied_as_it_was_tested(shielded):
    env = shielded()
    env.reset(seed=0)
    action, seen = np.zeros(env.action_space.shape, np.float32), set()
    for place in places(partial(env.step, action))[::3]:
        action[:] = 0.0
        *_, info = at(place, partial(action.fill, 1.0), partial(env.step, action))
        seen |= set(info["input_proposed"].ravel().tolist())
        assert np.all(info["shield_reason"] == "")  # the input applied is the one decided
    assert seen == {0.0, PLANT.u_max.item()}


def edge():
    """A state near the boundary of S, of which one full throttle would leave S."""
    return 0.9 * certificate_of(PLANT).safe_set.extreme_point(np.array([1.0, 0.4]))


def check_decisions(decide):
    """Decides about a buffer that turns harmless at a line, or is that already, and harmful at a later one."""
    (harmful,) = PLANT.u_max * np.sign(PLANT.B.T @ certificate_of(PLANT).M @ PLANT.A @ edge())
    buffer = np.zeros(PLANT.m)
    lines = max(places(partial(decide, np.full(PLANT.m, value)))[-1] for value in (np.nan, 0.0, harmful))
    assert decide(np.array([harmful])).intervened
    turns = [(0.0, -1, second) for second in range(lines)]
    turns += [(np.nan, first, second) for first in range(0, lines, 3) for second in range(first + 1, first + 12, 2)]
    for begins, *turn in turns:
        buffer.fill(begins)
        count = iter(range(10 * lines))

        def write(*_, count=count, turn=turn):
            line = next(count)
            if line in turn:
                buffer.fill(harmful if line == turn[1] else 0.0)

        with tracing(write):
            decision = decide(buffer)
        assert decision.fallback or decision.input.item() != harmful


def test_filter_decides_about_one_and_the_same_input():
    certificate = certificate_of(PLANT)
    check_decisions(partial(SafetyFilter(certificate, PLANT).decide, edge(), 0.1 * certificate.Sigma))


def test_loop_decides_about_one_and_the_same_input():
    loop = SafeLoop(certificate_of(PLANT), PLANT, CHANNELS["perfect"])
    loop.start(edge(), initial_set=edge())
    check_decisions(lambda proposed: deepcopy(loop).decide(proposed))


def test_error_shape_that_is_written_into_is_remembered_as_what_was_judged():
    certificate = certificate_of(PLANT)
    shield, small = SafetyFilter(certificate, PLANT), 0.1 * certificate.Sigma
    for place in places(partial(shield.errors_of, small.copy())):
        fresh, shape = SafetyFilter(certificate, PLANT), small.copy()
        at(place, partial(shape.fill, 0.0), partial(fresh.errors_of, shape))
        for kept in (small, np.zeros_like(small)):
            np.testing.assert_equal(fresh.errors_of(kept), shield.errors_of(kept))


def test_reported_input_that_is_written_into_is_compared_and_used_alike():
    certificate = certificate_of(PLANT)
    loop = SafeLoop(certificate, PLANT, CHANNELS["perfect"])

    def moved(told):
        loop.start(np.zeros(PLANT.n))
        loop.decide(1.0)
        return told, loop.receive([], applied=told)

    (_, honest), (_, other) = moved(np.ones(PLANT.m)), moved(np.full(PLANT.m, 4.0))
    told = np.ones(PLANT.m)
    for place in places(partial(moved, told))[::2]:
        told[:] = 1.0
        _, estimate = at(place, partial(told.fill, 4.0), partial(moved, told))
        np.testing.assert_array_equal(estimate, honest if loop.guaranteed else other)
