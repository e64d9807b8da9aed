"""What really moves: the plant's equations, a function, or another Gymnasium environment."""

from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box
from gymnasium.wrappers import OrderEnforcing, TimeLimit

from ncs_gym import Channel, Ellipsoid, FunctionProcess, GymProcess
from ncs_gym.plants.family import Remainder
from ncs_gym.processes.plant_step import without_remainder
from ncs_gym.processes.process import LinearProcess, Process
from tests.product import gym_env, gym_vector_env, linear_plant, loop_env, vector_env

QUIET = {"sensor_bound": 0.0, "initial_bound": 0.0}
A, B = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0], [0.1]])


def plant(**changes):
    settings = {"A": A, "B": B, "box": [1.0, 1.0], "u_max": 1.0, "dt": 0.1, "disturbance_bound": 0.01} | QUIET
    return linear_plant(**settings | changes)


def linear(state, u):
    return A @ state + B @ u


class Inner(gym.Env):
    """The same equations as another environment, which ends its episode far out and is cut off after ten steps."""

    observation_space = Box(-np.inf, np.inf, (2,))
    action_space = Box(-1.0, 1.0, (1,))

    made: ClassVar = []

    def __init__(self, gain=1.0):
        self.gain, self.closed, self.seeds = gain, False, []
        self.made.append(self)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.state, self.steps = self.np_random.uniform(-0.05, 0.05, 2), 0
        return self.state.astype(np.float32), {}

    def step(self, action):
        assert action.dtype == np.float32
        self.state, self.steps = A @ self.state + self.gain * B @ action.astype(np.float64), self.steps + 1
        return self.state.astype(np.float32), 0.0, bool(abs(self.state[0]) > 0.5), self.steps >= 10, {}

    def close(self):
        self.closed = True


def read(env):
    return env.state


def write(env, state):
    env.state = state


INNER = GymProcess(Inner, read_state=read, write_state=write)


def rollout(env, steps=30, seed=5):
    """What a random agent sees and is told, as numbers."""
    rng, rows = np.random.default_rng(0), []
    observation, info = env.reset(seed=seed)
    for _ in range(steps):
        rows.append(np.concatenate([observation.ravel(), info["state"].ravel(), np.ravel(info["assumption_violated"])]))
        shape = env.action_space.shape
        observation, *_, info = env.step(rng.uniform(-1.0, 1.0, shape).astype(np.float32))
    return np.array(rows)


@pytest.mark.parametrize("vectorized", [False, True])
def test_function_with_the_plants_equations_moves_like_the_plant(vectorized):
    process = FunctionProcess(linear, vectorized)
    np.testing.assert_allclose(rollout(loop_env(plant(), process=process)), rollout(loop_env(plant())), atol=1e-12)
    many, own = vector_env(3, plant=plant(), process=process), vector_env(3, plant=plant())
    np.testing.assert_allclose(rollout(many), rollout(own), atol=1e-12)


def test_inner_environment_is_started_where_the_loop_says():
    env = loop_env(plant(disturbance_bound=0.0), process=INNER, initial_set=Ellipsoid(0.09 * np.eye(2)))
    _, info = env.reset(seed=1)
    inner = Inner.made[-1]
    np.testing.assert_array_equal(inner.state, info["state"])
    assert np.abs(info["state"]).max() > 0.05  # further than its own resets
    assert env.start is env.initial_set
    _, info = env.reset(options={"state": [0.25, -0.5]})
    np.testing.assert_array_equal(inner.state, [0.25, -0.5])
    np.testing.assert_array_equal(env.start, [0.25, -0.5])
    _, _, _, _, info = env.step(np.array([1.0]))
    np.testing.assert_allclose(info["state"], linear(np.array([0.25, -0.5]), np.ones(1)))
    env.close()
    assert inner.closed


def test_without_write_state_episodes_start_where_the_inner_reset_leaves_it():
    process = GymProcess(Inner, read_state=read)
    env = loop_env(plant(), process=process, initial_set=Ellipsoid(1e-4 * np.eye(2)))
    known = set()
    for seed in range(20):
        _, info = env.reset(seed=seed)
        np.testing.assert_array_equal(Inner.made[-1].state, info["state"])
        inside = env.initial_set.contains(info["state"])
        known.add(inside)
        assert (env.start is env.initial_set) == inside
        assert inside or np.array_equal(env.start, info["state"])
    assert known == {True, False}
    many = vector_env(20, plant=plant(), process=process, initial_set=Ellipsoid(1e-4 * np.eye(2)))
    _, info = many.reset(seed=0)
    inside = many.single.initial_set.gauge(info["state"]) <= 1.0
    np.testing.assert_array_equal(np.isnan(many.starts[:, 0]), inside)
    np.testing.assert_array_equal(many.starts[~inside], info["state"][~inside])


def test_inner_end_of_an_episode_is_that_of_the_loop():
    env = loop_env(plant(disturbance_bound=0.0), process=INNER)
    env.reset(seed=0, options={"state": [0.0, 0.0]})
    ends = [env.step(np.zeros(1))[2:4] for _ in range(10)]
    assert ends == [(False, False)] * 9 + [(False, True)]
    with pytest.raises(gym.error.ResetNeeded, match="the episode is over"):
        env.step(np.zeros(1))
    env.reset(options={"state": [0.9, 0.9]})
    assert env.step(np.zeros(1))[2:4] == (True, False)


def test_time_limit_inside_is_not_that_of_the_loop():
    """Of the environment inside only its own ends count, wherever it has a `TimeLimit`."""

    def make():
        return OrderEnforcing(TimeLimit(OrderEnforcing(TimeLimit(Inner(), 3)), 4))

    process = GymProcess(make, read_state=lambda env: env.unwrapped.state)
    env = gym_env(plant=plant(), process=process, max_episode_steps=7)
    many = gym_vector_env(2, plant=plant(), process=process, max_episode_steps=7)
    env.reset(seed=0)
    many.reset(seed=0)
    for k in range(7):
        assert env.step(np.zeros(1))[2:4] == (False, k == 6)
        assert many.step(np.zeros((2, 1)))[3].tolist() == [k == 6] * 2


def test_inner_ends_in_a_vector_restart_that_environment_alone():
    many = vector_env(2, plant=plant(disturbance_bound=0.0), process=INNER, autoreset_mode="SameStep")
    many.reset(seed=0, options={"state": np.array([[0.0, 0.0], [0.9, 0.9]])})
    *_, terminated, truncated, info = many.step(np.zeros((2, 1)))
    assert terminated.tolist() == [False, True]
    assert not truncated.any()
    assert many.episodes.tolist() == [1, 2]
    assert np.abs(info["state"]).max() < 0.2
    assert not info["assumption_violated"].any()
    many.close()
    assert all(each.closed for each in Inner.made[-2:])


def test_disturbances_act_on_what_is_written_and_only_there():
    still = np.zeros(1, np.float32)
    for process, moves in ((INNER, True), (GymProcess(Inner, read_state=read), False)):
        env = loop_env(plant(), process=process)
        _, info = env.reset(seed=0)
        before = info["state"]
        *_, info = env.step(still)
        assert (np.abs(info["state"] - linear(before, np.zeros(1))).max() > 1e-6) == moves
        np.testing.assert_array_equal(Inner.made[-1].state, info["state"])


def test_remainder_is_left_to_the_process():
    """The linear plant may be disturbed by all of E(D); beside a process only what is declared beside the remainder."""
    left_out = Remainder(Ellipsoid(0.01 * np.eye(2)), True, "an example")
    whole = plant(disturbance_bound=0.0, remainder=left_out)
    np.testing.assert_allclose(whole.disturbance.shape_matrix, 0.01 * np.eye(2), rtol=1e-6)
    assert without_remainder(whole).fingerprint == plant(disturbance_bound=0.0).fingerprint != whole.fingerprint
    for process, moves in ((LinearProcess(), True), (FunctionProcess(linear), False)):
        env = loop_env(whole, process=process, disturbance="sphere")
        _, info = env.reset(seed=0)
        before = info["state"]
        *_, info = env.step(np.zeros(1))
        assert (np.abs(info["state"] - A @ before).max() > 1e-6) == moves


@pytest.mark.parametrize("loss", [0.0, 1.0])  # without any sample the alarm is that of the process alone
@pytest.mark.parametrize("many", [False, True])
def test_step_outside_the_model_raises_the_alarm_until_the_next_episode(many, loss):
    strong = GymProcess(lambda: Inner(gain=1.5), read_state=read, write_state=write)
    settings = {"plant": plant(), "process": strong, "channel": Channel(loss=loss)}
    env = vector_env(2, **settings, autoreset_mode="Disabled") if many else loop_env(**settings)
    full = np.array([[1.0], [0.0]], np.float32) if many else np.ones(1, np.float32)
    env.reset(seed=0, options={"state": np.zeros(2)})
    *_, info = env.step(0.0 * full)
    assert not np.any(info["assumption_violated"])
    for action in (full, 0.0 * full):  # it is latched
        *_, info = env.step(action)
        np.testing.assert_array_equal(info["assumption_violated"], [True, False] if many else True)
    _, info = env.reset()
    assert not np.any(info["assumption_violated"])


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("many", [False, True])
def test_a_step_too_large_for_float64_is_an_alarm(many):
    process = FunctionProcess(lambda state, u: np.array([1e308, -1e308]))
    settings = {"plant": plant(), "process": process, "channel": Channel(delay=3)}
    env = vector_env(2, **settings) if many else loop_env(**settings)
    env.reset(seed=0)
    *_, info = env.step(np.zeros((2, 1) if many else 1, np.float32))
    assert np.all(info["assumption_violated"])


class Drag(Process):
    """Slows down by a part of the size of its state, as one state alone has it."""

    vectorized = True

    def step(self, plant, state, u):
        return A @ state + B @ u - 0.01 * np.linalg.norm(state)


class OneDrag(Drag):
    """Does not declare `vectorized`: it is stepped for one environment after the other."""

    def step(self, plant, state, u):
        assert state.ndim == 1
        return super().step(plant, state, u)


def test_process_that_declares_nothing_is_stepped_for_one_environment_after_the_other():
    starts = np.random.default_rng(0).uniform(-0.3, 0.3, (8, 2))
    settings = {"plant": plant(), "disturbance": lambda rng, plant, nominal: np.zeros(2), "process": OneDrag()}
    many = vector_env(8, **settings, allow_assumption_violation=True)
    many.reset(seed=0, options={"state": starts})
    *_, info = many.step(np.ones((8, 1), np.float32))
    wanted = [Drag().step(plant(), x, np.ones(1)) for x in starts]
    np.testing.assert_allclose(info["state"], wanted, atol=1e-12)
    assert (Drag.vectorized, OneDrag.vectorized) == (True, False)


def test_process_of_others_cannot_write_into_the_state():
    def written(plant, state, u):
        state *= 0.5
        return state

    one = loop_env(plant=plant(), process=type("Writing", (Process,), {"step": lambda self, *given: written(*given)})())
    one.reset(seed=0)
    with pytest.raises(ValueError, match="read-only"):
        one.step(np.ones(1, np.float32))
