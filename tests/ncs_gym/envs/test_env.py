import json
import pickle
import warnings
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from stable_baselines3.common.env_util import make_vec_env

import ncs_gym
from ncs_gym import BoxDisturbance, Channel, Ellipsoid, GilbertElliott, LinearPlant, NCSEnv, Regulation, SpeedTracking
from ncs_gym.envs.env import ncs_env
from tests.plants import random_plant

IDS = ["ncs_gym/TruckTrailer-v0", "ncs_gym/TruckTrailerCruise-v0", "ncs_gym/LinearNCS-v0"]
KEYS = {
    "state": np.ndarray,
    "estimate": np.ndarray,
    "estimation_error": np.ndarray,
    "error_shape": np.ndarray,
    "input": np.ndarray,
    "input_committed": np.ndarray,
    "constraint_values": np.ndarray,
    "worst_constraint_values": np.ndarray,
    "cost": float,
    "measurement_age": int,
    "packet_arrived": bool,
    "assumption_violated": bool,
    "episode_violations": float,
    "is_success": float,
    "contract_broken": bool,
    "downlink_broken": bool,
    "requested": bool,
    "request_forced": bool,
    "packets": int,
}


def make(env_id: str, **kwargs) -> gym.Env:
    if env_id == "ncs_gym/LinearNCS-v0":
        kwargs.setdefault("plant", random_plant(0, 3, 2, 2))
    return gym.make(env_id, **kwargs)


@pytest.mark.parametrize("env_id", IDS)
def test_gymnasium_and_sb3_checkers_pass_without_a_warning(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(env_id).unwrapped)
        check_env_sb3(make(env_id).unwrapped)


@pytest.mark.parametrize("env_id", IDS[:2])
def test_registered_kwargs_are_json(env_id):
    spec = gym.spec(env_id)
    assert spec.max_episode_steps == 200
    assert gym.make(type(spec).from_json(spec.to_json())).spec.id == env_id


def test_module_prefix_registers(tmp_path):
    assert gym.make("ncs_gym:ncs_gym/TruckTrailer-v0").spec.id == "ncs_gym/TruckTrailer-v0"


def test_factories_carry_metadata():
    assert ncs_gym.registration.TRUCK_TRAILER.metadata == NCSEnv.metadata


@pytest.mark.parametrize("env_id", IDS)
def test_info_has_the_same_keys_types_and_shapes_always(env_id):
    env = make(env_id)
    infos = [env.reset(seed=0)[1]]
    for _ in range(60):
        infos.append(env.step(env.action_space.sample())[4])
    for info in infos:
        assert {key: type(value) for key, value in info.items()} == KEYS
        for key, value in info.items():
            if isinstance(value, np.ndarray):
                assert value.dtype == np.float64
                assert value.shape == infos[0][key].shape
        np.testing.assert_array_equal(info["estimation_error"], info["estimate"] - info["state"])
    assert any(info["packet_arrived"] for info in infos)
    assert not infos[0]["packet_arrived"]
    assert not infos[0]["input"].any()


def test_writing_into_an_info_changes_nothing(plant):
    runs = []
    for vandal in (False, True):
        env = make(IDS[0])
        _, info = env.reset(seed=3)
        for k in range(60):
            if vandal:
                for value in info.values():
                    if isinstance(value, np.ndarray):
                        value[...] = 1e6
            *_, info = env.step(np.array([(-1) ** (k // 7) * 0.8], np.float32))
        runs.append({key: np.copy(info[key]) for key in ("state", "estimate", "error_shape")})
    for key in runs[0]:
        np.testing.assert_array_equal(runs[0][key], runs[1][key])


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("disturbance", ["ball", "box", "sinusoid", "sphere", "adversarial"])
def test_same_seed_gives_the_same_trajectory_info_included(env_id, disturbance):
    channel = Channel(loss=GilbertElliott(p_good_to_bad=0.2, p_bad_to_good=0.4), quantization_step=0.05, jitter=2)

    def run(seed):
        env = make(env_id, disturbance=disturbance, channel=channel)
        env.action_space.seed(0)
        observation, info = env.reset(seed=seed)
        rows = [observation, *(np.ravel(value) for value in info.values())]
        for _ in range(40):
            observation, reward, _, _, info = env.step(env.action_space.sample())
            rows += [observation, [reward], *(np.ravel(value) for value in info.values())]
        return np.concatenate(rows)

    np.testing.assert_array_equal(run(5), run(5))
    assert (run(5) != run(6)).any()


def test_reset_without_a_seed_goes_on_with_new_draws():
    env = make(IDS[0])
    env.reset(seed=0)
    first, second = env.reset()[1]["state"], env.reset()[1]["state"]
    assert (first != second).any()


def test_step_follows_the_plant_within_its_disturbance_bound():
    env = make(IDS[0], disturbance="sphere")
    plant = env.unwrapped.plant
    _, info = env.reset(seed=0)
    for _ in range(100):
        action = env.action_space.sample()
        *_, after = env.step(action)
        u = 4.0 * action.astype(np.float64)
        np.testing.assert_array_equal(after["input"], u)
        d = after["state"] - plant.A @ info["state"] - plant.B @ u
        assert plant.disturbance.gauge(d) == pytest.approx(1.0, abs=1e-6)
        info = after


def test_true_error_lies_in_the_running_ellipsoid():
    env = make(IDS[1], disturbance="adversarial")
    for seed in range(5):
        _, info = env.reset(seed=seed)
        for _ in range(200):
            assert Ellipsoid(info["error_shape"]).contains(info["estimation_error"])
            *_, info = env.step(env.action_space.sample())
            assert not info["assumption_violated"]


def test_finite_actions_are_clipped():
    env = make(IDS[0])
    env.reset(seed=0)
    assert env.step(np.array([7.0], np.float32))[4]["input"] == pytest.approx([4.0])


@pytest.mark.parametrize("action", [np.array([np.nan]), np.array([np.inf]), np.zeros(2), 0.5, "go", None, [[0.1]]])
def test_bad_action_raises_before_anything_moves(action):
    env, twin = make(IDS[0], disable_env_checker=True), make(IDS[0])
    env.reset(seed=0)
    twin.reset(seed=0)
    with pytest.raises(ValueError, match="the action must be finite"):
        env.step(action)
    good = np.array([0.25], np.float32)
    np.testing.assert_array_equal(env.step(good)[4]["state"], twin.step(good)[4]["state"])


def test_start_state_can_be_chosen():
    env = make(IDS[0])
    np.testing.assert_array_equal(env.reset(options={"state": [0.5, -1.0]})[1]["state"], [0.5, -1.0])


@pytest.mark.parametrize(
    "options", [{"state": [1.0]}, {"state": [np.nan, 0.0]}, {"state": "a"}, {"state": None}, {"sate": [0.0, 0.0]}]
)
def test_bad_options_are_refused_before_anything_changes(options):
    env, twin = make(IDS[0]), make(IDS[0])
    env.reset(seed=0)
    twin.reset(seed=0)
    with pytest.raises(ValueError, match="state"):
        env.reset(seed=7, options=options)
    np.testing.assert_array_equal(env.step(np.ones(1))[4]["state"], twin.step(np.ones(1))[4]["state"])


def test_sb3_makes_the_environment_by_its_id():
    assert make_vec_env("ncs_gym/TruckTrailerCruise-v0", n_envs=2, seed=0).reset().shape == (2, 3)
    PPO("MlpPolicy", "ncs_gym/TruckTrailer-v0", n_steps=32, batch_size=32).learn(32)


def test_unknown_render_mode_is_refused_in_a_way_sb3_understands():
    for kind in (ValueError, TypeError):
        with pytest.raises(kind, match="render_mode must be None or one of"):
            NCSEnv(ncs_gym.truck_trailer(), render_mode="ansi")


def test_actions_are_taken_in_float64():
    env = make(IDS[0])
    env.reset(seed=0)
    assert env.step(np.array([0.1]))[4]["input"][0] == 4.0 * 0.1


def test_observation_box_leaves_room_for_the_disturbance():
    quiet = make(IDS[0], plant=ncs_gym.truck_trailer(gamma=0.0, process_noise_cov=np.zeros((2, 2))), disturbance="ball")
    assert (make(IDS[0]).observation_space.high > quiet.observation_space.high + 0.05).all()


def test_starts_fill_the_disc_of_radius_1_9():
    env = make(IDS[0])
    radii = np.array([np.linalg.norm(env.reset(seed=i)[1]["state"]) for i in range(400)])
    assert radii.max() <= 1.9
    assert np.mean(radii <= 0.95) == pytest.approx(0.25, abs=0.07)


def test_cost_counts_violations_of_the_true_state():
    env = make(IDS[0], initial_set=Ellipsoid(np.zeros((2, 2))))
    _, info = env.reset(options={"state": [2.5, 0.0]})
    assert (info["cost"], info["episode_violations"], info["is_success"]) == (1.0, 1.0, 0.0)
    np.testing.assert_allclose(info["constraint_values"], [0.25, -1.0])
    total = 1.0
    for _ in range(5):
        *_, info = env.step(np.ones(1, np.float32))
        total += info["cost"]
        assert info["cost"] == float(np.abs(info["state"]).max() > 2.0)
    assert info["episode_violations"] == total


def test_violation_terminates_only_if_asked_to():
    for asked in (False, True):
        env = make(IDS[1], terminate_on_violation=asked)
        env.reset(seed=0)
        ended = False
        for _ in range(6):
            if not ended:
                ended = env.step(np.ones(1, np.float32))[2]
        assert ended is asked


def test_time_limit_is_left_to_the_wrapper():
    env = make(IDS[0])
    env.reset(seed=0)
    assert [env.step(np.zeros(1, np.float32))[3] for _ in range(200)] == [False] * 199 + [True]


def test_observation_is_the_estimate_and_the_tasks_entries():
    env = make(IDS[1])
    observation, info = env.reset(seed=0)
    np.testing.assert_array_equal(observation[:2], info["estimate"].astype(np.float32))
    assert observation.dtype == np.float32
    assert observation.shape == (3,)


def test_observation_is_clipped_but_the_estimate_is_not():
    env = make(IDS[0])
    far = np.array([50.0, 0.0])
    observation, info = env.reset(options={"state": far})
    assert observation in env.observation_space
    assert observation[0] < 3.0
    assert info["estimate"][0] == pytest.approx(50.0, abs=0.1)


def test_full_throttle_under_the_worst_disturbance_stays_in_the_observation_space():
    for env_id in IDS[:2]:
        env = make(env_id, disturbance="adversarial")
        for sign in (1.0, -1.0):
            env.reset(seed=0)
            for _ in range(200):
                *_, info = env.step(np.full(1, sign, np.float32))
                assert (np.abs(info["estimate"]) <= env.observation_space.high[:2]).all()


class Clumsy(Regulation):
    """A task that fails once, in the middle of a step."""

    def reward(self, plant, memory, state, u):
        if u[0] > 3.9:
            raise RuntimeError("clumsy")
        return 0.0


def test_a_step_that_failed_half_way_needs_a_reset():
    env = make(IDS[0], task=Clumsy()).unwrapped
    env.reset(seed=0)
    with pytest.raises(RuntimeError, match="clumsy"):
        env.step(np.ones(1, np.float32))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(1, np.float32))
    env.reset()
    env.step(np.zeros(1, np.float32))


def test_stepping_before_the_first_reset_says_so():
    with pytest.raises(gym.error.ResetNeeded):
        make(IDS[0]).unwrapped.step(np.zeros(1, np.float32))


class Moody(Regulation):
    """A task that fails in its second episode."""

    calls: ClassVar = [0]

    def begin(self, rng, plant):
        self.calls[0] += 1
        if self.calls[0] == 2:
            raise RuntimeError("moody")


def test_a_reset_that_failed_half_way_needs_another():
    env = make(IDS[0], task=Moody()).unwrapped
    env.reset(seed=0)
    with pytest.raises(RuntimeError, match="moody"):
        env.reset(options={"state": [1.9, 1.9]})
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(1, np.float32))


class Wild(ncs_gym.BoxDisturbance):
    """A user's class with a draw outside every bound."""

    def draw(self, rng, plant, nominal_next, step, memory):
        return np.full(plant.n, 5.0)


def test_disturbance_classes_of_the_users_are_checked():
    env = make(IDS[0], disturbance=Wild())
    env.reset(seed=0)
    with pytest.raises(ValueError, match="outside its bound"):
        env.step(np.zeros(1, np.float32))


def test_one_settings_object_serves_many_environments():
    channel, task = Channel(loss=0.5, delay=1), SpeedTracking()
    alone = make(IDS[1], channel=channel, task=task)
    alone.reset(seed=1)
    expected = [alone.step(np.ones(1, np.float32))[4]["estimate"] for _ in range(20)]
    one, other = make(IDS[1], channel=channel, task=task), make(IDS[1], channel=channel, task=task)
    one.reset(seed=1)
    other.reset(seed=2)
    for estimate in expected:
        other.step(-np.ones(1, np.float32))
        np.testing.assert_array_equal(one.step(np.ones(1, np.float32))[4]["estimate"], estimate)


def test_environment_survives_pickling_in_the_middle_of_an_episode():
    env = make(IDS[1]).unwrapped
    env.reset(seed=0)
    for _ in range(7):
        env.step(np.ones(1, np.float32))
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(20):
        np.testing.assert_array_equal(
            env.step(np.ones(1, np.float32))[4]["estimate"], twin.step(np.ones(1, np.float32))[4]["estimate"]
        )


def test_too_large_disturbance_raises_or_is_allowed_and_noticed():
    def gust(rng, plant, nominal_next):
        return np.array([0.5, 0.5])

    env = make(IDS[0], disturbance=gust, channel=Channel())
    env.reset(seed=0)
    with pytest.raises(ValueError, match="outside its bound"):
        env.step(np.zeros(1, np.float32))
    env = make(IDS[0], disturbance=gust, channel=Channel(), allow_assumption_violation=True)
    env.reset(seed=0)
    assert env.step(np.zeros(1, np.float32))[4]["assumption_violated"]


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"plant": 3}, "plant must be of type LinearPlant"),
        ({"terminate_on_violation": "no"}, "terminate_on_violation must be True or False"),
        ({"channel": "lossy"}, "channel must be of type Channel"),
        ({"task": "drive"}, "task must be of type Task"),
        ({"initial_set": np.eye(2)}, "initial_set must be of type Ellipsoid"),
        ({"initial_set": Ellipsoid(np.eye(3))}, "dimension 2, got 3"),
        ({"disturbance": "storm"}, "disturbance must be one of"),
        ({"disturbance": BoxDisturbance([1.0, 1.0])}, "squared length"),
        ({"task": Regulation(state_cost=np.eye(3))}, "state_cost must have shape"),
        ({"plant": LinearPlant(A=[[1.1]], B=[[1.0]], box=[[1.0]], u_max=1.0, dt=0.1, gamma=0.0)}, "spectral radius"),
    ],
)
def test_bad_settings_are_refused_in_one_sentence(kwargs, words):
    with pytest.raises(ValueError, match=words) as caught:
        make(IDS[0], **kwargs)
    assert "\n" not in str(caught.value)


def test_a_plant_of_another_size_gets_defaults_that_fit():
    env = make(IDS[0], plant=random_plant(0, 3, 2))
    env.reset(seed=0)
    env.step(env.action_space.sample())


def test_a_variant_of_the_truck_keeps_the_case_studys_disturbance_and_starts():
    env = make(IDS[0], plant=ncs_gym.truck_trailer(mass=1500.0)).unwrapped
    assert env.disturbance is ncs_gym.registration.CASE_STUDY_BOX
    assert env.initial_set.shape_matrix[0, 0] == pytest.approx(1.9**2)


def test_linear_ncs_without_a_plant_says_what_it_needs():
    with pytest.raises(ValueError, match="give plant="):
        gym.make("ncs_gym/LinearNCS-v0")


def test_registered_specs_hold_no_objects():
    assert all(json.loads(gym.spec(env_id).to_json())["kwargs"] == {} for env_id in IDS)


def test_environment_inside_is_found_and_a_foreign_one_refused():
    env = make(IDS[0])
    assert ncs_env(env) is env.unwrapped
    with pytest.raises(ValueError, match="expected an NCSEnv inside, got CartPoleEnv"):
        ncs_env(gym.make("CartPole-v1"))
