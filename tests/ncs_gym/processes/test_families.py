"""Environments of a plant that varies: a member of its family moves in every episode."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.linalg import expm

from ncs_gym import Channel, RandomChannel
from ncs_gym import truck_trailer as truck
from ncs_gym.processes.process import FamilyProcess, LinearProcess, own_process
from tests.plants import varying_truck
from tests.product import family_of, gym_env, library_plant, loop_env, vector_env

QUIET = {"gamma": 0.0, "process_noise_cov": np.zeros((2, 2))}


def quiet_truck(mass=4000.0, stiffness=4500.0):
    return library_plant(truck, mass, stiffness, **QUIET)


RANGES = {"mass": (3800.0, 4200.0), "stiffness": (4300.0, 4700.0)}
FAMILY = family_of(quiet_truck, RANGES, monotone=True)
NOISY = varying_truck()
TRUCKS = family_of([truck(mass) for mass in (3800.0, 4000.0, 4200.0)])
CRUISE = "ncs_gym/TruckTrailerCruise-v0"


def moved(parameters, x, u):
    """One step of the truck by another route: a matrix exponential of scipy."""
    mass, stiffness = parameters
    model = np.array([[0.0, 1.0, 0.0], [-stiffness / mass, -4600.0 / mass, 1.0], [0.0, 0.0, 0.0]])
    return (expm(0.5 * model) @ np.array([*x, *u]))[:2]


def test_an_episode_moves_by_one_member_and_the_bound_is_not_drawn():
    env, seen = loop_env(FAMILY), []
    for episode in range(20):
        _, info = env.reset(seed=3 if episode == 0 else None)
        seen.append(info["parameters"])
        for _ in range(5):
            before, action = info["state"], env.action_space.sample()
            *_, info = env.step(action)
            np.testing.assert_allclose(info["state"], moved(seen[-1], before, info["input"]), rtol=1e-12)
            np.testing.assert_array_equal(info["parameters"], seen[-1])
            assert not info["assumption_violated"]
    low, high = np.transpose([*RANGES.values()])
    assert (np.array(seen) >= low).all()
    assert (np.array(seen) <= high).all()
    assert (np.std(seen, axis=0) > 0.2 * (high - low)).all()
    np.testing.assert_array_equal(env.reset(seed=3)[1]["parameters"], seen[0])


def test_parameters_that_infos_have_are_options_again():
    for plant in (FAMILY, TRUCKS):
        env, envs = loop_env(plant), vector_env(3, plant=plant)
        for each in (env, envs):
            met = each.reset(seed=1)[1]["parameters"]
            again = each.reset(seed=2, options={"parameters": met})[1]["parameters"]
            np.testing.assert_array_equal(again, met)
        with pytest.raises(ValueError, match=r"must be a dictionary of \['.*\], or all of them, got"):
            env.reset(options={"parameters": np.ones(len(plant.members.names) + 1)})
        with pytest.raises(ValueError, match="or all of them, got"):
            envs.reset(options={"parameters": np.ones((2, len(plant.members.names)))})


def test_options_fix_some_parameters_or_all():
    env = loop_env(FAMILY)
    _, info = env.reset(seed=0, options={"parameters": {"stiffness": 4400.0}})
    assert info["parameters"][1] == 4400.0
    assert info["parameters"][0] != env.reset(options={"parameters": {"stiffness": 4400.0}})[1]["parameters"][0]
    _, info = env.reset(options={"parameters": {"mass": 3800, "stiffness": 4700}})
    np.testing.assert_array_equal(info["parameters"], [3800.0, 4700.0])
    info["parameters"][:] = 0.0  # an array of the caller's own
    np.testing.assert_array_equal(env.step(np.zeros(1, np.float32))[4]["parameters"], [3800.0, 4700.0])
    outer = RandomChannel(gym.make(CRUISE, plant=TRUCKS), [Channel(), Channel(delay=1)])
    assert outer.reset(options={"parameters": {"member": 2}})[1]["parameters"] == [2.0]


def test_other_plants_have_no_parameters():
    for given in ({"plant": truck()}, {"plant": FAMILY, "process": LinearProcess()}):
        env = loop_env(**given)
        assert "parameters" not in env.reset(seed=0)[1]
        with pytest.raises(ValueError, match="the plant of a family"):
            env.reset(options={"parameters": {}})
    with pytest.raises(ValueError, match="FamilyProcess is for the plant of a family"):
        loop_env(truck(), process=FamilyProcess())
    assert isinstance(own_process(truck()), LinearProcess)
    assert isinstance(loop_env(FAMILY).process, FamilyProcess)


def test_a_parameter_beyond_its_range_is_seen_where_the_step_leaves_the_bound():
    settings = {"plant": FAMILY, "allow_assumption_violation": True}
    for mass, is_seen in ((4200.0, False), (5000.0, True)):
        env, envs = loop_env(**settings), vector_env(2, **settings)
        env.reset(seed=0, options={"parameters": {"mass": mass}})
        envs.reset(seed=0, options={"parameters": {"mass": [4000.0, mass]}})
        for number in range(12):
            action = np.full(1, (-1.0) ** (number // 3), np.float32)
            *_, info = env.step(action)
            *_, infos = envs.step(np.tile(action, (2, 1)))
        assert info["assumption_violated"] == is_seen
        assert infos["assumption_violated"].tolist() == [False, is_seen]
        assert not env.reset()[1]["assumption_violated"]


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_environments_of_a_vector_have_members_of_their_own(mode):
    envs = vector_env(4, plant=FAMILY, max_episode_steps=3, autoreset_mode=mode)
    _, infos = envs.reset(seed=0, options={"parameters": {"mass": [3800, 3900, 4000, 4100], "stiffness": 4500.0}})
    first = infos["parameters"]
    np.testing.assert_array_equal(first, [[mass, 4500.0] for mass in (3800.0, 3900.0, 4000.0, 4100.0)])
    for _ in range(3):
        before = infos["state"]
        *_, infos = envs.step(np.ones((4, 1), np.float32))
        told = infos.get("final_info", infos)
        for e in range(4):
            np.testing.assert_allclose(told["state"][e], moved(first[e], before[e], [4.0]), rtol=1e-12)
        np.testing.assert_array_equal(told["parameters"], first)
    if mode == "Disabled":
        mask = np.array([True, False, True, False])
        _, infos = envs.reset(options={"reset_mask": mask, "parameters": {"mass": 4200.0}})
        np.testing.assert_array_equal(infos["parameters"][:, 0], [4200.0, 3900.0, 4200.0, 4100.0])
    else:
        assert len({*infos["parameters"][:, 0], *first[:, 0]}) == 8


def test_specs_hold_plants_that_are_listed_as_json_and_functions_as_they_are():
    env = gym.make(CRUISE, plant=TRUCKS)
    env.spec.to_json()
    again = gym.make(env.spec)
    np.testing.assert_array_equal(env.reset(seed=1)[1]["parameters"], again.reset(seed=1)[1]["parameters"])
    env = gym.make(CRUISE, plant=NOISY)
    assert gym.make(env.spec).unwrapped.plant is NOISY
    process = {"type": "FamilyProcess"}
    assert isinstance(gym_env(plant=TRUCKS, process=process).unwrapped.process, FamilyProcess)
