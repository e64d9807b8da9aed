"""What an environment is made with stays: its parts rest on each other, and shields on them."""

import inspect
import pickle
from copy import deepcopy
from dataclasses import FrozenInstanceError, fields, is_dataclass

import gymnasium as gym
import pytest

from ncs_gym import Channel, Estimator, FunctionProcess, GymProcess, LinearProcess, NCSEnv, NCSVectorEnv, truck_trailer
from ncs_gym.processes import CartPoleProcess, InvertedPendulumProcess, PendulumProcess
from ncs_gym.processes.process import Process

# What may be set anew, and what is asked for in another form.
FREE = {"self", "render_mode", "downlink_contract"}
OF_VECTORS = ("single", "plant", "channel", "task", "contract", "certificate_contract", "error_set", "downlink")


def env_of(kind):
    settings = {"plant": truck_trailer(), "downlink": Channel(delay=1)}
    return NCSEnv(**settings) if kind is NCSEnv else NCSVectorEnv(2, **settings)


def assert_refused(thing, name):
    before = getattr(thing, name)
    with pytest.raises(AttributeError, match=f"{name} is a setting of {type(thing).__name__} and cannot be changed"):
        setattr(thing, name, before)
    assert getattr(thing, name) is before


@pytest.mark.parametrize("name", sorted(set(inspect.signature(NCSEnv.__init__).parameters) - FREE))
def test_settings_of_an_environment_cannot_be_changed(name):
    assert_refused(env_of(NCSEnv), name)


@pytest.mark.parametrize("name", ["error_set", "estimator", "certificate_contract"])
def test_what_follows_from_settings_cannot_be_changed(name):
    assert_refused(env_of(NCSEnv), name)


@pytest.mark.parametrize("name", [*OF_VECTORS, "max_episode_steps", "autoreset_mode"])
def test_settings_of_a_vector_environment_cannot_be_changed(name):
    assert_refused(env_of(NCSVectorEnv), name)


def test_settings_of_the_environment_inside_a_vector_cannot_be_changed():
    assert_refused(env_of(NCSVectorEnv).single, "initial_set")


@pytest.mark.parametrize("name", ["plant", "channel", "buffer", "error_set"])
def test_settings_of_an_estimator_cannot_be_changed(name):
    assert_refused(Estimator(truck_trailer(), Channel()), name)


def test_settings_stay_read_only_in_copies():
    for env in (env_of(NCSEnv), env_of(NCSVectorEnv)):
        for twin in (deepcopy(env), pickle.loads(pickle.dumps(env))):
            assert_refused(twin, "channel")
            assert twin.plant.fingerprint == env.plant.fingerprint


def test_wrappers_cannot_change_settings():
    env = gym.make("ncs_gym/TruckTrailer-v0")
    with pytest.raises(AttributeError, match="channel is a setting of NCSEnv"):
        env.set_wrapper_attr("channel", Channel(delay=3))


PROCESSES = {
    "linear": LinearProcess(),
    "function": FunctionProcess(lambda x, u: x),
    "gym": GymProcess(lambda: gym.make("Pendulum-v1"), lambda env: env.unwrapped.state),
    "cart-pole": CartPoleProcess(),
    "pendulum": PendulumProcess(),
    "inverted pendulum": InvertedPendulumProcess(),
}


@pytest.mark.parametrize("process", PROCESSES.values(), ids=PROCESSES)
def test_settings_of_a_process_cannot_be_changed(process):
    assert isinstance(process, Process)
    with pytest.raises(FrozenInstanceError):
        process.function = None
    for each in fields(process):
        with pytest.raises(FrozenInstanceError):
            setattr(process, each.name, None)


def test_every_process_is_looked_at_here():
    own = (each for each in Process.__subclasses__() if each.__module__.startswith("ncs_gym."))
    kinds = {each for each in own if is_dataclass(each)}  # the others are what a process opened
    assert kinds == {type(process) for process in PROCESSES.values()}


def test_what_estimators_share_cannot_be_written_to():
    """Shapes in other units, made in place, once changed those of every environment with the same plant."""
    env = gym.make("ncs_gym/CartPole-v0").unwrapped
    many = gym.make_vec("ncs_gym/CartPole-v0", num_envs=3).unwrapped
    for each in (env, many):
        each.reset(seed=0)
        for _ in range(8):
            each.step(0.0 * each.action_space.sample())
    estimator = env.estimator
    for array in (estimator.shape, estimator.mean, many.error_shapes[0].shapes):
        with pytest.raises(ValueError, match="read-only"):
            array *= 1e-4
    estimator.estimate.mean[:] = 0.0  # a copy
    assert estimator.mean.any()
