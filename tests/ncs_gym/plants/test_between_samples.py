"""Times between samples: rows of a grid, the bound of what is between its points, and what environments report."""

from __future__ import annotations

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from ncs_gym import LinearPlant, cart_pole, truck_trailer
from ncs_gym.plants.library import batch_reactor
from tests.product import altered, sampled_plant
from tests.second_verifier.between_samples import row_conditions

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
PLANTS = {
    "truck-trailer": lambda: truck_trailer(mass=4000.0),
    "cart-pole": cart_pole,
    "reactor": batch_reactor,
}


def exponentials(plant, times):
    """[A_tau, B_tau] by scipy, shape (len(times), n, n + m)."""
    n, m = plant.n, plant.m
    G = np.concatenate([plant.model.continuous, np.zeros((m, n + m))])
    return np.array([expm(G * time)[:n] for time in times])


def random_model(seed, n, m, k):
    """A plant of a random model in continuous time, with k oblique rows of the box besides the axes."""
    rng = np.random.default_rng(seed)
    rows = np.concatenate([np.eye(n) * rng.uniform(0.3, 3.0, n), rng.standard_normal((k, n))])
    model = (2.0 * rng.standard_normal((n, n)), rng.standard_normal((n, m)), np.eye(n), np.zeros((n, m)))
    bounds = {"disturbance_bound": 1e-3, "sensor_bound": 1e-3, "initial_bound": 1e-3}
    return sampled_plant(model, 0.2, box=rows, u_max=rng.uniform(0.2, 5.0, m), between_samples=5, **bounds)


@pytest.mark.parametrize("name", PLANTS)
def test_rows_are_those_of_the_model_with_ends_that_are_closer(name):
    plant = altered(PLANTS[name](), between_samples=6)
    rows, k = plant.step_rows.reshape(5, len(plant.box), -1), len(plant.box)
    assert not any(array.flags.writeable for array in (plant.kept_ends, plant.step_rows, plant.step_ends))
    true = plant.box @ exponentials(plant, plant.dt * np.arange(1, 6) / 6)
    np.testing.assert_allclose(rows, true, rtol=1e-11, atol=1e-13)
    np.testing.assert_array_equal(plant.step_ends, np.tile(plant.kept_ends, 5))
    assert (plant.kept_ends[0] > plant.box_ends[0]).all()
    assert (plant.kept_ends[1] < plant.box_ends[1]).all()
    assert all(condition.holds for condition in row_conditions(plant))
    assert len(list(row_conditions(plant))) == 1 + 2 * k


def test_rows_of_boxes_with_one_end_two_ends_and_more_rows_than_states_are_right():
    model = [[0.0, 1.0], [-4.0, -1.0]], [[0.0], [4.0]], np.eye(2), np.zeros((2, 1))
    ends = {"state_limits": ([-1.2, -3.0], [0.9, 2.0]), "input_limits": (-1.0, 2.0)}
    rows = [([1.0, 0.0], -0.8, 0.8), ([1.0, 2.0], -3.0, 2.0), ([1.0, -0.5], -1.0, np.inf)]
    bounds = {"disturbance_bound": 0.01, "sensor_bound": 0.01, "initial_bound": 0.01}
    plant = sampled_plant(model, 0.1, output_limits=rows, between_samples=5, **ends, **bounds)
    assert plant.kept_ends[1, -1] == np.inf
    conditions = list(row_conditions(plant))
    assert len(conditions) == 1 + 2 * len(plant.box)
    assert all(condition.holds for condition in conditions)


def test_limits_of_which_nothing_is_left_are_refused():
    model = [[0.0, 1.0], [-900.0, -6.0]], [[0.0], [900.0]], np.eye(2), np.zeros((2, 1))
    bounds = {"disturbance_bound": 0.01, "sensor_bound": 0.01, "initial_bound": 0.01}
    with pytest.raises(ValueError, match=r"leaves nothing of row 1 of the box: .* more of them, a shorter dt or less"):
        sampled_plant(model, 0.1, box=[1.0, 45.0], u_max=1.0, between_samples=2, **bounds)


OTHER_ROWS = {
    "ends of samples": lambda p: {"kept_ends": p.box_ends + 0.95 * (p.kept_ends - p.box_ends)},
    "ends within": lambda p: {"step_ends": 1.01 * p.step_ends},
    "a row": lambda p: {"step_rows": p.step_rows * np.where(np.arange(len(p.step_rows)) == 3, 0.98, 1.0)[:, None]},
    "rows on inputs": lambda p: {"step_rows": np.hstack([p.step_rows[:, : p.n], -p.step_rows[:, p.n :]])},
    "a time left out": lambda p: {name: getattr(p, name)[..., : -len(p.box), :] for name in ("step_rows",)},
    "a time twice": lambda p: {"step_rows": np.roll(p.step_rows, len(p.box), axis=0)},
}


@pytest.mark.parametrize("change", OTHER_ROWS.values(), ids=OTHER_ROWS)
def test_oracle_of_rows_notices_others(change):
    plant = altered(truck_trailer(mass=4000.0), between_samples=6)
    changed = change(plant)
    if "kept_ends" in changed:
        changed["step_ends"] = np.tile(changed["kept_ends"], 5)
    for name, value in changed.items():
        object.__setattr__(plant, name, value)
    assert not all(condition.holds for condition in row_conditions(plant))
    assert plant.digest() != altered(truck_trailer(mass=4000.0), between_samples=6).fingerprint


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 2), st.integers(0, 3))
def test_nothing_between_grid_points_is_larger_than_at_them_by_more_than_the_bound(seed, n, m, k):
    plant = random_model(seed, n, m, k)
    rng, points, fine = np.random.default_rng(seed), 5, 20
    x = rng.standard_normal((400, n))
    x /= np.abs(x @ plant.box.T).max(axis=1)[:, None]
    joint = np.concatenate([x, rng.choice([-1.0, 1.0], (400, m)) * plant.largest_input], axis=1)
    moved = exponentials(plant, plant.dt * np.arange(points * fine + 1) / (points * fine))
    values = np.abs(plant.box @ moved @ joint.T)
    ends = np.repeat(np.maximum(values[:-fine:fine], values[fine::fine]), fine, axis=0)
    excess = (values[:-1] - ends).max(axis=(0, 2))
    rho = np.sqrt(np.diag(plant.box @ plant.disturbance.shape_matrix @ plant.box.T))
    assert (excess + rho <= plant.box_ends[1] - plant.kept_ends[1]).all()
    assert all(condition.holds for condition in row_conditions(plant))


def test_bound_that_is_out_of_reach_says_so():
    angles = np.linspace(0.0, np.pi, 4, endpoint=False)
    model = ([[0.0, 1.0], [-1e7, -2.0]], [[0.0], [2.0]], np.eye(2), np.zeros((2, 1)))
    bounds = {"disturbance_bound": 1e-3, "sensor_bound": 1e-3, "initial_bound": 1e-3}
    box = np.c_[np.cos(angles), np.sin(angles) / 2]
    with pytest.raises(ValueError, match="the bound between samples is out of reach of float64: a shorter dt or"):
        sampled_plant(model, 0.1, box=box, u_max=1.0, between_samples=64, **bounds)


def fine_values(plant, x, u, x_next):
    """Values of the rows at the grid points after the first, of a step from x to x_next, by scipy, (N, k)."""
    points = plant.between_samples
    shares = np.arange(1, points + 1) / points
    d = x_next - plant.A @ x - plant.B @ u
    states = exponentials(plant, plant.dt * shares) @ np.concatenate([x, u]) + shares[:, None] * d
    return np.abs(states @ plant.box.T) - 1.0


def test_environment_reports_the_worst_value_of_a_step_and_counts_it():
    plant = altered(truck_trailer(mass=4000.0), between_samples=8)
    env = gym.make(CRUISE, plant=plant, disturbance="sphere")
    rng, between_alone, total = np.random.default_rng(0), 0, 0.0
    for episode in range(6):
        _, info = env.reset(seed=episode)
        np.testing.assert_array_equal(info["worst_constraint_values"], info["constraint_values"])
        for k in range(60):
            before, total = info, info["episode_violations"]
            *_, info = env.step(np.float32(rng.choice([-1.0, 1.0], 1) if k % 3 == 0 else rng.uniform(-1.0, 1.0, 1)))
            worst = fine_values(plant, before["state"], info["input"], info["state"]).max(axis=0)
            np.testing.assert_allclose(info["worst_constraint_values"], worst, atol=1e-11)
            assert (info["worst_constraint_values"] >= info["constraint_values"]).all()
            assert info["cost"] == float(info["worst_constraint_values"].max() > 0.0)
            assert info["episode_violations"] == total + info["cost"]
            inside = max(before["constraint_values"].max(), info["constraint_values"].max()) <= 0.0
            between_alone += inside and info["cost"] == 1.0
    assert between_alone  # the box was left between two samples that are inside


def test_once_per_step_is_at_the_sampling_instants_alone():
    assert not len(truck_trailer().step_rows)
    plant = altered(truck_trailer(), between_samples=8)
    assert "at all times, at 8 of each step" in " ".join(str(plant).split())
    assert "at all times" not in str(truck_trailer())
    assert altered(plant, between_samples=1).between_samples is None


@pytest.mark.parametrize("make", [gym.make, lambda env_id, **settings: gym.make_vec(env_id, num_envs=2, **settings)])
def test_registered_environments_count_between_samples_if_they_are_told_so(make):
    env = make("ncs_gym/CSTR-v0", between_samples=4).unwrapped
    own = altered(make("ncs_gym/CSTR-v0").unwrapped.plant, between_samples=4)
    assert env.plant.fingerprint == own.fingerprint
    assert env.contract == make("ncs_gym/CSTR-v0").unwrapped.contract
    assert make("ncs_gym/CSTR-v0", between_samples=1).unwrapped.plant.between_samples is None


PUSHED = {"box": [1.0, 2.0], "u_max": 1.0, "sensor_bound": 0.01, "initial_bound": 0.01}
OSCILLATOR = ([[0.0, 1.0], [-1.0, 0.0]], [[0.0], [1.0]], np.eye(2), np.zeros((2, 1)))


def pushed(**more):
    """An oscillator pushed to one side within each step, at rest under the middle of that."""
    bound = {"disturbance_bound": ([[0.0], [0.6]], [0.0], [1.0])}
    return sampled_plant(OSCILLATOR, dt=1.5, **PUSHED | bound | more)


def held(**more):
    """The same with a constant of its model in absolute coordinates."""
    A = exponentials(pushed(), [1.5])[0][:, :2]
    point = np.linalg.solve(np.eye(2) - A, [0.0, 0.3])
    bound = {"disturbance_bound": 0.05, "offset": [0.0, 0.3], "operating_state": point, "operating_input": 0.0}
    return sampled_plant(OSCILLATOR, dt=1.5, **PUSHED | {"box": [2.0, 3.0]} | bound | more)


@pytest.mark.filterwarnings("ignore::ncs_gym.limits.MovedOperatingPointWarning")
def test_constant_disturbance_is_refused_beside_between_samples_also_where_two_cancel_at_the_samples():
    both = {"disturbance_bound": ([[0.0, 0.0], [0.6, -0.6]], [0.0, 0.0], [1.0, 1.0])}
    cancel = {"disturbance_bound": ([[0.0], [0.6]], [-1.0], [0.0])}
    for plant in (pushed(), held(), pushed(**both), held(**cancel)):
        assert plant.step_offset[1] > 0.29
        document = plant.document
        edited = document | {"limits": document["limits"] | {"between_samples": 8}}
        for entrance in (lambda plant=plant: altered(plant, between_samples=8), partial(LinearPlant.load, edited)):
            with pytest.raises(ValueError, match=r"without .* constant disturbance"):
                entrance()
        assert LinearPlant.load(document).fingerprint == plant.fingerprint


def test_model_in_continuous_time_is_the_one_that_was_sampled():
    plant = truck_trailer()
    for change in ({"A": 0.9 * plant.A}, {"dt": 1.0}, {"continuous_model": 1.1 * plant.model.continuous}):
        with pytest.raises(ValueError, match="what A and B were sampled from"):
            altered(plant, **change)
    assert altered(plant, A=0.9 * plant.A, continuous_model=None).model.continuous is None


def test_violation_between_samples_ends_an_episode_if_violations_do():
    plant = altered(truck_trailer(mass=4000.0), between_samples=8)
    env = gym.make(CRUISE, plant=plant, terminate_on_violation=True)
    for seed in range(5):
        env.reset(seed=seed)
        terminated = False
        for k in range(100):
            *_, terminated, _, info = env.step(np.array([(-1.0) ** (k // 3)], np.float32))
            assert terminated == (info["cost"] > 0.0)
            if terminated:
                break
        assert terminated
