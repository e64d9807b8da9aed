from dataclasses import replace
from functools import cached_property, partial

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, Disturbance, Regulation, SetpointTracking, SpeedTracking, Task, truck_trailer
from ncs_gym.tasks import farthest_equilibrium
from tests.product import linear_plant


def test_regulation_costs_about_one_at_the_edge_of_the_box(plant):
    assert Regulation().reward(plant, None, np.array([2.0, 0.0]), np.zeros(1)) == pytest.approx(-1.0)
    assert Regulation().reward(plant, None, np.zeros(2), np.array([4.0])) == pytest.approx(-0.01)


def test_speed_integrates_the_acceleration(plant):
    task = SpeedTracking(change_probability=0.0)
    task_state = task.advance(np.random.default_rng(0), plant, np.array([10.0, 20.0]), np.array([3.0]))
    np.testing.assert_array_equal(task_state, [10.0 + plant.dt * 3.0, 20.0])
    assert task.observe(task_state) == pytest.approx([8.5])


def test_speed_reward_is_the_documented_one(plant):
    task = SpeedTracking()
    assert task.reward(plant, np.array([10.0, 15.0]), np.zeros(2), np.array([2.0])) == pytest.approx(-0.2 - 0.008)
    assert task.reward(plant, np.array([0.0, 500.0]), np.zeros(2), np.zeros(1)) == pytest.approx(-1.0)


def test_profile_is_piecewise_constant_in_range_and_changes_at_its_rate(plant):
    task, rng = SpeedTracking(), np.random.default_rng(0)
    task_state = task.begin(rng, plant)
    targets = []
    for _ in range(10_000):
        task_state = task.advance(rng, plant, task_state, np.zeros(1))
        targets.append(task_state[1])
    changes = np.mean(np.diff(targets) != 0.0)
    assert changes == pytest.approx(0.02, abs=0.004)
    assert 0.0 <= min(targets) < 1.0
    assert 24.0 < max(targets) <= 25.0


def setpoints(**changes):
    return SetpointTracking(**({"output": [1.0, 0.0], "reach": 0.8, "width": 2.0} | changes))


def test_setpoint_tracking_pays_for_being_close(plant):
    task, rng = setpoints(width=0.5, change_probability=1.0), np.random.default_rng(0)
    target = task.begin(rng, plant)
    for off, expected in ((0.0, 1.0), (0.25, 0.5), (-3.0, 0.0)):
        assert task.reward(plant, target, np.array([target + off, 9.0]), np.zeros(1)) == pytest.approx(expected)
    assert len({task.advance(rng, plant, target, np.zeros(1)) for _ in range(50)}) == 50


def test_targets_known_ahead_are_those_that_come(plant):
    task, rng = setpoints(preview=4, change_probability=0.3), np.random.default_rng(0)
    task_state, announced, came = task.begin(rng, plant), [], []
    for _ in range(300):
        observed = task.observe(task_state)
        assert observed.shape == (5,)
        assert observed[0] == task.target(task_state)
        announced.append(observed[4])
        came.append(observed[0])
        task_state = task.advance(rng, plant, task_state, np.zeros(1))
    assert announced[:-4] == came[4:]
    assert len(set(came)) > 50
    assert 0.7 < np.abs(came).max() <= 0.8


def test_change_of_the_input_has_its_price_and_the_last_input_is_observed(plant):
    task, rng = setpoints(change_price=0.5), np.random.default_rng(0)
    task_state = task.begin(rng, plant)
    first = task.advance(rng, plant, task_state, np.array([3.0]))
    np.testing.assert_array_equal(task.observe(first), [task.target(first), 3.0])
    state = np.array([task.target(first), 0.0])
    assert task.reward(plant, first, state, np.array([3.0])) == pytest.approx(1.0 - 0.5 * 3.0 / 4.0)
    second = task.advance(rng, plant, first, np.array([-1.0]))
    assert task.reward(plant, second, state, np.array([-1.0])) == pytest.approx(
        1.0 - abs(state[0] - task.target(second)) / 2.0 - 0.5 * 4.0 / 4.0
    )


def test_farthest_equilibrium_is_that_of_a_search_over_all_inputs():
    rng = np.random.default_rng(3)
    for _ in range(5):
        A, B = 0.5 * rng.standard_normal((3, 3)), rng.standard_normal((3, 2))
        known = {"gamma": 1e-6, "sensor_bound": 0, "initial_bound": 0}
        plant = linear_plant(A=A, B=B, box=rng.uniform(0.5, 2.0, 3), u_max=[1.0, 2.0], dt=1.0, **known)
        to_state, output = np.linalg.solve(np.eye(3) - A, B), rng.standard_normal(3)
        angles = np.linspace(0.0, 2.0 * np.pi, 20_001)
        inputs = np.stack([np.cos(angles), np.sin(angles)])
        states = to_state @ inputs
        used = np.maximum(np.abs(plant.box @ states).max(axis=0), np.abs(inputs.T / plant.largest_input).max(axis=1))
        farthest = farthest_equilibrium(plant, output)
        assert farthest == pytest.approx((output @ states / used).max(), rel=1e-3)
        task = SetpointTracking(output=output, reach=(1.0 - 1e-6) * farthest, width=1.0)
        assert task.check(plant) == ""
        assert "no controller can hold" in replace(task, reach=1.001 * farthest).check(plant)
        assert replace(task, reach=0.1 * farthest).check(plant) == ""


class Paying(Task):
    """Pays what a function of state and input says."""

    def __init__(self, pays):
        object.__setattr__(self, "pays", pays)

    def reward(self, plant, task_state, state, u):
        return self.pays(state, u)


class PayingMany(Paying):
    vectorized = True


def written(state, u):
    state -= 0.02
    return 0.0


@pytest.mark.parametrize("kind", [Paying, PayingMany])
@pytest.mark.parametrize(
    ("pays", "words"),
    [
        (lambda state, u: -np.square(u), "the reward of Paying.* must be a number"),
        (lambda state, u: None, "the reward of Paying.* must be a number"),
        (lambda state, u: np.nan * state[0], "the reward of Paying.* must be a number"),
        (written, "read-only"),
    ],
)
def test_reward_is_a_number_and_moves_nothing(kind, pays, words):
    settings = {"plant": truck_trailer(mass=4000.0), "task": kind(pays)}
    single = gym.make("ncs_gym/LinearNCS-v0", **settings)
    single.reset(seed=0)
    with pytest.raises(ValueError, match=words):
        single.step(np.ones(1, np.float32))
    many = gym.make_vec("ncs_gym/LinearNCS-v0", num_envs=3, **settings)
    many.reset(seed=0)
    with pytest.raises(ValueError, match=words):
        many.step(np.ones((3, 1), np.float32))


class Counting(Task):
    """Counts steps in a list or an array, and what `predict` writes there."""

    def __init__(self, first):
        object.__setattr__(self, "first", first)

    def begin(self, rng, plant, size=None):
        return self.first.copy()

    def advance(self, rng, plant, task_state, u):
        task_state[0] += 1
        return task_state

    def predict(self, plant, task_state, u):
        task_state[0] += 1
        return task_state

    def observe(self, task_state):
        return np.array([float(task_state[0])])

    def observation_bound(self, plant, horizon):
        return np.array([1000.0])

    def reward(self, plant, task_state, state, u):
        return float(task_state[0])


def test_what_is_predicted_does_not_move_the_state_of_a_task():
    for make, axes in ((gym.make, ()), (partial(gym.make_vec, num_envs=1), (1,))):
        settings = {"plant": truck_trailer(mass=4000.0), "downlink": Channel(delay=2)}
        env = make("ncs_gym/LinearNCS-v0", task=Counting([0]), **settings)
        env.reset(seed=0)
        steps = [env.step(np.zeros((*axes, 1), np.float32)) for _ in range(3)]
        assert [float(np.squeeze(step[1])) for step in steps] == [1.0, 2.0, 3.0]
        assert [float(np.squeeze(step[0][..., -1])) for step in steps] == [3.0, 4.0, 5.0]
        with pytest.raises(ValueError, match="read-only"):
            make("ncs_gym/LinearNCS-v0", task=Counting(np.zeros(1)), **settings).reset(seed=0)


class Smooth(Task):
    """Remembers something in itself when a moment comes."""

    def __init__(self, moment):
        self.moment, self.count, self.last = moment, 0, np.zeros(1)

    def remember(self, moment):
        if moment == self.moment:
            self.count += moment != "reward"
            self.last += moment == "reward"

    def begin(self, rng, plant, size=None):
        self.remember("begin")
        return super().begin(rng, plant, size)

    def advance(self, rng, plant, task_state, u):
        self.remember("advance")
        return task_state

    def reward(self, plant, task_state, state, u):
        self.remember("reward")
        return -np.sum(state * self.weights, axis=0)

    @cached_property
    def weights(self):
        """Computed once, which is no memory of an episode."""
        return np.ones(1)


class SmoothMany(Smooth):
    vectorized = True


@pytest.mark.parametrize(
    ("kind", "moment", "name"),
    [(Smooth, "advance", "count"), (Smooth, "reward", "last"), (SmoothMany, "begin", "count")],
)
def test_what_a_task_stores_in_itself_is_refused_where_environments_share_it(kind, moment, name):
    settings = {"plant": truck_trailer(mass=4000.0), "task": kind(moment)}
    env, envs = (make("ncs_gym/LinearNCS-v0", **settings) for make in (gym.make, partial(gym.make_vec, num_envs=3)))
    env.reset(seed=0)
    env.step(np.ones(1, np.float32))
    message = f"{kind.__name__} stores '{name}' in itself, which all environments of a vector share"
    if moment != "begin":
        envs.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        envs.reset(seed=0) if moment == "begin" else envs.step(np.ones((3, 1), np.float32))


class Drifting(Disturbance):
    """A disturbance that remembers in itself where it is."""

    def __init__(self):
        self.at = 0.0

    def draw(self, rng, plant, nominal_next, step, memory):
        self.at += 1e-6
        return np.zeros(plant.n)


def test_what_a_disturbance_stores_in_itself_is_refused_where_environments_share_it():
    settings = {"plant": truck_trailer(mass=4000.0), "disturbance": Drifting()}
    gym.make("ncs_gym/LinearNCS-v0", **settings).reset(seed=0)
    envs = gym.make_vec("ncs_gym/LinearNCS-v0", num_envs=3, **settings)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="Drifting stores 'at' in itself, which all environments of a vector share"):
        envs.step(np.ones((3, 1), np.float32))


class Restless(Regulation):
    """Draws more than the task that it is made of."""

    def begin(self, rng, plant, size=None):
        rng.random(7)
        return super().begin(rng, plant, size)

    def advance(self, rng, plant, task_state, u):
        rng.random(3)
        return super().advance(rng, plant, task_state, u)


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
def test_loop_is_the_same_whatever_a_task_draws(make):
    seen = []
    for task in (None, Restless()):
        env = make("ncs_gym/TruckTrailerCruise-v0", task=task)
        infos = [env.reset(seed=5)[1]] + [env.step(np.zeros(env.action_space.shape))[4] for _ in range(30)]
        infos.append(env.reset()[1])
        seen.append(
            [np.concatenate([np.ravel(info[key]) for key in ("state", "estimate", "packets")]) for info in infos]
        )
    np.testing.assert_array_equal(*seen)
