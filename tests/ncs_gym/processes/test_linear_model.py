"""Linear models of processes: the fit, the bound on the remainder, and how it is known."""

import copy
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest

from ncs_gym import Channel, Ellipsoid, FunctionProcess, LinearPlant
from ncs_gym.limits import MovedOperatingPointWarning
from ncs_gym.plants.family import Remainder
from ncs_gym.processes.gym_pendulum import PendulumProcess, pendulum
from ncs_gym.processes.linearization import NoEquilibriumWarning, surrounding_shape
from tests.certificates import certificate_of
from tests.product import altered, gym_env, linear_model, safety_shield

QUIET = {"disturbance_bound": 0.0, "sensor_bound": 0.0, "initial_bound": 0.0}
BOX, TORQUE, STEP = [0.25, 1.5], 2.0, 0.05
PULL = STEP * 15.0
JACOBIAN = (
    [[1.0 + STEP * PULL * np.cos(0.25), STEP, 0.0075], [PULL * np.cos(0.25), 1.0, 0.15]],
    [[1.0 + STEP * PULL, STEP, 0.0075], [PULL, 1.0, 0.15]],
)


def swing(state, u):
    """The equations of `Pendulum-v1`, written down from its documentation."""
    rate = state[1] + STEP * (15.0 * np.sin(state[0]) + 3.0 * u[0])
    return np.array([state[0] + STEP * rate, rate])


def model(process=swing, **changes):
    settings = {"box": BOX, "samples": 2_000} | QUIET | changes
    return linear_model(process, u_max=TORQUE, dt=STEP, **settings)


def points(count, seed=7):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (count, 2)) * BOX, rng.uniform(-1.0, 1.0, (count, 1)) * TORQUE


def gauges(plant, step, count=500):
    """Sizes of remainders in units of D, which has room for rounding next to the bound."""
    left_out = [step(x, u) - plant.A @ x - plant.B @ u for x, u in zip(*points(count), strict=True)]
    return plant.disturbance.gauge(np.array(left_out))


@pytest.mark.parametrize("jacobian_bounds", [None, JACOBIAN])
def test_remainder_lies_in_its_bound_and_says_how_that_is_known(jacobian_bounds):
    plant = model(jacobian_bounds=jacobian_bounds)
    assert gauges(plant, swing).max() <= 1.0
    assert plant.remainder.proved == (jacobian_bounds is not None)
    words = "is bounded by proof" if plant.remainder.proved else "is assumed to lie in its bound"
    (sentence,) = (each for each in plant.assumptions if "linear model" in each)
    assert words in sentence
    assert ("bounds on its Jacobian" if plant.remainder.proved else "safety factor 1.25") in sentence


def test_sampled_bound_is_tight_and_grows_with_the_safety_factor():
    once, twice = model(safety_factor=1.02), model(safety_factor=2.04)
    np.testing.assert_allclose(twice.remainder.bound.shape_matrix, 4.0 * once.remainder.bound.shape_matrix)
    assert gauges(once, swing, 2_000).max() > 0.9
    # One direction alone, (dt, 1): the other one is as thin as rounding.
    assert np.linalg.eigvalsh(once.remainder.bound.shape_matrix)[0] < 1e-7 * np.trace(once.remainder.bound.shape_matrix)


@pytest.mark.filterwarnings("ignore::ncs_gym.processes.linearization.NoEquilibriumWarning")
@pytest.mark.parametrize("offset", [0.0, 0.02, -0.02])
def test_proved_bound_holds_what_a_step_from_rest_leaves_out(offset):
    """A kink attains the mean value theorem's bound, and what happens at rest comes on top of that."""

    def kinked(state, u):
        return 0.5 * state + 0.3 * u + 0.1 * np.abs(state) + offset

    bounds = [[0.4, 0.3]], [[0.6, 0.3]]
    plant = linear_model(kinked, [0.5], [1.0], 0.1, jacobian_bounds=bounds, samples=200, **QUIET)
    assert plant.remainder.proved
    np.testing.assert_allclose(np.sqrt(plant.remainder.bound.shape_matrix), [[0.05 + abs(offset)]], rtol=1e-6)


def test_proved_bound_reaches_to_the_farther_end():
    """The same kink between -0.5 and 2, with an input between -3 and 1: attained at the far ends."""

    def kinked(state, u):
        return 0.5 * state + 0.3 * u + 0.1 * np.abs(state) + 0.05 * np.abs(u)

    limits = {"state_limits": (4.5, 7.0), "operating_state": 5.0, "input_limits": (-2.0, 2.0), "operating_input": 1.0}
    bounds = [[0.4, 0.25]], [[0.6, 0.35]]
    plant = linear_model(kinked, dt=0.1, jacobian_bounds=bounds, samples=200, **limits, **QUIET)
    reach = np.sqrt(plant.remainder.bound.shape_matrix.item())
    np.testing.assert_allclose(reach, 0.1 * 2.0 + 0.05 * 3.0, rtol=1e-6)
    np.testing.assert_allclose(reach, kinked(2.0, -3.0) - plant.A.item() * 2.0 + plant.B.item() * 3.0, rtol=1e-6)


LEVEL, FLOW = 0.6, 0.5 * np.sqrt(0.6)
TANK = {
    "state_limits": (0.2, 2.0),
    "input_limits": (0.0, 1.0),
    "operating_state": LEVEL,
    "operating_input": FLOW,
    "dt": 0.2,
    "samples": 2_000,
    "disturbance_bound": 0.005,
    "sensor_bound": 0.01,
    "initial_bound": 0.01,
}


def tank(level, inflow):
    """A tank that runs out as the root of its level, in deviations from where LEVEL rests with FLOW."""
    return level + 0.2 * (FLOW + inflow - 0.5 * np.sqrt(np.maximum(LEVEL + level, 0.0)))


def test_bound_holds_between_two_different_ends_and_no_further():
    plant = linear_model(tank, **TANK)
    low, high = plant.own_limits[:, 0]
    np.testing.assert_allclose([low, high], [-0.4, 1.4])

    def sizes(levels):
        inflow = np.linspace(-FLOW, 1.0 - FLOW, 11)[:, None]
        left_out = tank(levels, inflow) - plant.A.item() * levels - plant.B.item() * inflow
        return plant.remainder.bound.gauge(left_out.reshape(-1, 1))

    assert 0.75 < sizes(np.linspace(low, high, 401)).max() <= 1.0
    assert sizes(np.array([high + 1.0])).max() > 1.0
    halved = linear_model(tank, **TANK | {"state_limits": (0.2, 1.0)})
    assert halved.remainder.bound.shape_matrix.item() < 0.25 * plant.remainder.bound.shape_matrix.item()


@pytest.mark.cases(1)
@pytest.mark.parametrize("past", [{"du_max": 0.3}, {"du_max": 0.3, "input_delay": 1}])
def test_past_inputs_are_kept_beside_the_process_which_moves_the_others(past):
    """What is left of a step of the tank, with the input that acts, is the declared disturbance."""
    plant = linear_model(tank, **TANK | past)
    channel = Channel(loss=0.3, max_consecutive_losses=2)
    env = gym_env(plant=plant, process=FunctionProcess(tank), channel=channel)
    env = safety_shield(env, certificate_of(plant, env.unwrapped.certificate_contract, "polytope"))
    rng, off, actions = np.random.default_rng(0), [], []
    _, info = env.reset(seed=0, options={"state": np.zeros(plant.n)})
    for step in range(150):
        before = info["state"]
        actions.append(np.clip(rng.normal(np.sign(step % 50 - 25), 0.5, 1), -1.0, 1.0).astype(np.float32))
        *_, info = env.step(actions[-1])
        assert info["shield_guaranteed"]
        assert not info["cost"]
        acting = before[1:2] if "input_delay" in past else info["input"]
        off.append(info["state"][0] - tank(before[:1], acting).item())
        np.testing.assert_array_equal(info["state"][1:], [*before[2:], *info["input"]])
    assert 0.004 < np.abs(off).max() <= 0.005
    quiet = {"plant": altered(plant, disturbance_bound=0.0), "process": FunctionProcess(tank, vectorized=True)}
    loops = gym.make("ncs_gym/LinearNCS-v0", **quiet), gym.make_vec("ncs_gym/LinearNCS-v0", num_envs=2, **quiet)
    for each in loops:
        each.reset(seed=0, options={"state": np.zeros(plant.n)})
    for action in actions[:20]:
        one, many = (each.step(np.broadcast_to(action, each.action_space.shape))[4]["state"] for each in loops)
        np.testing.assert_allclose(many, np.broadcast_to(one, many.shape), atol=1e-12)


def test_disturbance_that_moves_the_operating_point_is_refused():
    """The remainder was bounded around another point, and the function counts from it."""
    disturbed = TANK | {"disturbance_bound": ([[1.0]], [0.0], [0.004])}
    with pytest.warns(MovedOperatingPointWarning), pytest.raises(ValueError, match="another model"):
        linear_model(tank, **disturbed)


def test_pendulum_is_proved_by_another_route():
    """Not sin(angle) / angle but the extremes of the remainder, which lie at the ends or where the slope is its own."""
    plant = pendulum()
    assert plant.remainder.proved
    slope = plant.A[1, 0] / PULL
    angles = np.array([0.25, np.arccos(slope)])
    largest = PULL * np.abs(np.sin(angles) - slope * angles).max() + 0.15 * TORQUE * 3.0 * 2.0**-24  # what rounds
    np.testing.assert_allclose(plant.remainder.bound.support(np.array([[0.0, 1.0]])), largest, rtol=1e-6)


def test_ellipsoid_around_points_holds_them_and_is_nearly_the_smallest():
    rng = np.random.default_rng(3)
    root = rng.standard_normal((3, 3))
    directions = rng.standard_normal((4_000, 3))
    cloud = directions / np.linalg.norm(directions, axis=1)[:, None] @ root.T
    shape = surrounding_shape(cloud, np.array([1.0, 10.0, 0.1]))
    assert Ellipsoid(shape).gauge(cloud).max() <= 1.0 + 1e-9
    assert np.linalg.det(shape) < 1.05 * np.linalg.det(root @ root.T)


@pytest.mark.parametrize("mass", [1.0, 1.4634146])
def test_proved_bound_holds_what_the_environment_rounds_to_float32(mass):
    """A float32 torque times 3 / (m l^2) is a float32: gain, torque and product round at the edge of the box."""
    plant = pendulum(mass=mass)
    inner = PendulumProcess(mass=mass).opened(plant, None)
    rng, largest = np.random.default_rng(0), 0.0
    for u in rng.uniform(1.0, TORQUE, 1_000):
        state = np.array([-0.25, 0.0])
        for torque in (u, -u):
            x_next = inner.step(plant, inner.write(state), np.array([torque]))
            left_out = x_next - plant.A @ state - plant.B[:, 0] * torque
            largest = max(largest, plant.disturbance.gauge(left_out))
    inner.close()
    assert 0.999 < largest <= 1.0


def test_operating_point_that_does_not_stay_is_told():
    """A tank that runs dry: counted from where an input holds the level nothing is told."""

    def tank(x, u):
        return x + 0.1 * (u - 0.5 * np.sqrt(np.maximum(x + 1.0, 0.0)))

    settings = {"disturbance_bound": 0.001, "sensor_bound": 0.01, "initial_bound": 0.01}
    with pytest.warns(NoEquilibriumWarning, match=r"moves it by 0\.1 half-widths"):
        model = linear_model(tank, [0.5], [0.6], 0.1, samples=500, **settings)
    with warnings.catch_warnings():
        warnings.simplefilter("error", NoEquilibriumWarning)
        moved = linear_model(lambda x, u: tank(x, u + 0.5), [0.5], [0.6], 0.1, samples=500, **settings)
    assert moved.remainder.bound.shape_matrix.item() < model.remainder.bound.shape_matrix.item()


def test_remainder_is_not_sampled_where_limits_of_several_entries_forbid():
    """Beyond them this process does what no linear model bears."""

    def bursting(state, u):
        beyond = max(abs(u[0] + u[1]), abs(state @ [4.0, 1.0])) > 1.0 + 1e-9
        return 0.5 * state + 0.1 * u[0] + (50.0 if beyond else 0.0)

    settings = {"state_limits": ([-1.0, -1.0], [1.0, 1.0]), "u_max": [1.0, 1.0], "samples": 2_000} | QUIET
    limits = {"output_limits": [([4.0, 1.0], -1.0, 1.0)], "mixed_limits": [([0.0, 0.0], [1.0, 1.0], -1.0, 1.0)]}
    plant = linear_model(bursting, dt=STEP, **settings, **limits)
    assert plant.remainder.bound.support(np.eye(2)).max() < 1e-6
    with pytest.raises(ValueError, match="another model, limits or operating point"):
        altered(plant, mixed_rows=None, mixed_ends=None)


def test_remainder_belongs_to_the_plant_that_it_was_found_for(tmp_path):
    plant = model(samples=400)
    assert altered(plant, sensor_bound=0.002).remainder is plant.remainder
    assert altered(plant, box=plant.box.copy()).fingerprint == plant.fingerprint
    assert altered(plant, box=[1.0, 1.0], remainder=None).remainder is None
    plant.save(tmp_path / "plant.json")
    twins = LinearPlant.load(tmp_path / "plant.json"), copy.deepcopy(plant), pickle.loads(pickle.dumps(plant))
    for twin in twins:
        assert twin.fingerprint == plant.fingerprint
        with pytest.raises(ValueError, match="another model, limits or operating point"):
            altered(twin, box=[1.0, 1.0])
    remainder = Remainder(Ellipsoid(1e-4 * np.eye(2)), False, "an example")
    anew, wider = altered(plant, remainder=remainder), altered(plant, box=[1.0, 1.0], remainder=remainder)
    assert anew.remainder.sentence == wider.remainder.sentence == remainder.sentence
