"""The network around environments that are not ours: what is seen, what acts, and that nothing else changes."""

import json
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from ncs_gym import Channel, GilbertElliott, Networked, RandomChannel, TraceChannel, VectorNetworked
from tests.ncs_gym.networked.environments import Counter, Sampled, ages_of_trace

BURSTS = GilbertElliott(p_good_to_bad=0.2, p_bad_to_good=0.4)
LATE = Channel(loss=0.3, delay=1, jitter=2)
REQUESTED = Channel(on_request=True)
ASKING = {"channel": REQUESTED}
NEUTRAL = {"Pendulum-v1": np.zeros(1, np.float32), "CartPole-v1": 0}
EVERYTHING = {
    "channel": Channel(loss=BURSTS, delay=1, jitter=2, send_period=2),
    "downlink": LATE,
    "observe": ("age", "arrived", "pending_actions"),
}


def run(env, steps, seed=0):
    """What an environment returns for actions 1, 2, ..., from the reset on."""
    returned = [env.reset(seed=seed)]
    for k in range(steps):
        returned.append(env.step(np.array([k + 1.0])))
    return returned


def counts(returned):
    return [int(each[0][0]) for each in returned]


@pytest.mark.parametrize("trace", [(0,), (2,), (0, 3, -1, 1, -1, -1, 0), (5, 0, 0, 4, -1, 2, 2)])
def test_newest_sample_that_arrived_is_seen(trace):
    steps = 40
    returned = run(Networked(Counter(), TraceChannel(trace=trace)), steps)
    ages = [each[-1]["measurement_age"] for each in returned]
    rounds = [trace[offset:] + trace[:offset] for offset in range(len(trace))]  # a record begins anywhere
    assert ages in [ages_of_trace((each * steps)[:steps], steps) for each in rounds]
    assert counts(returned) == [step - age for step, age in enumerate(ages)]
    assert [each[-1]["packet_arrived"] for each in returned[1:]] == list(np.diff(counts(returned)) > 0)


@pytest.mark.parametrize(("env_id", "channel"), [("CartPole-v1", Channel()), ("FrozenLake-v1", None)])
def test_perfect_network_changes_nothing(env_id, channel):
    bare, networked = gym.make(env_id), Networked(gym.make(env_id), channel, channel, neutral=channel and 0)
    bare.action_space.seed(0)
    first, own = bare.reset(seed=0), networked.reset(seed=0)
    over = False
    while not over:
        assert np.array_equal(first[0], own[0])
        assert first[1:-1] == own[1:-1]
        assert first[-1].items() <= own[-1].items()
        action = bare.action_space.sample()
        first, own = bare.step(action), networked.step(action)
        over = first[2] or first[3]


@pytest.mark.parametrize(
    ("idle", "acted"), [("hold", [1, 1, 3, 3, 3, 6, 6, 8, 9, 9]), ("neutral", [1, 0, 3, 0, 0, 6, 0, 8, 9, 0])]
)
def test_commands_that_are_late_act_as_asked_for(idle, acted):
    """Commands 1, 2, ... arrive after 0, 2, 0, lost, 1, 0, 3, 0 steps, around again from the first of a seed."""
    env = Networked(Counter(), downlink=TraceChannel(trace=(0, 2, 0, -1, 1, 0, 3, 0)), idle=idle)
    runs = ([each[-1] for each in run(env, 10, seed)[1:]] for seed in range(200))
    infos = next(infos for infos in runs if [info["acted"] for info in infos] == acted)
    assert [info["action_applied"][0] for info in infos] == acted
    ages = [step + 1 - act if act else -1 for step, act in enumerate(acted)]
    assert [info["action_age"] for info in infos] == ages


def test_each_key_has_a_channel_of_its_own():
    env = Networked(Counter("dict"), {"count": Channel(delay=3), "odd": Channel(send_period=2)}, observe=("age",))
    assert env.reset(seed=0)[0]["image"].shape == (84, 84, 4)
    for k in range(1, 8):
        seen, *_, info = env.step(np.zeros(1))
        assert seen["count"] == max(k - 3, 0)
        assert seen["odd"] == 0
        assert (seen["image"] == k).all()
        assert info["measurement_age"] == {"count": min(k, 3), "image": 0, "odd": k % 2}
        assert seen["age"].tolist() == list(info["measurement_age"].values())


def test_what_is_seen_where_nothing_arrived():
    lost = Channel(send_period=3)
    assert counts(run(Networked(Counter(), lost), 7)) == [0, 0, 0, 3, 3, 3, 6, 6]
    assert counts(run(Networked(Counter(), lost, fill="zero"), 7)) == [0, 0, 0, 3, 0, 0, 6, 0]

    def predicted(last, age, actions):
        assert actions[-age:].tolist() == [[last[0] + 1 + k] for k in range(age)]  # decided since the sample
        return last + age

    assert counts(run(Networked(Counter(), lost, fill=predicted), 7)) == [0, 1, 2, 3, 4, 5, 6, 7]


def test_entries_are_what_infos_say_and_actions_are_those_decided():
    env = Networked(gym.make("CartPole-v1"), LATE, LATE, ("age", "arrived", "pending_actions"), neutral=1, pending=3)
    assert env.observation_space.shape == (4 + 1 + 1 + 2 * 3,)
    seen, info = env.reset(seed=0)
    decided, over = [1, 1, 1], False
    while not over:
        assert seen[4:6].tolist() == [info["measurement_age"], info["packet_arrived"]]
        assert seen[6:].reshape(3, 2).argmax(axis=1).tolist() == decided[-3:]
        decided.append(len(decided) % 2)
        seen, _, *ends, info = env.step(decided[-1])
        over = any(ends)


def test_predictions_that_are_lists_get_their_entries_too():
    env = Networked(Counter(), Channel(delay=2), observe="age", fill=lambda last, age, actions: [7.0])
    assert [seen.tolist() for seen, *_ in run(env, 3)] == [[0.0, 0.0], [7.0, 1.0], [7.0, 2.0], [7.0, 2.0]]


@pytest.mark.cases(6)
@pytest.mark.parametrize(
    ("actions", "size"),
    [
        (spaces.Discrete(3, start=-1), 3),
        (spaces.MultiDiscrete([2, 3], start=[4, 0]), 5),
        (spaces.MultiBinary(3), 3),
        (spaces.Box(-1.0, 1.0, (2,), np.float32), 2),
    ],
)
@pytest.mark.parametrize("kind", ["image", "vector"])
def test_entries_are_boxes_that_gymnasium_flattens_likewise_and_frames_can_be_stacked(kind, actions, size):
    class Acting(Counter):
        action_space = actions

        def step(self, action):
            return super().step([0.0])

    def make():
        return Networked(Acting(kind), LATE, observe=("age", "arrived", "pending_actions"), pending=2)

    env = make()
    env.action_space.seed(1)
    env.reset(seed=0)
    sent = [env.action_space.sample() for _ in range(5)]
    seen = [env.step(action)[0] for action in sent][-1]
    flat = [spaces.flatten(actions, action) for action in sent[-2:]]
    if kind == "vector":
        np.testing.assert_array_equal(seen[-2 * size :], np.ravel(flat))
    else:
        assert all(isinstance(env.observation_space[name], spaces.Box) for name in seen)
        np.testing.assert_array_equal(seen["pending_actions"], flat)
    many = VectorNetworked(SyncVectorEnv([Acting]), LATE, observe="pending_actions", pending=2)
    many.reset(seed=0)
    told = [many.step(np.array([action]))[0] for action in sent][-1]
    np.testing.assert_array_equal(told[0, -2 * size :], np.ravel(flat))
    frames = VecFrameStack(DummyVecEnv([make]), 3)
    frames.reset()
    assert frames.observation_space.contains(unstacked(frames.step([sent[0]])[0]))


def unstacked(observations):
    """The observation of the only environment of stable-baselines3."""
    return {key: each[0] for key, each in observations.items()} if isinstance(observations, dict) else observations[0]


@pytest.mark.parametrize("channel", [Channel(loss=0.3, delay=2, jitter=3), Channel(delay=9)])
@pytest.mark.parametrize("kind", ["image", "buffers"])  # three buffers in turn
def test_large_observations_are_what_they_were_when_they_were_taken(kind, channel):
    env = Networked(Counter(kind, length=99), channel)
    envs = VectorNetworked(gym.vector.SyncVectorEnv([lambda: Counter(kind, length=99)] * 2, copy=False), channel)
    for _ in range(2):
        env.reset(seed=0)
        envs.reset(seed=0)
        for k in range(1, 61):
            seen, *_, info = env.step(np.zeros(1))
            assert (seen == (k - info["measurement_age"]) % 256).all()
            many, *_, info = envs.step(np.zeros((2, 1)))
            assert (many == np.reshape((k - info["measurement_age"]) % 256, (2, 1, 1, 1))).all()


@pytest.mark.parametrize(
    "space",
    [
        gym.spaces.Graph(gym.spaces.Box(-1.0, 1.0, (2,)), gym.spaces.Discrete(3)),
        gym.spaces.Tuple([gym.spaces.Text(5), gym.spaces.Discrete(2)]),
    ],
)
def test_observations_without_arrays_are_late_one_by_one(space):
    env = Networked(Sampled(space), Channel(delay=2))
    env.reset(seed=0)
    for k in range(1, 8):
        seen = env.step(0)[0]
        assert env.observation_space.contains(seen)
        assert gym.utils.env_checker.data_equivalence(seen, env.unwrapped.given[max(k - 2, 0)])
    with pytest.raises(ValueError, match=r"takes observations that are one array, not .*: put Networked around each"):
        VectorNetworked(gym.vector.SyncVectorEnv([lambda: Sampled(space)] * 2), Channel(delay=2))


def test_quantized_floats_stay_in_their_space():
    env = Networked(gym.make("Pendulum-v1"), Channel(quantization_step=0.3))
    env.reset(seed=0)
    for _ in range(50):
        seen = env.step(np.array([1.0], np.float32))[0]
        assert env.observation_space.contains(seen)
        assert np.isclose(seen / 0.3, np.rint(seen / 0.3), atol=1e-5)[np.abs(seen) < env.observation_space.high].all()


def test_network_does_not_depend_on_what_the_environment_draws():
    ages = [
        [each[-1]["measurement_age"] for each in run(Networked(Counter(extra_draws=draws), LATE), 50, seed=4)]
        for draws in (0, 3)
    ]
    assert ages[0] == ages[1]
    assert ages[0] != [each[-1]["measurement_age"] for each in run(Networked(Counter(), LATE), 50, seed=5)]


@pytest.mark.parametrize("kind", ["dict", "tensor"])
def test_actions_on_their_way_stay_as_they_are(kind):
    """Whatever the agent writes into its own."""
    box = spaces.Box(-100.0, 100.0, (1,), np.float32)
    own = spaces.Dict(a=spaces.Tuple([box])) if kind == "dict" else box
    buffer, acted = np.zeros(1, np.float32) if kind == "dict" else torch.zeros(1), []
    action = {"a": (buffer,)} if kind == "dict" else buffer

    def number(action):
        return float((action["a"][0] if kind == "dict" else action)[0])

    class Listening(Counter):
        action_space = own

        def step(self, action):
            acted.append(number(action))
            return super().step(np.zeros(1))

    env = Networked(Listening(), downlink=Channel(delay=2))
    env.reset(seed=0)
    told = []
    for k in range(6):
        buffer[0] = k + 1.0
        told.append(env.step(action)[-1]["action_applied"])
    assert acted == [0.0, 0.0, 1.0, 2.0, 3.0, 4.0]
    assert [number(each) for each in told] == acted


@pytest.mark.parametrize("downlink", [{"delay": 3}, {"jitter": 3, "loss": 0.3, "max_consecutive_losses": 2}])
def test_actions_that_act_are_among_those_pending(downlink):
    env = Networked(Counter(), downlink=Channel(**downlink), neutral=[-1.0], observe="pending_actions")
    observation, _ = env.reset(seed=0)
    oldest = 0
    for k in range(500):
        pending = observation[1:]
        observation, *_, info = env.step(np.array([k], np.float32))
        action = float(info["action_applied"][0])
        assert action in {-1.0, k, *pending.tolist()}
        oldest = max(oldest, info["action_age"])
    assert oldest == env.pending


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "Blackjack-v1"])
def test_checkers_pass(env_id):
    neutral = {} if env_id == "Pendulum-v1" else {"neutral": 0}
    env = Networked(gym.make(env_id), **EVERYTHING, **neutral)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # both warn of what is wrapped
        check_env(env, skip_render_check=True)
        sb3_check_env(env)


def test_spec_survives_json_and_pickling():
    env = Networked(gym.make("CartPole-v1"), **EVERYTHING, neutral=1)
    text = env.spec.to_json()
    again = gym.make(gym.envs.registration.EnvSpec.from_json(text))
    assert json.loads(again.spec.to_json()) == json.loads(text)
    for other in (again, pickle.loads(pickle.dumps(env))):
        seen, wanted = other.reset(seed=3), env.reset(seed=3)
        for _ in range(8):
            assert np.array_equal(seen[0], wanted[0])
            seen, wanted = other.step(1), env.step(1)


def test_channels_of_episodes_are_drawn_or_given_and_other_options_reach_the_environment():
    inner = Networked(Counter(), Channel(delay=1))
    env = RandomChannel(inner, channel=[Channel(delay=k) for k in range(5)])
    delays = {env.reset(seed=seed)[1] and inner.episode_channel.delay for seed in range(40)}
    assert delays == set(range(5))
    info = env.reset(options={"channel": Channel(delay=9), "start": 3})[1]
    assert (inner.episode_channel.delay, info["options"]) == (9, {"start": 3})
    delays = {inner.reset()[1]["channel_delay"] for _ in range(40)}  # by whatever name it is called
    assert delays == set(range(5))


TWO_SENSORS = gym.spaces.Dict({name: gym.spaces.Box(-1.0, 1.0, (1,)) for name in "ab"})
DELAYED = [Channel(delay=1), Channel(delay=3)]
NETWORK = {"a": Channel(), "b": Channel(delay=5)}


def test_channels_of_several_sensors_are_drawn_by_their_keys():
    inner = Networked(Sampled(TWO_SENSORS), NETWORK)

    def delays(env, **options):
        """The different pairs of delays in many episodes."""
        infos = [env.reset(seed=seed, options=options)[1]["channel_delay"] for seed in range(40)]
        return {(info["a"], info["b"]) for info in infos}

    assert delays(RandomChannel(inner, {"a": DELAYED})) == {(1, 5), (3, 5)}
    assert delays(RandomChannel(inner, {"a": DELAYED, "b": lambda rng: Channel(delay=2)})) == {(1, 2), (3, 2)}
    assert delays(RandomChannel(inner, DELAYED)) == {(1, 1), (1, 3), (3, 1), (3, 3)}
    assert delays(RandomChannel(inner, DELAYED), channel={"b": Channel(delay=7)}) == {(1, 7), (3, 7)}
    assert delays(RandomChannel(inner, {"a": DELAYED}), channel=Channel(delay=4)) == {(4, 4)}
    pair = Networked(Sampled(gym.spaces.Tuple(TWO_SENSORS.values())), (Channel(), Channel(delay=5)))
    assert pair.reset(options={"channel": (Channel(delay=1), None)})[1]["channel_delay"] == {0: 1, 1: 5}
    for wrong in ({"c": DELAYED}, [NETWORK], {"a": Channel()}, {}):
        with pytest.raises(ValueError, match="channel"):
            RandomChannel(inner, wrong)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"channel": "a.csv"}, "channel must be a Channel, .* got 'a.csv'"),
        ({"channel": {"count": Channel()}}, "channel has the key 'count', which neither channels nor observations"),
        ({"downlink": Channel(send_period=2)}, "a downlink sends a command at every step"),
        ({"downlink": LATE}, "has no zero: give neutral="),
        ({"downlink": LATE, "neutral": 7}, "neutral must be an action, got 7"),
        ({"observe": "ages"}, "each at most once, some of age, arrived, pending_actions, got 'ages'"),
        ({"fill": "nothing"}, "fill must be 'last', 'zero' or a function"),
        ({"idle": "never"}, "idle must be one of 'hold', 'neutral', got 'never'"),
        ({"pending": 4, "observe": "age"}, "pending is how many actions a predictor gets"),
        ({"idle": "neutral"}, "idle is about a network of the actions: give downlink"),
    ],
)
def test_wrong_settings_are_one_sentence(settings, sentence):
    with pytest.raises(ValueError, match=sentence.replace("(", r"\(")):
        Networked(gym.make("CartPole-v1"), **settings)


def test_networks_that_do_not_fit_are_one_sentence():
    with pytest.raises(ValueError, match=r"takes an environment, as gym.make returns it, got 'Pendulum-v1'"):
        Networked("Pendulum-v1")
    with pytest.raises(ValueError, match="an NCSEnv has its own network"):
        Networked(gym.make("ncs_gym/TruckTrailer-v0"))
    with pytest.raises(ValueError, match="has no floats to quantize"):
        Networked(gym.make("FrozenLake-v1"), Channel(quantization_step=0.1))
    with pytest.raises(ValueError, match="has no zero"):
        Networked(gym.wrappers.TransformObservation(Counter(), None, gym.spaces.Box(1.0, 2.0, (1,))), fill="zero")
    for wrong in (lambda: Networked(Counter(), REQUESTED), lambda: Networked(Counter()).reset(options=ASKING)):
        with pytest.raises(ValueError, match="samples on request are for an NCSEnv"):
            wrong()
    with pytest.raises(ValueError, match="has an ideal downlink"):
        Networked(Counter()).reset(options={"downlink": Channel()})
    with pytest.raises(ValueError, match="a function for fill is for one channel"):
        Networked(Counter("dict"), {"count": Channel()}, fill=lambda *given: None)
    with pytest.raises(ValueError, match="Autoreset inside begins episodes"):
        Networked(TimeLimit(gym.wrappers.Autoreset(Counter()), 9))
    with pytest.raises(ValueError, match="the key 'measurement_age', which is the network's"):
        Networked(Networked(Counter(), LATE), LATE).reset()


@pytest.mark.parametrize("channel", [Channel(loss=0.6, delay=1, send_period=3), Channel(loss=BURSTS)])
def test_pending_actions_are_all_that_the_newest_sample_usually_lacks(channel):
    assert channel.oldest_age is None  # no contract says how many
    envs = VectorNetworked(SyncVectorEnv([Counter] * 20), channel, observe="pending_actions")
    envs.reset(seed=0)
    ages = np.array([envs.step(np.zeros((20, 1)))[-1]["measurement_age"] for _ in range(700)][200:])
    assert 0.005 < np.mean(ages > envs.pending) < 0.07
    assert np.mean(ages > envs.pending / 2) > 0.05  # no more of them than that takes


def test_predictor_that_lacks_actions_is_told_of_once():
    def steps(env):
        env.reset(seed=0)
        for _ in range(30):
            env.step(np.zeros(env.action_space.shape))

    channel, settings = Channel(delay=1, loss=0.5), {"fill": lambda last, *_: last, "pending": 1}
    many = VectorNetworked(gym.vector.SyncVectorEnv([Counter] * 2), channel, **settings)
    for env in (Networked(Counter(), channel, **settings), many):
        with pytest.warns(UserWarning, match="is 2 steps old, and the predictor is given the last 1 action") as told:
            steps(env)
        assert len(told) == 1
    steps(Networked(Counter(), channel, **settings | {"pending": 30}))


@pytest.mark.parametrize(
    ("inner", "action"),
    [
        ("Pendulum-v1", [np.nan]),
        ("Pendulum-v1", [0.1, 0.2]),
        ("CartPole-v1", 7),
    ],
)
def test_what_is_no_action_is_refused_where_it_is_sent_and_nothing_moves(inner, action):
    env, twin = (Networked(gym.make(inner), downlink=Channel(delay=2), neutral=NEUTRAL[inner]) for _ in "ab")
    env.reset(seed=0)
    twin.reset(seed=0)
    with pytest.raises(ValueError, match="is sent to the actuator, got"):
        env.step(action)
    for _ in range(4):
        one, other = (each.step(NEUTRAL[inner]) for each in (env, twin))
        np.testing.assert_array_equal(one[0], other[0])
    many = VectorNetworked(gym.make_vec(inner, num_envs=2), downlink=Channel(delay=2), neutral=NEUTRAL[inner])
    many.reset(seed=0)
    for wrong in (np.array([NEUTRAL[inner]] * 3), [action, action]):
        with pytest.raises(ValueError, match="is sent to the actuator, got"):
            many.step(wrong)


def test_a_step_before_the_first_reset_says_what_is_needed():
    for env in (Networked(gym.make("CartPole-v1")), VectorNetworked(gym.make_vec("CartPole-v1", num_envs=2))):
        with pytest.raises(gym.error.ResetNeeded, match="call reset before the first step"):
            env.step(env.action_space.sample())


class Writing(Counter):
    """Changes the action that it is given, as much code does."""

    def step(self, action):
        stepped = super().step(action)
        action *= 10.0
        return stepped


@pytest.mark.parametrize("is_vector", [False, True])
@pytest.mark.parametrize("downlink", [None, Channel(delay=2)])
def test_environments_may_change_their_actions_in_place(downlink, is_vector):
    neutral = np.array([0.25])
    given = {} if downlink is None else {"downlink": downlink, "neutral": neutral}
    env = VectorNetworked(SyncVectorEnv([Writing]), **given) if is_vector else Networked(Writing(), **given)
    neutral[:] = -1.0  # of whoever gave it
    for seed in range(2):
        env.reset(seed=seed)
        for k in range(6):
            action = np.array([k + 1.0])
            info = env.step(action[None] if is_vector else action)[-1]
            acted = k + 1.0 if downlink is None else [0.25, 0.25, 1.0, 2.0, 3.0, 4.0][k]
            assert np.ravel(info["acted"]) == np.ravel(info["action_applied"]) == acted
            assert action == k + 1.0
            action[:] = -9.0  # which is the agent's own
