"""Linear controllers by name: what they do to the plants they are made for."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from experiments.baselines.controllers import CONTROLLERS, RegulatorWeights, controller, equilibrium
from ncs_gym import Channel, Regulation, SetpointTracking
from ncs_gym.envs.env import ncs_env
from shields.certificate import Fallback
from tests.plants import small
from tests.product import linear_plant, loop_env

SETPOINTS = ("ncs_gym/CartPole-v0", "ncs_gym/BatchReactor-v0")


def env_of(env_id):
    return ncs_env(gym.make(env_id))


def settled(env, name, K, target, steps=600):
    """State and input after following a target without disturbance, from rest, and the largest |c_j x| on the way."""
    policy, x = controller(name, env, Fallback.of_gain(K), 0), np.zeros(env.plant.n)
    for _ in range(steps):
        observation = np.append(x, target)[None].astype(np.float32)
        u = env.plant.largest_input * policy(observation, {"estimate": x[None]})[0]
        x = env.plant.A @ x + env.plant.B @ u
    return x, u


class Own(SetpointTracking):
    """A profile of targets of one's own, for the reward that controllers know."""

    def advance(self, rng, plant, task_state, u):
        return -task_state


class Refined(Regulation):
    """Pays for something else than what it is derived from."""

    def reward(self, plant, task_state, state, u):
        return float(abs(state[0]))


def test_controllers_say_that_they_do_not_know_what_a_task_of_your_own_asks_for():
    plant, target = env_of("ncs_gym/CartPole-v0").plant, Own(output=np.eye(4)[0], reach=0.1, width=0.1)
    own, refined = (loop_env(plant=plant, task=task) for task in (target, Refined()))
    rests = Fallback.of_gain(np.zeros((1, 4)))
    for name in ("lqr", "mpc", "mpc:10"):
        controller(name, own, rests, 0)
        with pytest.raises(ValueError, match=f"{name} does not know what a Refined asks for"):
            controller(name, refined, rests, 0)
    for name in ("zero input", "K x_hat", "random"):
        controller(name, refined, rests, 0)


@pytest.mark.parametrize("costs", [{}, {"state_cost": [[1.0, 0.0], [0.0, 0.0]], "input_cost": [[1e-4]]}])
def test_regulator_of_regulation_is_that_of_its_reward(costs):
    plant = small([[1.0, 0.1], [0.0, 0.95]], B=[[0.005], [0.1]], box=[1.0, 2.0], gamma=1e-6)
    env = loop_env(plant=plant, task=Regulation(**costs), channel=Channel(max_consecutive_losses=1))
    Q, R = env.task.costs(plant)
    P = solve_discrete_are(plant.A, plant.B, Q, R)
    gain = -np.linalg.solve(R + plant.B.T @ P @ plant.B, plant.B.T @ P @ plant.A)
    states = 0.01 * np.random.default_rng(0).standard_normal((20, 2))
    for name in ("lqr", "mpc"):
        actions = controller(name, env, Fallback.of_gain(np.zeros((1, 2))), 0)(states, {"estimate": states})
        np.testing.assert_allclose(actions, states @ gain.T / plant.input_half, rtol=5e-3, atol=1e-6)


@pytest.mark.parametrize("env_id", SETPOINTS)
def test_regulator_with_set_point_reaches_the_target(env_id):
    env = env_of(env_id)
    x, _ = settled(env, "lqr", np.zeros((env.plant.m, env.plant.n)), 0.2)
    assert env.task.output @ x == pytest.approx(0.2, abs=2e-3)
    at_one = equilibrium(env.plant, env.task.output)
    np.testing.assert_allclose(env.plant.A @ at_one[0] + env.plant.B @ at_one[1], at_one[0], atol=1e-9)
    np.testing.assert_allclose(x, 0.2 * at_one[0], atol=2e-2)


def test_regulator_of_the_speed_removes_the_error():
    env = env_of("ncs_gym/TruckTrailerCruise-v0")
    regulator, x, left = controller("lqr", env, Fallback.of_gain(np.zeros((1, 2))), 0), np.zeros(2), 8.0
    error, estimates = np.array([[0.0, 0.0, 1.5], [0.0, 0.0, -20.0]], np.float32), {"estimate": np.zeros((2, 2))}
    more = np.hstack([error, [[3.0, 0.1], [0.0, 0.2]]]).astype(np.float32)  # an age and a half-width, with observe=
    np.testing.assert_array_equal(regulator(more, estimates), regulator(error, estimates))
    for _ in range(40):
        u = env.plant.largest_input * regulator(np.append(x, left)[None], {"estimate": x[None]})[0]
        x, left = env.plant.A @ x + env.plant.B @ u, left - env.plant.dt * u[0]
    assert abs(left) < 0.05


@pytest.mark.parametrize("env_id", ["ncs_gym/CSTR-v0", "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/TruckTrailer-v0"])
def test_mpc_far_from_all_limits_is_the_regulator(env_id):
    env, rng = env_of(env_id), np.random.default_rng(0)
    observations = 2e-2 * rng.standard_normal((3, *env.observation_space.shape))
    estimates = {"estimate": observations[:, : env.plant.n]}
    predicted, optimal = (
        controller(name, env, Fallback.of_gain(np.zeros((1, 2))), 0)(observations, estimates) for name in ("mpc", "lqr")
    )
    assert np.abs(optimal).max() > 1e-5
    np.testing.assert_allclose(predicted, optimal, atol=1e-2 * np.abs(optimal).max())


def two_ended(task=None):
    """A tank above another one, whose levels and valve have limits that are not symmetric about their rest."""
    plant = linear_plant(
        A=[[0.9, 0.0], [0.095, 0.92]], B=[[0.114], [0.006]], dt=2.0, disturbance_bound=0.01, sensor_bound=0.01,
        initial_bound=0.05, operating_state=[3.0, 3.5], operating_input=[2.6],
        state_limits=([0.5, 0.5], [4.0, 6.0]), input_limits=(0.0, 8.0),
    )  # fmt: skip
    return loop_env(plant=plant, channel=Channel(), task=task)


def inputs_of(plant, actions):
    return plant.input_half * actions + plant.input_middle


@pytest.mark.parametrize("name", CONTROLLERS)
def test_actions_stand_for_inputs_between_both_ends(name):
    plant, estimates = (env := two_ended()).plant, np.random.default_rng(0).uniform(-9.0, 9.0, (400, 2))
    fallback = Fallback(np.array([[-0.8, -0.3]]), np.array([0.5, 0.25]), np.array([0.125]))
    u = inputs_of(plant, controller(name, env, fallback, 0)(estimates, {"estimate": estimates}))
    assert ((plant.input_ends[0] - 1e-12 <= u) & (u <= plant.input_ends[1] + 1e-12)).all()
    if name == "zero input":
        np.testing.assert_allclose(u, 0.0, atol=1e-12)
    else:
        np.testing.assert_allclose([u.min(), u.max()], plant.input_ends[:, 0], atol=0.1)
    if name == "K x_hat":
        wanted = 0.125 + (estimates - [0.5, 0.25]) @ fallback.gain.T
        np.testing.assert_allclose(u, np.clip(wanted, *plant.input_ends), atol=1e-12)


@pytest.mark.cases(1)
@pytest.mark.parametrize("name", ["mpc", "mpc:20"])
@pytest.mark.parametrize("target", [-4.0, 4.0])
def test_mpc_comes_close_to_both_ends_and_no_further(name, target):
    env, weights = (
        two_ended(SetpointTracking(output=np.array([0.0, 1.0]), reach=0.5, width=0.5)),
        RegulatorWeights(1e-4, 0.0),
    )
    plant, reached = env.plant, {}
    for each in ("lqr", name):
        policy, states = controller(each, env, Fallback.of_gain(np.zeros((1, 2))), 0, weights), [np.zeros(2)]
        for _ in range(150):
            actions = policy(np.array([[*states[-1], target]]), {"estimate": states[-1][None]})
            states.append(plant.A @ states[-1] + plant.B @ inputs_of(plant, actions)[0])
        reached[each] = plant.constraint_values(np.transpose(states)).max()
    margin = 0.2 if name.endswith("20") else 0.0
    assert reached["lqr"] > 0.05
    assert -margin - 0.05 <= reached[name] <= -margin + 1e-6
