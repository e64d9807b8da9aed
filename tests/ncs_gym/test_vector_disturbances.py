"""Disturbances of many environments at once: within their bound, and like those of one."""

import warnings

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import (
    AdversarialDisturbance,
    BoxDisturbance,
    Disturbance,
    FunctionProcess,
    SinusoidDisturbance,
    truck_trailer,
)
from ncs_gym.limits import MovedOperatingPointWarning
from tests.product import library_plant, linear_plant, loop_env, vector_env

IN_M = AdversarialDisturbance(np.array([[2.0, 0.3], [0.3, 1.0]]))


@pytest.mark.parametrize("source", [SinusoidDisturbance(period=7.0), AdversarialDisturbance(), IN_M])
def test_batched_draws_equal_scalar_ones(source):
    plant, rng = truck_trailer(), np.random.default_rng(0)
    memory = source.begin_many(rng, plant, 30)
    nominal, steps = rng.standard_normal((2, 30)), rng.integers(0, 50, 30)
    drawn = source.draw_many(rng, plant, nominal, steps, memory)
    for i in range(30):
        one = source.draw(rng, plant, nominal[:, i], int(steps[i]), memory[:, i])
        np.testing.assert_allclose(drawn[:, i], one, atol=1e-7)


class Loud(BoxDisturbance):
    """A user's class that may be drawn ahead, with one draw outside every bound."""

    vectorized = True
    memoryless = True
    size = 5.0

    def draw(self, rng, plant, nominal_next, step, memory):
        drawn = np.zeros(nominal_next.shape)
        drawn[:, -1] = self.size
        return drawn


class Misshapen(Loud):
    """A user's class that returns one disturbance for all steps."""

    vectorized = memoryless = True  # which is not inherited where `draw` is another

    def draw(self, rng, plant, nominal_next, step, memory):
        return np.zeros((plant.n, 1))


@pytest.mark.parametrize("kind", [loop_env, lambda **settings: vector_env(2, **settings)])
def test_disturbances_that_are_drawn_ahead_are_checked(kind):
    for source, words in ((Loud(), "outside its bound"), (Misshapen(), "finite with shape")):
        env = kind(plant=truck_trailer(), disturbance=source)
        env.reset(seed=0)
        for error, said in ((ValueError, words), (gym.error.ResetNeeded, "")):
            with pytest.raises(error, match=said):
                env.step(np.zeros(env.action_space.shape, np.float32))
    env = kind(plant=truck_trailer(), disturbance=Loud(), allow_assumption_violation=True)
    env.reset(seed=0)
    *_, info = env.step(np.zeros(env.action_space.shape, np.float32))
    assert np.abs(info["state"]).max() > 4.0


@pytest.mark.parametrize("promised", [(), ("vectorized",), ("vectorized", "memoryless")])
@pytest.mark.parametrize("kind", [loop_env, lambda **settings: vector_env(3, **settings)])
def test_a_disturbance_that_writes_into_what_it_is_given_moves_nothing(kind, promised):
    class Scratch(Disturbance):
        locals().update(dict.fromkeys(promised, True))

        def draw(self, rng, plant, nominal_next, step, memory):
            nominal_next += 1.0
            if isinstance(step, np.ndarray):
                step += 7
            return np.zeros_like(nominal_next)

    plant = library_plant(truck_trailer, gamma=0.01, process_noise_cov=np.zeros((2, 2)))
    env = kind(plant=plant, disturbance=Scratch())
    _, info = env.reset(seed=0)
    for step in range(1, 6):
        before = info["state"]
        *_, info = env.step(env.action_space.sample())
        np.testing.assert_allclose(info["state"], before @ plant.A.T + info["input"] @ plant.B.T, atol=1e-12)
        assert (np.asarray(info["episode_steps"]) == step).all()


@pytest.mark.parametrize("name", ["box", "ball"])
def test_a_load_about_a_middle_that_is_not_zero_is_drawn_between_its_ends(name):
    """The point where its middle rests is rounded, and the bound has room for that in all directions."""
    size = 0.02
    E = size * np.array([[0.5], [1.0]])
    drawn = {}
    for ends in ((-0.5, 0.5), (0.0, 1.0)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MovedOperatingPointWarning)
            plant = linear_plant(
                A=[[0.8, 0.0], [0.1, 0.7]], B=[[0.4], [0.0]], dt=1.0, box=[1.0, 1.0], u_max=1.0,
                disturbance_bound=(E, *ends), sensor_bound=0.01, initial_bound=0.02,
            )  # fmt: skip
        env = vector_env(2000, plant=plant, disturbance=name)
        before = env.reset(seed=0)[1]["state"]
        *_, infos = env.step(np.zeros(env.action_space.shape, np.float32))
        d = infos["state"] - before @ plant.A.T - infos["input"] @ plant.B.T
        drawn[ends] = np.sort(d @ E[:, 0] / (E.T @ E).item())
        assert np.abs(d - np.outer(d @ E[:, 0], E[:, 0]) / (E.T @ E).item()).max() < 1e-6 * size
    for load in drawn.values():  # deviations from the middle
        np.testing.assert_allclose(load, np.linspace(-0.5, 0.5, 2000), atol=0.04)


@pytest.mark.parametrize("kind", [loop_env, lambda **settings: vector_env(3, **settings)])
def test_disturbances_outside_their_bound_violate_the_assumption_at_the_step_at_which_they_act(kind):
    plant = linear_plant(
        A=0.5 * np.eye(2), B=[[0.0], [0.3]], box=1.0, u_max=1.0, dt=0.1,
        disturbance_bound=0.05, sensor_bound=0.01, initial_bound=0.02,
    )  # fmt: skip
    bound = plant.nominal_disturbance.extreme_point(np.array([1.0, 0.3]))

    class Late(Disturbance):
        """At the fourth step of an episode a little too large, before that on the boundary."""

        def draw(self, rng, plant, nominal_next, step, memory):
            return (1.001 if step == 3 else 1.0) * bound

    for process in (None, FunctionProcess(lambda x, u: plant.A @ x + plant.B @ u)):
        env = kind(plant=plant, disturbance=Late(), allow_assumption_violation=True, process=process)
        env.reset(seed=0)
        flags = [env.step(np.zeros(env.action_space.shape, np.float32))[4]["assumption_violated"] for _ in range(6)]
        assert np.array(flags).reshape(6, -1).all(axis=1).tolist() == [False, False, False, True, True, True]
        assert not np.any(env.reset(seed=1)[1]["assumption_violated"])
