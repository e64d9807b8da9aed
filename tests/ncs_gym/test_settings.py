"""What is made stays as it was made: settings, their copies and their pickles, and what environments rest on."""

import importlib
import inspect
import pickle
import pkgutil
from copy import copy, deepcopy
from dataclasses import FrozenInstanceError, fields, is_dataclass

import gymnasium as gym
import numpy as np
import pytest

import ncs_gym
from ncs_gym import (
    AdversarialDisturbance,
    BallDisturbance,
    BoxDisturbance,
    Channel,
    ChannelContract,
    Ellipsoid,
    Estimator,
    FamilyProcess,
    FunctionProcess,
    GilbertElliott,
    GymProcess,
    LinearPlant,
    LinearProcess,
    NCSEnv,
    PacketLog,
    Regulation,
    SetpointTracking,
    SinusoidDisturbance,
    SpeedTracking,
    SphereDisturbance,
    TraceChannel,
    batch_reactor,
    certified_error_set,
    truck_trailer,
)
from ncs_gym.processes import CartPoleProcess, InvertedPendulumProcess, PendulumProcess, pendulum
from ncs_gym.registration import TRUCK_TRAILER
from ncs_gym.rendering.episode_record import Annotation
from ncs_gym.uncertainty.disturbances import as_disturbance

ID = "ncs_gym/TruckTrailerCruise-v0"
DOWNLINK = {"downlink": Channel(delay=1), "downlink_contract": ChannelContract(2)}
PLANT, ERRORS = pendulum(), certified_error_set(batch_reactor(), ChannelContract(3))
FAMILY = LinearPlant.family(truck_trailer, {"mass": (3800.0, 4200.0)}, monotone=True)
SETTINGS = [
    PLANT,
    PLANT.remainder,
    FAMILY,
    FAMILY.remainder.family,
    PLANT.disturbance,
    truck_trailer().process_noise,
    ERRORS,
    certified_error_set(truck_trailer()),
    Channel(loss=GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.5)),
    GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.5),
    TraceChannel(trace=(0, -1)),
    ChannelContract(3),
    NCSEnv(truck_trailer(), **DOWNLINK).downlink_protocol,
    PacketLog(np.arange(3.0), np.ones(3)),
    TRUCK_TRAILER,
    Regulation(state_cost=np.eye(2)),
    SpeedTracking(),
    SetpointTracking(output=[1.0, 0.0], reach=0.5, width=1.0),
    BallDisturbance(),
    SphereDisturbance(),
    BoxDisturbance([0.1, 0.2]),
    SinusoidDisturbance(),
    AdversarialDisturbance(np.eye(2)),
    as_disturbance(np.add, truck_trailer(), False),
    LinearProcess(),
    FamilyProcess(),
    FunctionProcess(np.add),
    GymProcess(gym.make, np.asarray),
    CartPoleProcess(),
    PendulumProcess(),
    InvertedPendulumProcess(),
]
PASSING = {Annotation}  # made anew for every frame


def assert_same(one, other):
    """Both are of the same kind with the same values."""
    assert type(one) is type(other)
    if is_dataclass(one):
        for each in fields(one):
            assert_same(getattr(one, each.name), getattr(other, each.name))
    else:
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("made", SETTINGS, ids=lambda made: type(made).__name__)
def test_settings_and_their_copies_are_equal_and_read_only(made):
    for twin in (made, copy(made), deepcopy(made), pickle.loads(pickle.dumps(made))):
        assert_same(twin, made)
        for name in (*(each.name for each in fields(twin)), "something_else"):
            with pytest.raises(FrozenInstanceError):
                setattr(twin, name, None)
            if isinstance(value := getattr(twin, name, None), np.ndarray):
                with pytest.raises(ValueError, match="read-only"):
                    value[...] = 7.0


def test_every_kind_of_setting_is_looked_at_here():
    modules = [importlib.import_module(each.name) for each in pkgutil.walk_packages(ncs_gym.__path__, "ncs_gym.")]
    own = [each for module in modules for each in vars(module).values() if inspect.isclass(each) and is_dataclass(each)]
    assert {each for each in own if each.__module__.startswith("ncs_gym.")} == {*map(type, SETTINGS), *PASSING}


def test_settings_do_not_share_memory_with_what_they_were_made_from():
    shape = np.eye(2)
    ellipsoid = Ellipsoid(shape)
    shape[0, 0] = 5.0
    assert ellipsoid.shape_matrix[0, 0] == 1.0


def test_derived_bounds_survive_pickling_read_only():
    plant = truck_trailer()
    twin = pickle.loads(pickle.dumps(plant))
    assert_same(twin.disturbance, plant.disturbance)
    assert not twin.disturbance.shape_matrix.flags.writeable
    assert twin.fingerprint == plant.fingerprint


FREE = {"self", "render_mode"}  # what may be set anew
FOLLOWING = {"error_set", "certificate_contract"}  # what follows from what an environment is made with
KINDS = {
    "gym.make(id, channel=...)": (lambda: gym.make(ID, **DOWNLINK).unwrapped, FOLLOWING | {"estimator"}),
    "gym.make_vec(id, num_envs, channel=...)": (
        lambda: gym.make_vec(ID, num_envs=2, **DOWNLINK),
        FOLLOWING | {"single", "max_episode_steps", "autoreset_mode"},
    ),
}


@pytest.mark.parametrize("way", KINDS)
def test_setting_of_an_environment_is_read_and_setting_it_says_how_to_make_another(way):
    make, more = KINDS[way]
    env = make()
    for each in (env, deepcopy(env), pickle.loads(pickle.dumps(env))):
        kind = type(each).__name__
        one = each if isinstance(each, NCSEnv) else each.single
        for name in {*inspect.signature(NCSEnv.__init__).parameters} - FREE | more:
            value = getattr(each, name)
            sentence = f"{name} is a setting of {kind} and cannot be changed: make another {kind} with it, as in {way}"
            if name in ("channel", "downlink"):
                options = f'reset(options={{"{name}": ...}})'
                sentence += f"; episodes get other ones by RandomChannel, a single one by {options}"
            with pytest.raises(AttributeError) as refused:
                setattr(each, name, value)
            assert str(refused.value) == sentence
            assert getattr(each, name) is value
            assert name in more or getattr(one, name) is value
        assert each.plant.fingerprint == env.plant.fingerprint
    with pytest.raises(AttributeError, match="initial_set is a setting of NCSEnv"):
        one.initial_set = None


@pytest.mark.parametrize("make", [lambda: gym.make(ID), lambda: gym.make_vec(ID, num_envs=2)], ids=["one", "many"])
def test_the_state_is_read_and_whoever_sets_it_is_told_how(make):
    env = make()
    _, info = env.reset(seed=0)
    inner, before = env.unwrapped, info["state"].copy()
    np.testing.assert_array_equal(inner.state, before)
    inner.state[:] = 7.0  # a copy
    with pytest.raises(AttributeError, match=r'env\.reset\(options=\{"state": x\}\)'):
        inner.state = before + 1.0
    np.testing.assert_array_equal(inner.state, before)


def test_settings_of_an_estimator_and_those_behind_wrappers_cannot_be_changed():
    estimator, env = Estimator(truck_trailer(), Channel()), gym.make(ID)
    for name in ("plant", "channel", "buffer", "error_set"):
        with pytest.raises(AttributeError, match=f"{name} is a setting of Estimator and cannot be changed"):
            setattr(estimator, name, None)
    with pytest.raises(AttributeError, match="channel is a setting of NCSEnv"):
        env.set_wrapper_attr("channel", Channel(delay=3))


@pytest.mark.parametrize("way", KINDS)
def test_contract_of_the_downlink_is_the_one_given_or_what_its_settings_guarantee(way):
    env = KINDS[way][0]()
    assert env.downlink_contract == ChannelContract(2)
    assert NCSEnv(env.plant, downlink=Channel(delay=1)).downlink_contract == ChannelContract(1)
    assert NCSEnv(env.plant).downlink_contract is None


def test_what_estimators_share_cannot_be_written_to():
    """Shapes in other units, made in place, once changed those of every environment with the same plant."""
    estimator = Estimator(batch_reactor(), Channel(), ERRORS)
    estimator.advance(np.zeros(2), [])
    for array in (estimator.shape, estimator.mean):
        with pytest.raises(ValueError, match="read-only"):
            array *= 1e-4
    kept = estimator.mean.copy()
    estimator.estimate.mean[:] = 7.0  # a copy
    np.testing.assert_array_equal(estimator.mean, kept)
    many = gym.make_vec("ncs_gym/CartPole-v0", num_envs=3).unwrapped
    many.reset(seed=0)
    with pytest.raises(ValueError, match="read-only"):
        many.known.table.shapes[...] = 1e-4
