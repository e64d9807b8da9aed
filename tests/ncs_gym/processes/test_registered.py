"""The registered environments whose process is not linear."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import ncs_gym
from ncs_gym.processes.cart_pole_process import CartPoleProcess, nonlinear_cart_pole, sampled_cart_pole
from ncs_gym.processes.gym_pendulum import PendulumProcess
from ncs_gym.processes.mujoco_pendulum import InvertedPendulumProcess, inverted_pendulum, sampled_inverted_pendulum
from ncs_gym.processes.plant_step import without_remainder
from ncs_gym.registration import needing_extras, registered_ids

IDS = ("ncs_gym/Pendulum-v0", "ncs_gym/CartPoleNonlinear-v0", "ncs_gym/InvertedPendulum-v0")


def made(env_id, **settings):
    if env_id in needing_extras():
        pytest.skip("the extra of this environment is not installed")
    return gym.make(env_id, **settings)


@pytest.mark.parametrize("env_id", IDS)
def test_checkers_pass_without_a_warning(env_id):
    env = made(env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("env_id", IDS)
def test_nothing_leaves_its_bound_inside_the_box(env_id):
    env = made(env_id)
    plant = env.unwrapped.plant
    rng = np.random.default_rng(0)
    for seed in range(20):
        state = rng.uniform(-0.9, 0.9, plant.n) * plant.half_widths
        env.reset(seed=seed, options={"state": state})
        *_, info = env.step(rng.uniform(-1.0, 1.0, plant.m).astype(np.float32))
        assert not info["assumption_violated"]


@pytest.mark.parametrize("env_id", IDS)
def test_vectors_move_like_single_environments(env_id):
    made(env_id).close()
    many, rng = gym.make_vec(env_id, num_envs=3), np.random.default_rng(1)
    env = gym.make(env_id)
    plant = env.unwrapped.plant
    action = rng.uniform(-1.0, 1.0, (3, plant.m)).astype(np.float32)
    _, info = many.reset(seed=0)
    *_, after = many.step(action)
    for e in range(3):
        env.reset(seed=0, options={"state": info["state"][e]})
        *_, single = env.step(action[e])
        room = np.sqrt(np.diag(without_remainder(plant).disturbance.shape_matrix))  # of two disturbances
        assert (np.abs(single["state"] - after["state"][e]) <= 2.0 * room).all()
    many.close()


@pytest.mark.parametrize("env_id", IDS)
def test_linear_model_is_that_of_the_process_and_spec_is_json(env_id):
    env = made(env_id)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.plant.fingerprint == env.unwrapped.plant.fingerprint
    assert env.unwrapped.plant.remainder.proved == (env_id == "ncs_gym/Pendulum-v0")


@pytest.mark.parametrize(
    ("declared", "sampled", "needs"),
    [(nonlinear_cart_pole, sampled_cart_pole, ""), (inverted_pendulum, sampled_inverted_pendulum, "mujoco")],
)
def test_declared_model_is_the_one_that_sampling_finds(declared, sampled, needs):
    if needs:
        pytest.importorskip(needs)
    plant, again = declared(), sampled()
    assert plant.remainder.proved is again.remainder.proved is False
    widths = plant.half_widths
    np.testing.assert_allclose(plant.A * widths / widths[:, None], again.A * widths / widths[:, None], atol=1e-6)
    np.testing.assert_allclose(plant.B / widths[:, None], again.B / widths[:, None], atol=1e-6)
    units = np.sqrt(np.outer(*2 * [np.diag(again.remainder.bound.shape_matrix)]))
    np.testing.assert_allclose(
        plant.remainder.bound.shape_matrix / units, again.remainder.bound.shape_matrix / units, atol=1e-3
    )
    for name in ("of_sensor", "of_first_error", "of_disturbance"):
        np.testing.assert_array_equal(getattr(plant, name).bound.shape_matrix, getattr(again, name).bound.shape_matrix)


@pytest.mark.parametrize(
    ("env_id", "fields", "expected"),
    [
        (IDS[0], {"mass": 1.2}, PendulumProcess(mass=1.2)),
        (IDS[1], {"pole_mass": 0.2}, CartPoleProcess(pole_mass=0.2)),
        (IDS[2], {"mass_factor": 0.5}, InvertedPendulumProcess(mass_factor=0.5)),
        ("ncs_gym/CartPole-v0", {"cart_mass": 1.1}, CartPoleProcess(cart_mass=1.1)),
    ],
)
def test_process_may_be_a_json_value(env_id, fields, expected):
    env = made(env_id, process=fields)
    assert env.unwrapped.process == expected
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.process == expected
    env.reset(seed=0)
    env.step(np.ones(1, np.float32))


def test_missing_extra_is_named_in_one_sentence(monkeypatch):
    inverted = IDS[2]
    monkeypatch.setattr("ncs_gym.processes.mujoco_pendulum.find_spec", lambda name: None)
    monkeypatch.setattr("ncs_gym.registration.find_spec", lambda name: None)
    assert inverted in gym.registry
    assert inverted not in registered_ids()
    assert needing_extras() == [inverted]
    for make in (lambda: gym.make(inverted), lambda: gym.make_vec(inverted, num_envs=2), sampled_inverted_pendulum):
        with pytest.raises(ModuleNotFoundError, match=r"needs MuJoCo: .* pip install -e '.\[mujoco\]'$"):
            make()


def test_cart_pole_has_the_linear_one_as_its_tangent():
    plant, step = ncs_gym.cart_pole(), 1e-6

    def moved(state, u):
        return CartPoleProcess().step(plant, state, u)

    for column, direction in enumerate(np.eye(4)):
        slope = (moved(step * direction, np.zeros(1)) - moved(-step * direction, np.zeros(1))) / (2.0 * step)
        np.testing.assert_allclose(slope, plant.A[:, column], atol=1e-8)
    slope = (moved(np.zeros(4), np.full(1, step)) - moved(np.zeros(4), np.full(1, -step))) / (2.0 * step)
    np.testing.assert_allclose(slope, plant.B[:, 0], atol=1e-8)


def test_cart_pole_keeps_its_energy_without_a_force():
    process, plant = CartPoleProcess(), ncs_gym.cart_pole()

    def energy(state):
        _, speed, angle, rate = state
        m, length, g = process.pole_mass, process.length, 9.81
        across, up = speed + length * rate * np.cos(angle), -length * rate * np.sin(angle)
        return 0.5 * process.cart_mass * speed**2 + 0.5 * m * (across**2 + up**2) + m * g * length * np.cos(angle)

    state = np.array([0.0, 0.3, 0.2, -1.0])
    before = energy(state)
    for _ in range(100):
        state = process.step(plant, state, np.zeros(1))
    assert abs(state[2]) > 1.0  # it has fallen
    np.testing.assert_allclose(energy(state), before, rtol=1e-5)
