import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from ncs_gym.draws import uniform_many
from ncs_gym.system import unpacked

from ncs_gym import (
    BoxDisturbance,
    Channel,
    ChannelContract,
    GilbertElliott,
    LinearPlant,
    NCSEnv,
    batch_reactor,
    cart_pole,
    draws,
    truck_trailer,
)
from ncs_gym.envs.vector_env import NCSVectorEnv
from ncs_gym.estimation import gain_table
from ncs_gym.network.channel_state import ChannelState
from ncs_gym.plants.lqr import regulator_gain
from ncs_gym.tasks.task import SetpointTracking, SpeedProfile, SpeedTracking
from ncs_gym.uncertainty.disturbance import (
    AdversarialDisturbance,
    BallDisturbance,
    SinusoidDisturbance,
    SphereDisturbance,
)
from tests.plants import random_plant

IDS = ("TruckTrailer", "TruckTrailerCruise", "CartPole", "BatchReactor")
BURSTS = GilbertElliott(p_good_to_bad=0.15, p_bad_to_good=0.3, loss_good=0.05, loss_bad=0.9)
CHANNELS = {
    "perfect": Channel(),
    "case study": Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2),
    "blackout": Channel(loss=1.0),
    "overtaking": Channel(loss=0.2, quantization_step=0.02, delay=1, jitter=4),
    "bursts": Channel(loss=BURSTS, jitter=2),
    "rationed bursts": Channel(loss=BURSTS, send_period=3, delay=4, quantization_step=0.01),
    "limited losses": Channel(loss=0.6, max_consecutive_losses=2, delay=1),
}


def make(name, count, **settings):
    return gym.make_vec(f"ncs_gym/{name}-v0", num_envs=count, **settings)


class Log:
    """Records what a vector environment draws."""

    def __init__(self, env):
        self.env, self.steps = env, []
        self.start = {
            "state": env._fleet.state.copy(),
            "mean": env._fleet.mean.copy(),
            "bad": env._fleet.bad.copy(),
            "memory": env._memory.copy(),
        }

    def step(self, actions):
        self.now = {}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(draws, "uniform_many", self.uniform_many)
            result = self.env.step(actions)
        fleet, network = self.env._fleet, unpacked.py_func(self.env._counts, self.env._constants)
        self.now |= {"disturbance": fleet.disturbance.T.copy(), "noise": fleet.noise.T.copy()}
        self.now["uniforms"] = fleet.uniforms[: network.uniforms].copy()
        self.steps.append(self.now)
        return result

    def uniform_many(self, rng, rows, count):
        self.now["task"] = uniform_many(rng, rows, count)
        return self.now["task"]


class Script:
    """Hands out recorded numbers where the scalar environment asks for random ones."""

    def __init__(self):
        self.numbers = []

    def random(self):
        return self.numbers.pop(0)

    def uniform(self, low, high):
        return low + (high - low) * self.numbers.pop(0)

    def integers(self, count):
        return int(self.numbers.pop(0) * count)


class Replayed(NCSEnv):
    """The scalar environment fed with what one environment of a vector drew."""

    def begin(self, log, index):
        self.log, self.index, self.script = log, index, Script()
        self.reset(options={"state": log.start["state"][:, index]})
        self.estimator.reset(log.start["mean"][:, index])
        memory = log.start["memory"][index]
        self._task_memory = SpeedProfile(*memory) if isinstance(self.task, SpeedTracking) else memory.sum()
        self.script.numbers = [0.5]
        self._link = ChannelState(self.channel, self.script)
        self._link._bad = bool(log.start["bad"][index])
        self.np_random = self.script
        return self._observation(), self._info(np.zeros(self.plant.m), packet_arrived=False)

    def replay(self, action, number):
        drawn = self.log.steps[number]
        self.now = {key: value[self.index] for key, value in drawn.items() if key not in ("task", "uniforms")}
        task = drawn["task"][:, self.index].tolist() if "task" in drawn else []
        uniforms = drawn["uniforms"][:, self.index].tolist()
        sends = self._link.sends_at(self.steps + 1)
        network = [
            *uniforms[2:],
            *(uniforms[:1] or [0.5]) * sends,
            *(uniforms[1:2] if self.channel.jitter else []) * sends,
        ]
        self.script.numbers = task + network
        result = self.step(action)
        assert not self.script.numbers
        return result

    def _draw_disturbance(self, nominal_next):
        return self.now["disturbance"]

    def _measure(self):
        return self.plant.H @ self._state + self.now["noise"]


def settings_of(env):
    return {
        "plant": env.plant,
        "channel": env.channel,
        "task": env.task,
        "initial_set": env.initial_set,
        "terminate_on_violation": env.terminate_on_violation,
        "contract": env.contract,
    }


def assert_same(number, single, vector, index):
    for key, value in single.items():
        np.testing.assert_allclose(vector[key][index], value, rtol=1e-10, atol=1e-10, err_msg=f"step {number}: {key}")
        assert np.asarray(value).dtype.kind == vector[key].dtype.kind, key


def compare(env, count, steps, policy_seed=0):
    """Steps a vector environment and, with the same draws, scalar ones; compares everything at every step."""
    env.reset(seed=3)
    log, rng = Log(env), np.random.default_rng(policy_seed)
    singles = [Replayed(**settings_of(env.single), horizon=env.single.horizon) for _ in range(count)]
    for index, single in enumerate(singles):
        single.begin(log, index)
    plant, alarms, estimates = env.plant, 0, np.zeros((count, env.plant.n))
    # Unstable plants are held near zero, or rounding would grow without end.
    gain = np.zeros((plant.m, plant.n))
    if plant.spectral_radius >= 1.0:
        scale = np.diag(plant.half_widths)
        gain = regulator_gain(
            np.linalg.solve(scale, plant.A @ scale), np.linalg.solve(scale, plant.B * plant.u_max), 1, 1
        )
        gain = gain @ np.linalg.inv(scale)
    for number in range(steps):
        width = 0.1 if gain.any() else 1.2
        actions = (rng.uniform(-width, width, env.action_space.shape) + estimates @ gain.T).astype(np.float32)
        observations, rewards, terminated, truncated, infos = log.step(actions)
        assert not truncated.any()
        for index, single in enumerate(singles):
            observation, reward, done, _, info = single.replay(actions[index], number)
            np.testing.assert_allclose(observations[index], observation, rtol=1e-6, atol=1e-10)
            assert rewards[index] == pytest.approx(reward, rel=1e-10, abs=1e-10)
            assert terminated[index] == done
            assert_same(number, info, infos, index)
            node = env._table._nodes[env._fleet.node[index]]
            covariance = env._table._spreads[node.belief].covariance
            if gain.any():  # an unstable plant makes 1e-17 of rounding 1e-10 in an episode
                single._state = infos["state"][index].copy()
            np.testing.assert_allclose(covariance, single.estimator.belief.covariance, rtol=1e-10)
        estimates = infos["estimate"]
        alarms += int(infos["assumption_violated"].sum())
    return log, alarms


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("mass", [1000.0, 4000.0])
def test_equals_the_scalar_environment_for_every_channel(channel, mass):
    env = NCSVectorEnv(
        3, plant=truck_trailer(mass=mass), channel=CHANNELS[channel], task=SpeedTracking(change_probability=0.2)
    )
    log, _ = compare(env, 3, 200)
    assert all(step["disturbance"].any() for step in log.steps)


@pytest.mark.parametrize("name", IDS)
def test_registered_environments_equal_their_scalar_versions(name):
    env = make(name, 3, max_episode_steps=None, terminate_on_violation=False).unwrapped
    compare(env, 3, 200)


@pytest.mark.parametrize(
    ("plant", "channel", "contract"),
    [
        (cart_pole(full_state=False), Channel(loss=0.3, delay=1, quantization_step=1e-4), ChannelContract(2, 1e-4)),
        (batch_reactor(), Channel(loss=0.5, jitter=3), ChannelContract(3)),
        (random_plant(5, 3, 2, p=1), Channel(loss=0.4, delay=1, jitter=2), None),
        (random_plant(6, 5, 3, p=2), Channel(loss=BURSTS, send_period=2), None),
    ],
)
def test_partial_measurements_and_broken_contracts_are_the_same(plant, channel, contract):
    env = NCSVectorEnv(3, plant=plant, channel=channel, contract=contract)
    compare(env, 3, 120)
    if contract is not None:
        env.reset(seed=0)
        broken = [env.step(np.zeros((3, plant.m), np.float32))[4]["contract_broken"] for _ in range(60)]
        assert np.any(broken)


def test_alarms_are_raised_where_the_scalar_estimator_raises_them():
    # Noise three times as large as allowed: many residuals fail the quick test, some the exact one.
    env = NCSVectorEnv(
        4,
        plant=truck_trailer(),
        channel=Channel(loss=0.2, delay=1, jitter=1),
        disturbance=lambda rng, plant, nominal: 1.5 * plant.disturbance.sample_boundary(rng),
        allow_assumption_violation=True,
    )
    _, alarms = compare(env, 4, 60)
    assert 0 < alarms < 4 * 60


def test_a_forgetting_table_changes_nothing(monkeypatch):
    monkeypatch.setattr(gain_table, "MOST_NODES", 40)
    env = make("TruckTrailerCruise", 3, max_episode_steps=None).unwrapped
    compare(env, 3, 200)
    assert len(env._table) <= 60


DISTURBANCES = {
    "ball": BallDisturbance(),
    "box": BoxDisturbance((0.02, 0.01)),
    "sinusoid": SinusoidDisturbance(period=7.0),
    "sphere": SphereDisturbance(),
    "adversarial": AdversarialDisturbance(),
    "adversarial in M": AdversarialDisturbance(np.array([[2.0, 0.3], [0.3, 1.0]])),
    "callable": lambda rng, plant, nominal: 0.5 * plant.disturbance.sample_boundary(rng),
}


@pytest.mark.parametrize("name", DISTURBANCES)
def test_disturbances_stay_in_their_bound_and_move_the_state(name):
    plant = truck_trailer()
    env = NCSVectorEnv(50, plant=plant, disturbance=DISTURBANCES[name])
    _, info = env.reset(seed=1)
    gauges = []
    for _ in range(40):
        before = info["state"]
        _, _, _, _, info = env.step(np.zeros((50, 1), np.float32))
        d = info["state"] - before @ plant.A.T
        gauges.append(plant.disturbance.gauge(d))
    assert np.max(gauges) <= 1.0 + 1e-9
    assert np.mean(gauges) > 0.02
    if name in ("sphere", "adversarial", "adversarial in M"):
        assert np.min(gauges) > 1.0 - 1e-6


@pytest.mark.parametrize("name", ["sinusoid", "adversarial", "adversarial in M"])
def test_batched_draws_equal_scalar_ones(name):
    plant, rng, source = truck_trailer(), np.random.default_rng(0), DISTURBANCES[name]
    memory = source.begin_many(rng, plant, 30)
    nominal, steps = rng.standard_normal((30, 2)), rng.integers(0, 50, 30)
    drawn = source.draw_many(rng, plant, nominal, steps, memory)
    for i in range(30):
        remembered = (memory[i][:-1], memory[i][-1]) if name == "sinusoid" else memory[i]
        one = source.draw(rng, plant, nominal[i], int(steps[i]), remembered)
        np.testing.assert_allclose(drawn[i], one, atol=1e-7)


def test_batched_draws_are_distributed_like_scalar_ones():
    plant, rng = truck_trailer(), np.random.default_rng(0)
    pairs = [(source.draw, source.draw_many) for source in (BallDisturbance(), BoxDisturbance(), SphereDisturbance())]
    for draw, draw_many in pairs:
        many = draw_many(rng, plant, np.zeros((20000, 2)), np.zeros(20000), None)
        few = np.array([draw(rng, plant, np.zeros(2), 0, None) for _ in range(5000)])
        np.testing.assert_allclose(np.cov(many.T), np.cov(few.T), atol=0.05 * np.trace(np.cov(few.T)))
    for noise in (plant.process_noise, plant.sensor_noise):
        many, few = noise.sample(rng, 20000), np.array([noise.sample(rng) for _ in range(5000)])
        assert noise.bound.gauge(many).max() <= 1.0 + 1e-12
        np.testing.assert_allclose(np.cov(many.T), np.cov(few.T), atol=0.05 * np.trace(np.cov(few.T)))


def test_a_disturbance_beyond_its_bound_raises():
    env = NCSVectorEnv(3, plant=truck_trailer(), disturbance=lambda rng, plant, nominal: np.ones(2))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="outside its bound"):
        env.step(np.zeros((3, 1), np.float32))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((3, 1), np.float32))


@pytest.mark.parametrize("name", IDS)
def test_interface_is_gymnasiums(name):
    env = make(name, 5)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert env.observation_space == gym.vector.utils.batch_space(env.single_observation_space, 5)
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    action = env.action_space.sample()
    observation, reward, terminated, truncated, stepped = env.step(action)
    assert observation in env.observation_space
    assert set(info) == set(stepped)
    assert all(value.shape[0] == 5 for value in stepped.values())
    assert [array.shape for array in (reward, terminated, truncated)] == [(5,)] * 3
    assert [array.dtype for array in (reward, terminated, truncated)] == [np.float64, np.bool_, np.bool_]
    single = gym.make(f"ncs_gym/{name}-v0")
    assert env.single_observation_space == single.observation_space
    assert set(info) == set(single.reset(seed=0)[1])


def test_results_are_fresh_arrays():
    env = make("TruckTrailerCruise", 4)
    env.reset(seed=0)
    kept = env.step(np.full((4, 1), 0.3, np.float32))
    copies = pickle.loads(pickle.dumps(kept))
    for array in kept[4].values():
        array[:] = 0
    kept[0][:] = 0
    again = make("TruckTrailerCruise", 4)
    again.reset(seed=0)
    again.step(np.full((4, 1), 0.3, np.float32))
    for _ in range(5):
        one, other = (each.step(np.full((4, 1), 0.3, np.float32)) for each in (env, again))
        np.testing.assert_array_equal(one[0], other[0])
        assert all(np.array_equal(one[4][key], other[4][key]) for key in one[4])
    assert copies[4]["state"].any()


def test_no_two_results_share_memory_with_each_other_or_with_the_environment():
    env = make("TruckTrailerCruise", 4)
    arrays = [*env.reset(seed=0)[1].values()]
    for _ in range(2):
        observation, rewards, terminated, truncated, info = env.step(np.full((4, 1), 0.3, np.float32))
        arrays += [observation, rewards, terminated, truncated, *info.values()]
    arrays += [*env._kept, env._memory, env._done]
    for i, one in enumerate(arrays):
        assert not any(np.shares_memory(one, other) for other in arrays[:i])


def test_seeds_determine_everything_and_block_sizes_do_not_matter_to_one_seed():
    runs = []
    for seed in (7, 7, 8, [1, 2, 3, 4], [1, 2, 3, 5]):
        env = make("CartPole", 4)
        rng = np.random.default_rng(0)
        states = [env.reset(seed=seed)[1]["state"]]
        states += [env.step(rng.uniform(-1, 1, (4, 1)).astype(np.float32))[4]["state"] for _ in range(300)]
        runs.append(np.array(states))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not any(np.array_equal(runs[0], run) for run in runs[2:])
    assert not np.array_equal(runs[3], runs[4])


def test_next_step_autoreset_ignores_the_action_and_starts_anew():
    env = make("TruckTrailerCruise", 3, max_episode_steps=5)
    env.reset(seed=0)
    for step in range(1, 20):
        _, reward, terminated, truncated, info = env.step(np.ones((3, 1), np.float32))
        assert not terminated.any()
        assert truncated.all() == (step % 6 == 5)
        if step % 6 == 0:
            assert not reward.any()
            assert not info["input"].any()
            assert not info["measurement_age"].any()
            assert (info["episode_violations"] == info["cost"]).all()
            np.testing.assert_allclose(info["error_shape"][0], env.unwrapped.plant.initial_error.shape)
        assert (env.unwrapped.steps == step % 6).all()
    np.testing.assert_array_equal(env.unwrapped.episodes, 4)


def test_same_step_autoreset_hands_over_the_last_observation():
    one, other = (make("CartPole", 20, autoreset_mode=mode) for mode in ("SameStep", "Disabled"))
    assert one.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    one.reset(seed=0)
    other.reset(seed=0)
    for _ in range(400):
        result, plain = (env.step(np.ones((20, 1), np.float32)) for env in (one, other))
        done = plain[2] | plain[3]
        if done.any():
            break
    info, last = result[4], plain[4]
    np.testing.assert_array_equal(info["_final_obs"], done)
    np.testing.assert_array_equal(info["final_obs"][done], plain[0][done])
    np.testing.assert_array_equal(result[0][~done], plain[0][~done])
    assert not np.array_equal(result[0][done], plain[0][done])
    for key, value in last.items():
        np.testing.assert_array_equal(info["final_info"][key][done], value[done])
        np.testing.assert_array_equal(info["final_info"][f"_{key}"], done)
        np.testing.assert_array_equal(info[key][~done], value[~done])
    assert not info["measurement_age"][done].any()
    np.testing.assert_array_equal(result[2], plain[2])


def test_disabled_autoreset_wants_the_finished_environments_reset():
    env = make("TruckTrailer", 3, max_episode_steps=2, autoreset_mode="Disabled")
    env.reset(seed=0)
    env.step(np.zeros((3, 1), np.float32))
    mask = np.array([True, False, False])
    _, info = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(env.unwrapped.steps, [0, 1, 1])
    *_, truncated, _ = env.step(np.zeros((3, 1), np.float32))
    np.testing.assert_array_equal(truncated, ~mask)
    with pytest.raises(gym.error.ResetNeeded, match="reset_mask"):
        env.step(np.zeros((3, 1), np.float32))
    before = info["state"][0]
    _, info = env.reset(options={"reset_mask": ~mask, "state": np.full((3, 2), 0.5)})
    np.testing.assert_array_equal(info["state"][~mask], 0.5)
    assert not np.array_equal(info["state"][0], before)
    env.step(np.zeros((3, 1), np.float32))


def test_violations_are_counted_once_per_step_and_reset():
    env = NCSVectorEnv(2, plant=truck_trailer(mass=4000.0), autoreset_mode="Disabled", max_episode_steps=50)
    _, info = env.reset(seed=0, options={"state": np.array([[1.95, 1.95], [0.0, 0.0]])})
    total = info["cost"].copy()
    for _ in range(20):
        *_, info = env.step(np.ones((2, 1), np.float32))
        total += info["cost"]
        np.testing.assert_array_equal(info["episode_violations"], total)
    assert total.max() > 0
    _, info = env.reset(options={"reset_mask": np.array([False, True])})
    assert info["episode_violations"][0] == total[0]


@pytest.mark.parametrize(
    "actions", [np.zeros((3, 2)), np.zeros(3), np.full((3, 1), np.nan), [[0.0], [np.inf], [0.0]], None, "a", [[1j]] * 3]
)
def test_unusable_actions_are_refused_before_anything_moves(actions):
    env = make("TruckTrailer", 3)
    env.reset(seed=0)
    state = env.unwrapped._fleet.state.copy()
    with pytest.raises(ValueError, match="actions must be finite with shape"):
        env.step(actions)
    np.testing.assert_array_equal(env.unwrapped._fleet.state, state)
    env.step([[0.5], [1.0], [0.0]])


def test_actions_of_any_precision_mean_the_same():
    states = []
    for kind in (np.float32, np.float64, np.float16, int):
        env = make("TruckTrailer", 3)
        env.reset(seed=0)
        states.append(env.step(np.array([[0.5], [1.0], [-2.0]]).astype(kind) * (kind is not int))[4]["input"])
    np.testing.assert_array_equal(states[0], states[1])
    np.testing.assert_array_equal(states[0], [[2.0], [4.0], [-4.0]])
    np.testing.assert_array_equal(states[3], 0.0)


@pytest.mark.parametrize(
    "options",
    [
        {"states": 0},
        {"reset_mask": np.ones(2, np.bool_)},
        {"reset_mask": np.ones(3)},
        {"reset_mask": np.zeros(3, np.bool_)},
        {"state": np.zeros(3)},
        {"state": np.full((3, 2), np.nan)},
    ],
)
def test_wrong_options_are_refused(options):
    env = make("TruckTrailer", 3)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"option|reset_mask|state"):
        env.reset(options=options)
    env.step(np.zeros((3, 1), np.float32))


def test_stepping_or_resetting_a_part_needs_a_reset_first():
    env = make("TruckTrailer", 2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((2, 1), np.float32))
    with pytest.raises(gym.error.ResetNeeded):
        env.reset(options={"reset_mask": np.array([True, False])})


@pytest.mark.parametrize(
    "wrong", [{"num_envs": 0}, {"max_episode_steps": 0}, {"autoreset_mode": "Later"}, {"channel": 3}, {"speed": 1}]
)
def test_wrong_settings_are_refused(wrong):
    with pytest.raises((ValueError, TypeError)):
        make("TruckTrailer", **({"count": 2} | {("count" if k == "num_envs" else k): v for k, v in wrong.items()}))


def test_what_a_users_subclass_changes_counts():
    class Fixed(SpeedTracking):
        def reward(self, plant, memory, state, u):
            return 42.0 + memory.speed

    class Odd(SetpointTracking):
        def begin(self, rng, plant):
            return 0.25

    class Quiet(BallDisturbance):
        def draw(self, rng, plant, nominal_next, step, memory):
            return np.full(plant.n, 1e-3)

    plant = truck_trailer(process_noise_cov=np.zeros((2, 2)))
    env = NCSVectorEnv(4, plant=plant, task=Fixed(), disturbance=Quiet(), max_episode_steps=3)
    observation, info = env.reset(seed=0)
    for step in range(1, 10):
        before = info["state"]
        observation, reward, _, _, info = env.step(np.zeros((4, 1), np.float32))
        if step % 4:
            np.testing.assert_allclose(reward, [42.0 + memory.speed for memory in env._memory])
            np.testing.assert_allclose(info["state"], before @ plant.A.T + 1e-3)
    env = NCSVectorEnv(3, plant=plant, task=Odd(output=(1.0, 0.0), reach=1.0, width=2.0, change_probability=0.0))
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observation[:, -1], 0.25)


def test_long_outages_of_unstable_plants_raise_nothing():
    burst = GilbertElliott(p_good_to_bad=0.003, p_bad_to_good=0.0008)
    settings = {
        "plant": batch_reactor(),
        "channel": Channel(loss=burst, jitter=1),
        "contract": ChannelContract(3),
        "disturbance": "sphere",
    }
    env = NCSVectorEnv(4, **settings)
    env.reset(seed=1)
    single = NCSEnv(**settings)
    single.reset(seed=2)
    with np.errstate(all="raise", under="ignore"):
        for _ in range(2000):
            observation, *_ = env.step(np.zeros((4, 2), np.float32))
            assert single.step(np.zeros(2, np.float32))[0] in single.observation_space
    assert observation in env.observation_space


def test_gymnasiums_sync_vector_env_of_scalar_ones_is_still_available():
    env = make("TruckTrailer", 2, vectorization_mode="sync")
    assert isinstance(env.unwrapped, SyncVectorEnv)


def test_own_plant_by_id():
    plant = LinearPlant(A=[[0.5]], B=[[1.0]], C=[[1.0]], u_max=1.0, dt=0.1, gamma=1e-4)
    env = make("LinearNCS", 3, plant=plant)
    env.reset(seed=0)
    assert env.step(np.zeros((3, 1), np.float32))[4]["error_shape"].shape == (3, 1, 1)
    with pytest.raises(ValueError, match="no plant of its own"):
        make("LinearNCS", 3)


def test_environment_can_be_made_without_a_compiler(monkeypatch):
    # As with NUMBA_DISABLE_JIT=1, which leaves functions of Python's.
    from ncs_gym.envs import vector_env

    monkeypatch.setattr(vector_env, "fleet_of", vector_env.fleet_of.py_func)
    assert NCSVectorEnv(2, plant=truck_trailer()).reset(seed=0)[0].shape[0] == 2
