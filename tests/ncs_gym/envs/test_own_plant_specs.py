"""Plants of users' own are registered; specs of their environments are JSON, and make the same environment again."""

import copy
import json
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from ncs_gym import (
    AdversarialDisturbance,
    BoxDisturbance,
    Channel,
    ChannelContract,
    Ellipsoid,
    GilbertElliott,
    NCSVectorEnv,
    RandomChannel,
    Regulation,
    SetpointTracking,
    SinusoidDisturbance,
    SpeedTracking,
    TraceChannel,
)
from ncs_gym.disturbances import BallDisturbance, SphereDisturbance
from ncs_gym.processes.process import LinearProcess
from ncs_gym.registration import registered_ids
from shields import SafetyShield
from tests.certificates import certificate_of
from tests.product import linear_plant, safety_shield

LINEAR = "ncs_gym/LinearNCS-v0"
TRUCK = "ncs_gym/TruckTrailer-v0"
BURSTS = GilbertElliott(p_good_to_bad=0.1, p_bad_to_good=0.5)
SETTINGS = [
    {},
    {"channel": Channel(loss=BURSTS, quantization_step=0.01, delay=1, jitter=2, max_consecutive_losses=3)},
    {"channel": TraceChannel(trace=(0, 1, -1, 2))},
    {"channel": Channel(max_consecutive_losses=1), "contract": ChannelContract(max_age=5)},
    {"channel": Channel(max_consecutive_losses=1), "downlink": Channel(delay=1, max_consecutive_losses=1)},
    {"task": SetpointTracking(output=np.array([1.0, 0.0]), reach=0.1, width=1.0)},
    {"task": Regulation(state_cost=np.eye(2), input_cost=[[0.5]])},
    {"disturbance": BallDisturbance()},
    {"disturbance": BoxDisturbance(np.array([0.001, 0.002]))},
    {"disturbance": SinusoidDisturbance(period=7.0)},
    {"disturbance": SphereDisturbance()},
    {"disturbance": AdversarialDisturbance(M=np.diag([1.0, 2.0]))},
    {"disturbance": AdversarialDisturbance(rows=np.array([[1.0, -1.0]]))},
    {"initial_set": Ellipsoid(np.diag([0.01, 0.02]))},
    {"process": LinearProcess()},
    {"horizon": np.int64(50), "terminate_on_violation": np.bool_(True), "observe": ("age", "error")},
]
# Of a registered plant, which is no part of the spec; some are JSON values already.
OF_TRUCKS = [
    {"channel": {"loss": 0.2, "max_consecutive_losses": 1, "on_request": True}, "contract": {"max_age": 6}},
    {"channel": {"loss": {"p_good_to_bad": 0.1, "p_bad_to_good": 0.5}, "delay": 3}, "noise": "gaussian"},
    {"downlink": Channel(loss=BURSTS, delay=1, max_consecutive_losses=3), "downlink_contract": ChannelContract(5)},
    {"task": {"output": [1.0, 0.0], "reach": 0.8, "width": 0.5}, "disturbance": "sphere"},
    {"task": SpeedTracking(fastest=10.0), "disturbance": {"half_widths": [0.01, 0.01]}},
    {"initial_set": {"shape_matrix": [[1.0, 0.0], [0.0, 2.0]]}, "allow_assumption_violation": True},
]


def own_plant():
    """A plant that no module registers."""
    return linear_plant(
        A=[[0.9, 0.1], [0.0, 0.8]],
        B=[[0.0], [0.1]],
        box=[1.0, 2.0],
        u_max=1.5,
        dt=0.1,
        gamma=1e-4,
        disturbance_bound=[0.01, 0.02],
        sensor_bound=0.01,
        initial_bound=0.02,
        state_names=["level", "rate"],
        state_units=["m", "m/s"],
    )


def test_registered_plant_has_its_settings_its_time_limit_and_a_vector_environment_of_its_own(register):
    plant = own_plant()
    register("Plants/Own-v0", plant, channel=Channel(loss=0.2), task=SpeedTracking(), max_episode_steps=7)
    one, many = gym.make("Plants/Own-v0"), gym.make_vec("Plants/Own-v0", num_envs=4)
    assert isinstance(many, NCSVectorEnv)
    for env in (one, many):
        inner = getattr(env.unwrapped, "single", env.unwrapped)
        assert inner.plant is plant
        assert (inner.channel, type(inner.task), inner.horizon) == (Channel(loss=0.2), SpeedTracking, 7)
        env.reset(seed=0)
        steps = [env.step(np.zeros(env.action_space.shape, np.float32)) for _ in range(7)]
        assert [np.all(truncated) for _, _, _, truncated, _ in steps] == [False] * 6 + [True]
    assert "Plants/Own-v0" in registered_ids()


def assert_moves_alike(one, other):
    for env in (one, other):
        env.reset(seed=3)
    for step in range(12):
        action = np.full(one.action_space.shape, np.sin(step), np.float32)
        (first, reward, *_), (second, same_reward, *_) = one.step(action), other.step(action)
        np.testing.assert_array_equal(first, second)
        np.testing.assert_array_equal(reward, same_reward)


@pytest.mark.cases(12)
@pytest.mark.parametrize(
    ("env_id", "settings"), [(LINEAR, each) for each in SETTINGS] + [(TRUCK, each) for each in OF_TRUCKS]
)
def test_loaded_spec_makes_the_same_environment_again(env_id, settings):
    made = gym.make(env_id, **{"plant": own_plant()} if env_id == LINEAR else {}, **settings)
    text = made.spec.to_json()
    loaded = gym.make(EnvSpec.from_json(text))
    assert json.loads(loaded.spec.to_json()) == json.loads(text)
    assert loaded.unwrapped.plant.fingerprint == made.unwrapped.plant.fingerprint
    assert loaded.unwrapped.plant.state_names == made.unwrapped.plant.state_names
    assert type(loaded.unwrapped.disturbance) is type(made.unwrapped.disturbance)
    for name in ("channel", "contract", "terminate_on_violation", "downlink", "downlink_contract", "noise", "horizon"):
        assert getattr(loaded.unwrapped, name) == getattr(made.unwrapped, name)
    assert_moves_alike(made, loaded)
    vector = gym.make_vec(EnvSpec.from_json(text), num_envs=2)
    assert isinstance(vector, NCSVectorEnv)
    assert vector.channel == made.unwrapped.channel


def test_spec_of_a_registered_plant_is_json(register):
    settings = {"channel": Channel(loss=BURSTS, delay=1), "disturbance": AdversarialDisturbance(M=np.diag([1.0, 2.0]))}
    register("Plants/Own-v0", own_plant(), max_episode_steps=20, **settings)
    spec = gym.spec("Plants/Own-v0")
    for twin in (EnvSpec.from_json(spec.to_json()), pickle.loads(pickle.dumps(spec)), copy.deepcopy(spec)):
        assert twin == spec
        assert_moves_alike(gym.make("Plants/Own-v0"), gym.make(twin))


def test_spec_of_a_vector_environment_is_json(register):
    register("Plants/Own-v0", own_plant())
    own = gym.make_vec(LINEAR, num_envs=2, plant=own_plant(), channel=Channel(loss=BURSTS, delay=1))
    for made in (own, gym.make_vec("Plants/Own-v0", num_envs=2)):
        again = gym.make_vec(EnvSpec.from_json(made.spec.to_json()))
        assert isinstance(again, NCSVectorEnv)
        assert again.episode_channels == made.episode_channels
        assert_moves_alike(made, again)


def test_environments_of_one_document_share_the_plant():
    plant = own_plant()
    made = gym.make(LINEAR, plant=plant)
    assert gym.make(made.spec).unwrapped.plant is plant
    text = made.spec.to_json()
    assert gym.make(EnvSpec.from_json(text)).unwrapped.plant is gym.make(EnvSpec.from_json(text)).unwrapped.plant


def test_shielded_and_randomized_environment_is_made_again_from_its_spec(register):
    register("Plants/Own-v0", own_plant(), max_episode_steps=20)
    channels = [Channel(loss=0.2), TraceChannel(trace=(0, -1))]
    certificate = certificate_of(own_plant())
    made = safety_shield(RandomChannel(gym.make("Plants/Own-v0"), channel=channels), certificate)
    again = gym.make(EnvSpec.from_json(made.spec.to_json()))
    assert isinstance(again, SafetyShield)
    assert_moves_alike(made, again)


@pytest.mark.parametrize("box", [[5.0, np.inf], [[1.0, -1.0]]])
def test_states_without_a_limit_start_at_the_operating_point(box):
    plant = linear_plant(A=[[0.9, 0.1], [0.0, 0.8]], B=[[0.0], [0.1]], dt=1.0, u_max=1.0, gamma=1e-4, box=box)
    env, free = gym.make(LINEAR, plant=plant), np.linalg.svd(plant.box)[2][-1]
    starts = np.array([env.reset(seed=seed)[1]["state"] for seed in range(50)])
    np.testing.assert_allclose(starts @ free, 0.0, atol=1e-12)
    assert 0.05 < np.abs(starts @ plant.box.T).max() <= 0.1 + 1e-9
