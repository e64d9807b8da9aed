"""The docstrings of environment and shield describe every key of `info`; docs/ncs_gym.md names each once.

What is told in a step belongs to whoever is told.
"""

import copy
import inspect
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from agents import SB3VecEnv
from ncs_gym import (
    Channel,
    NCSEnv,
    Networked,
    RandomChannel,
    VectorNetworked,
    VectorRandomChannel,
)
from ncs_gym.registration import registered_ids
from shields import SafetyShield
from tests.certificates import certificate_of
from tests.ncs_gym.networked.environments import Counter
from tests.product import gym_env, gym_vector_env, linear_plant, safety_shield, vector_shield

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "ncs_gym.md").read_text()
ENVIRONMENTS = ("ncs_gym/TruckTrailerCruise-v0", "ncs_gym/BatchReactor-v0", "ncs_gym/TruckTrailerCruiseTwoWay-v0")
TYPES = {"float": float, "int": (int, np.integer), "bool": (bool, np.bool_), "str": str}
NUMBER = 5


def rows(text):
    """Cells of the rows of the tables of keys in a text; the key comes first."""
    tables = re.findall(r"^\| key \|.*\n\|[-|]+\n((?:\|.*\n)+)", text, re.MULTILINE)
    return [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in "".join(tables).splitlines()]


# Where an environment has a key that not all have.
HAVING = {
    "downlink": lambda env: env.downlink is not None,
    "on request": lambda env: env.channel.on_request,
    "more limits": lambda env: env.loop.limits_the_way,
    "family": lambda env: env.plant.remainder is not None and env.plant.remainder.family is not None,
}


def kinds(mode, env=None):
    """Shape or type of every key that an environment is said to have, behind a shield of a mode or without one."""
    authors = (NCSEnv,) if mode is None else (NCSEnv, SafetyShield)
    described = [row for author in authors for row in rows(inspect.getdoc(author))]
    listed = {
        key.strip("`"): kind.strip("`")
        for key, kind, _, _, *where in described
        if env is None or all(HAVING[each](env.unwrapped) for each in where)
    }
    missing = {"shield_plan_length"} if mode != "lookahead" else set()
    return {key: kind for key, kind in listed.items() if key not in missing}


def infos(env, steps, share=0.1):
    """What reset and the steps of an environment report."""
    action = share * env.action_space.high
    return [env.reset(seed=0)[1], *(env.step(action)[-1] for _ in range(steps))]


def assert_is(key, value, kind, plant):
    """A value has the shape or the type that the docstring says."""
    if kind in TYPES:
        assert isinstance(value, TYPES[kind])
    else:
        sizes = {"n": plant.n, "m": plant.m, "k": len(plant.box)}
        assert value.shape == tuple(sizes[size] for size in re.findall("[nmk]", kind))
        assert value.dtype == (np.float32 if key.startswith("action_") else np.float64)


@pytest.fixture(params=ENVIRONMENTS)
def loop(request):
    """An id, and the certificate of its plant."""
    env = gym.make(request.param).unwrapped
    assert isinstance(env, NCSEnv)
    return request.param, certificate_of(env.plant, env.certificate_contract)


def test_page_names_every_key_once():
    table = re.search(r"^\| about \| keys \|\n\|[-|]+\n((?:\|.*\n)+)", PAGE, re.MULTILINE)[1]
    named = re.findall(r"`(\w+)`", table)
    assert len(named) > 20
    assert sorted(named) == sorted(kinds("lookahead"))


@pytest.mark.cases(3)
@pytest.mark.parametrize("mode", [None, "project", "monitor", "lookahead"])
def test_docstrings_have_every_key_of_one_environment_and_of_many(loop, mode):
    env_id, certificate = loop
    env, envs = gym.make(env_id), gym.make_vec(env_id, num_envs=NUMBER)
    if mode is not None:
        env, envs = safety_shield(env, certificate, mode), vector_shield(envs, certificate, mode)
    expected = kinds(mode, env)
    for info in infos(env, 4):
        assert set(info) == set(expected)
        for key, kind in expected.items():
            assert_is(key, info[key], kind, env.unwrapped.plant)
        if env.unwrapped.downlink is None:  # else the estimate is that of a later state
            np.testing.assert_array_equal(info["estimation_error"], info["estimate"] - info["state"])
    for info in infos(envs, 4):
        assert set(info) == set(expected)
        for key, kind in expected.items():
            assert isinstance(info[key], np.ndarray)
            assert len(info[key]) == NUMBER
            assert_is(key, info[key][0], kind, envs.unwrapped.plant)


TWO_ENDED = linear_plant(
    A=[[0.9, 0.1], [0.0, 0.8]],
    B=[[0.0], [0.3]],
    state_limits=(-1.0, 1.0),
    input_limits=(-2.0, 1.0),
    dt=0.1,
    disturbance_bound=0.02,
    sensor_bound=0.01,
    initial_bound=0.01,
)


@pytest.mark.parametrize("settings", [{"env_id": ENVIRONMENTS[2]}, {"plant": TWO_ENDED, "disturbance": "box"}])
def test_actions_of_infos_are_those_that_stand_for_the_inputs(settings):
    env, envs = safety_shield(gym_env(**settings)), vector_shield(gym_vector_env(3, **settings))
    plant, reported = env.unwrapped.plant, [*infos(env, 30, share=1.0), *infos(envs, 30, share=1.0)]
    low, high = plant.input_ends
    for info in reported:
        for name in ("applied", "committed"):
            inputs = info["input"] if name == "applied" else info.get("input_committed", info["input"])
            np.testing.assert_allclose(info[f"action_{name}"], (2.0 * inputs - low - high) / (high - low), atol=2e-7)
    overridden = [info for info in reported if np.any(info["shield_intervened"])]
    assert len(overridden) > 10
    assert all(np.abs(info["action_committed"]).min() < 1.0 for info in overridden)


def spoil(told):
    """Writes into everything that somebody was told and can write into."""
    if isinstance(told, np.ndarray) and told.dtype != object:
        if told.flags.writeable:
            told[...] = 1
    elif isinstance(told, dict):
        for value in told.values():
            spoil(value)
        told.clear()
    elif isinstance(told, (tuple, list, np.ndarray)):
        for value in told:
            spoil(value)


def assert_equal(told, other):
    """Two nests of dictionaries, sequences and arrays hold the same."""
    if isinstance(told, dict):
        assert told.keys() == other.keys()
        told, other = (tuple(each[key] for key in told if key != "t") for each in (told, other))  # seconds
    if isinstance(told, (tuple, list)) or getattr(told, "dtype", None) == np.dtype(object):
        for one, another in zip(told, other, strict=True):
            assert_equal(one, another)
    else:
        np.testing.assert_array_equal(told, other)


def begun(env):
    """What an environment tells of its first episodes; one of stable-baselines3 is seeded beforehand."""
    if not isinstance(env, SB3VecEnv):
        return env.reset(seed=0)
    env.seed(0)
    return env.reset(), env.reset_infos, env.batch_info


def assert_tells_what_is_the_listeners_own(make):
    """Two environments go alike, although everything that one of them tells is written over."""
    kept, spoiled = make(), make()
    kept.action_space.seed(0)
    told = [begun(env) for env in (kept, spoiled)]
    for _ in range(8):
        assert_equal(*told)
        told[0] = copy.deepcopy(told[0])
        spoil(told[1])
        action = kept.action_space.sample()
        if isinstance(kept, SB3VecEnv):
            action = np.repeat(action[None], kept.num_envs, axis=0)
        told = [env.step(copy.deepcopy(action)) for env in (kept, spoiled)]
        if isinstance(kept, gym.Env) and any(told[0][2:4]):
            assert_equal(*told)
            told = [begun(env) for env in (kept, spoiled)]


VECTORS = ["NextStep", "SameStep"]
FEW = {"num_envs": 3, "max_episode_steps": 5}


@pytest.mark.cases(2)
@pytest.mark.parametrize("env_id", registered_ids())
def test_nobody_changes_an_environment_by_writing_into_what_it_told(env_id):
    assert_tells_what_is_the_listeners_own(lambda: gym.make(env_id))
    for mode in VECTORS:
        assert_tells_what_is_the_listeners_own(lambda mode=mode: gym.make_vec(env_id, autoreset_mode=mode, **FEW))


@pytest.mark.cases(2)
@pytest.mark.parametrize("mode", ["project", pytest.param("monitor", marks=pytest.mark.slow), "lookahead"])
def test_nobody_changes_a_shield_by_writing_into_what_it_told(loop, mode):
    env_id, certificate = loop
    assert_tells_what_is_the_listeners_own(lambda: safety_shield(gym.make(env_id), certificate, mode))

    def many(reset):
        return vector_shield(gym.make_vec(env_id, autoreset_mode=reset, **FEW), certificate, mode)

    for reset in VECTORS:
        assert_tells_what_is_the_listeners_own(lambda reset=reset: many(reset))
        assert_tells_what_is_the_listeners_own(lambda reset=reset: SB3VecEnv(many(reset)))


def counters(mode, kind):
    """Three environments of which each tells what nobody else has."""
    return SyncVectorEnv([lambda: Counter(kind, length=5)] * 3, autoreset_mode=AutoresetMode(mode))


LATE = Channel(loss=0.3, delay=1)
CHANNELS = {"vector": LATE, "dict": {"count": LATE, "odd": Channel(loss=0.3)}, "buffers": LATE}
NETWORK = {"downlink": Channel(delay=1), "observe": ("age", "arrived", "pending_actions")}


@pytest.mark.cases(3)
@pytest.mark.parametrize("kind", CHANNELS)
@pytest.mark.parametrize("network", [{}, NETWORK])
def test_nobody_changes_a_network_by_writing_into_what_it_told(kind, network):
    channel = CHANNELS[kind]
    assert_tells_what_is_the_listeners_own(lambda: Networked(Counter(kind), channel, **network))
    assert_tells_what_is_the_listeners_own(lambda: RandomChannel(Networked(Counter(kind), channel, **network), [LATE]))
    for mode in VECTORS if kind == "vector" else ():
        assert_tells_what_is_the_listeners_own(
            lambda mode=mode: VectorNetworked(counters(mode, kind), channel, **network)
        )
        assert_tells_what_is_the_listeners_own(
            lambda mode=mode: VectorRandomChannel(VectorNetworked(counters(mode, kind), channel, **network), [LATE])
        )
