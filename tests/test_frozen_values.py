"""What is made stays as it was made, in copies, pickles and threads: one test for all public values."""

import importlib
import inspect
import pickle
import pkgutil
from concurrent.futures import ThreadPoolExecutor
from copy import copy, deepcopy
from dataclasses import FrozenInstanceError, fields, is_dataclass
from functools import cache

import gymnasium as gym
import numpy as np
import pytest

import ncs_gym
import shields
from ncs_gym.disturbances import BallDisturbance, SphereDisturbance, as_disturbance
from ncs_gym.envs.loop import Loop
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.plants.library import batch_reactor
from ncs_gym.processes.cart_pole_process import CartPoleProcess
from ncs_gym.processes.gym_pendulum import PendulumProcess, pendulum
from ncs_gym.processes.mujoco_pendulum import InvertedPendulumProcess
from ncs_gym.processes.process import FamilyProcess, LinearProcess
from ncs_gym.registration import TRUCK_TRAILER
from ncs_gym.rendering.episode_record import Annotation
from ncs_gym.validation import ReadOnlyArrays
from shields import setpoint_range
from shields.export.board_table import BoardTable
from shields.paper import PaperCertificate
from tests.certificates import certificate_of
from tests.plants import varying_truck
from tests.product import loop_env, safety_filter

DOWNLINK = {"downlink": ncs_gym.Channel(delay=1), "downlink_contract": ncs_gym.ChannelContract(2)}
PASSING = {Annotation}  # made anew for every frame


@cache
def values():
    """One of every kind."""
    plant, errors = pendulum(), certified_error_set(batch_reactor(), ncs_gym.ChannelContract(3))
    varying = varying_truck()
    certificate = certificate_of(batch_reactor(), ncs_gym.ChannelContract(3, 0.001), "polytope")
    paper = {"kappa": 0.5, "rho": 1.2, "epsilon": 0.1, "epsilon_up": 0.2, "fingerprint": "none"}
    return [
        plant,
        plant.remainder,
        varying,
        varying.remainder.family,
        varying.remainder.family.check,
        plant.disturbance,
        ncs_gym.truck_trailer().process_noise,
        errors,
        certified_error_set(ncs_gym.truck_trailer()),
        ncs_gym.Channel(loss=ncs_gym.GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.5)),
        ncs_gym.GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.5),
        ncs_gym.TraceChannel(trace=(0, -1)),
        ncs_gym.ChannelContract(3),
        loop_env(ncs_gym.truck_trailer(), **DOWNLINK).downlink_protocol,
        ncs_gym.PacketLog(np.arange(3.0), np.ones(3)),
        TRUCK_TRAILER,
        ncs_gym.Regulation(state_cost=np.eye(2)),
        ncs_gym.SpeedTracking(),
        ncs_gym.SetpointTracking(output=[1.0, 0.0], reach=0.5, width=1.0),
        BallDisturbance(),
        SphereDisturbance(),
        ncs_gym.BoxDisturbance([0.1, 0.2]),
        ncs_gym.SinusoidDisturbance(),
        ncs_gym.AdversarialDisturbance(np.eye(2)),
        as_disturbance(np.add, ncs_gym.truck_trailer(), False),
        LinearProcess(),
        FamilyProcess(),
        ncs_gym.FunctionProcess(np.add),
        ncs_gym.GymProcess(gym.make, np.asarray),
        CartPoleProcess(),
        PendulumProcess(),
        InvertedPendulumProcess(),
        certificate,
        certificate.safe_set,
        certificate.proofs[0],
        certificate.updates,
        PaperCertificate(L=np.eye(2), K=np.ones((1, 2)), **paper),
        safety_filter(certificate, batch_reactor()),
        setpoint_range(certificate, batch_reactor(), 1),
        BoardTable.of(certificate, batch_reactor()),
        ncs_gym.Model(np.eye(2), np.ones((2, 1)), None, 0.1, at=(np.ones(2), np.ones(1))),
        ncs_gym.Limits((-np.ones(2), np.ones(2)), np.ones(1), [(np.ones(2), np.ones(1), -1.0, 1.0)], np.ones(1)),
        ncs_gym.Bounds(ncs_gym.Box(np.zeros(2), np.ones(2)), 0.1, np.ones(2)),
        ncs_gym.Box(np.zeros(2), np.ones(2)),
        ncs_gym.Ball(1.0),
        ncs_gym.Gaussian(np.eye(2), 0.1),
        ncs_gym.Through(np.eye(2), np.ones(2)),
        ncs_gym.Sum((ncs_gym.Box(np.zeros(2), np.ones(2)), ncs_gym.Ball(1.0))),
        Loop(plant=ncs_gym.truck_trailer()),
        ncs_gym.bounds_from_recording(
            pendulum().model, np.zeros((20, 1)), np.zeros((21, 2)), np.ones((2, 1)), sensor=0.1
        ),
    ]


def arrays_in(value):
    """The arrays that a field holds, in tuples too."""
    if isinstance(value, tuple):
        return [array for each in value for array in arrays_in(each)]
    return [value] if isinstance(value, np.ndarray) else []


def assert_same(one, other):
    """Both are of the same kind with the same values."""
    assert type(one) is type(other)
    if is_dataclass(one):
        for each in fields(one):
            assert_same(getattr(one, each.name), getattr(other, each.name))
    elif isinstance(one, tuple):
        for each, its_twin in zip(one, other, strict=True):
            assert_same(each, its_twin)
    elif isinstance(one, np.ndarray | float | int | str):
        np.testing.assert_array_equal(one, other)


def test_values_their_copies_pickles_and_those_of_threads_are_equal_and_read_only():
    with ThreadPoolExecutor(4) as pool:
        for made in values():
            of_threads = pool.map(lambda _, made=made: pickle.loads(pickle.dumps(made)), range(4))
            for twin in (made, copy(made), deepcopy(made), pickle.loads(pickle.dumps(made)), *of_threads):
                assert_same(twin, made)
                assert_read_only(twin)


def assert_read_only(made):
    """Neither a field nor an entry of an array can be set."""
    for name in (*(each.name for each in fields(made)), "something_else"):
        with pytest.raises(FrozenInstanceError):
            setattr(made, name, None)
        for array in arrays_in(getattr(made, name, None)):
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 7.0


def test_every_kind_of_value_is_looked_at_here():
    for package, asked in ((ncs_gym, object), (shields, ReadOnlyArrays)):
        name = f"{package.__name__}."
        modules = [importlib.import_module(each.name) for each in pkgutil.walk_packages(package.__path__, name)]
        kinds = {each for module in modules for each in vars(module).values() if inspect.isclass(each)}
        own = {each for each in kinds if is_dataclass(each) and each.__module__.startswith(name)}
        assert {each for each in own if issubclass(each, asked)} <= {*map(type, values()), *PASSING}


def test_values_do_not_share_memory_with_what_they_were_made_from():
    shape = np.eye(2)
    ellipsoid = ncs_gym.Ellipsoid(shape)
    shape[0, 0] = 5.0
    assert ellipsoid.shape_matrix[0, 0] == 1.0
