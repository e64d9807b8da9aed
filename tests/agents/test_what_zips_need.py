"""Zips of stable-baselines3: their agents act as they did, nothing in them is unpickled, what they need is named."""

import pickle
import random

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import NormalizeObservation, RescaleAction
from sb3_contrib import TQC, TRPO, CrossQ, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch import nn

from agents import Agent, LoopConfig
from agents.agent import is_sb3_zip, load_sb3_zip
from agents.agent_file import AgentError
from agents.normalization import Normalization, read_statistics
from agents.pickled_data import Made, Named, array_of, pickled_data
from agents.sb3_vec_env import SB3VecEnv
from agents.training import untrained
from ncs_gym import TraceChannel
from tests.command import assert_one_sentence, ncs, succeeded
from tests.ncs_gym.networked.environments import Sampled

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
SMALL = {"net_arch": [8]}
REPLAY = {"buffer_size": 100, "learning_starts": 4}
OBSERVATIONS = np.random.default_rng(0).standard_normal((20, 3)).astype(np.float32) * [1.0, 1.0, 20.0]


def env(count=2, **settings):
    return SB3VecEnv(LoopConfig(env=CRUISE, kwargs=settings).vector(count))


def trained(cls, inner, steps=16, policy=None, **settings):
    """A model after a few steps, which is enough for its zip to say what it saw."""
    if cls in (PPO, RecurrentPPO, TRPO):
        settings |= {"n_steps": 8, "batch_size": 16}
    if cls not in (PPO, A2C, RecurrentPPO, TRPO):
        settings |= REPLAY
    return cls("MlpPolicy", inner, policy_kwargs=policy or dict(SMALL), seed=0, device="cpu", **settings).learn(steps)


def saved_with_statistics(folder, cls=PPO, zip_name="own.zip", pkl="vecnormalize.pkl", **settings):
    """A model under VecNormalize and its files: those of the folder, and both objects."""
    normalized = VecNormalize(env(), clip_obs=3.0, **settings)
    model = trained(cls, normalized)
    (folder / pkl).parent.mkdir(parents=True, exist_ok=True)
    model.save(folder / zip_name)
    normalized.save(str(folder / pkl))
    return model, normalized


def assert_acts_as(agent, model, observations):
    np.testing.assert_array_equal(agent.act(OBSERVATIONS), model.predict(observations, deterministic=True)[0])


@pytest.mark.parametrize("cls", [PPO, A2C, SAC, TD3])
def test_agent_trained_under_vec_normalize_acts_by_its_statistics_or_not_at_all(cls, tmp_path):
    model, normalized = saved_with_statistics(tmp_path, cls)
    with pytest.raises(AgentError, match=r"give --vec-normalize .*vecnormalize\.pkl, or --vec-normalize none"):
        load_sb3_zip(tmp_path / "own.zip", CRUISE)
    agent = load_sb3_zip(tmp_path / "own.zip", CRUISE, tmp_path / "vecnormalize.pkl")
    assert_acts_as(agent, model, normalized.normalize_obs(OBSERVATIONS))
    assert not np.array_equal(agent.act(OBSERVATIONS), model.predict(OBSERVATIONS, deterministic=True)[0])
    assert_acts_as(load_sb3_zip(tmp_path / "own.zip", CRUISE, "none"), model, OBSERVATIONS)


@pytest.mark.parametrize("cls", [PPO, A2C])
def test_zip_alone_tells_that_observations_were_normalized(cls, tmp_path):
    saved_with_statistics(tmp_path, cls, pkl="elsewhere/deep/statistics.pkl")
    with pytest.raises(AgentError, match="saw observations that VecNormalize normalized: give --vec-normalize FILE"):
        load_sb3_zip(tmp_path / "own.zip", CRUISE)


@pytest.mark.parametrize(
    ("zip_name", "pkl", "others"),
    [
        ("own.zip", "vec_normalize.pkl", ()),
        ("own.zip", "VecNormalize.PKL", ()),
        ("ncs_gym-TruckTrailerCruise-v0.zip", "ncs_gym-TruckTrailerCruise-v0/vecnormalize.pkl", ()),
        ("best_model.zip", "ncs_gym-TruckTrailerCruise-v0/vecnormalize.pkl", ()),
        (
            "rl_model_200_steps.zip",
            "rl_model_vecnormalize_200_steps.pkl",
            ("rl_model_vecnormalize_100_steps.pkl", "rl_model_vecnormalize_300_steps.pkl"),
        ),
    ],
)
def test_statistics_are_found_where_libraries_leave_them(zip_name, pkl, others, tmp_path):
    saved_with_statistics(tmp_path, SAC, zip_name, pkl)
    for other in others:
        (tmp_path / other).touch()
    with pytest.raises(AgentError, match="statistics of VecNormalize lie beside ") as caught:
        load_sb3_zip(tmp_path / zip_name, CRUISE)
    assert f"give --vec-normalize {tmp_path / pkl}, or" in str(caught.value)


@pytest.mark.filterwarnings("error")
def test_zip_that_says_that_it_saw_raw_observations_needs_no_statistics(tmp_path):
    model = trained(PPO, env())
    model.save(tmp_path / "own.zip")
    (tmp_path / "vecnormalize.pkl").touch()  # of another agent
    assert_acts_as(load_sb3_zip(tmp_path / "own.zip", CRUISE), model, OBSERVATIONS)
    with pytest.raises(AgentError, match="saw observations as they are: leave out --vec-normalize"):
        load_sb3_zip(tmp_path / "own.zip", CRUISE, tmp_path / "vecnormalize.pkl")


@pytest.mark.filterwarnings("error")
def test_zip_that_does_not_tell_is_refused_until_the_user_says_what_its_agent_saw(tmp_path):
    model = trained(SAC, env())
    model.save(tmp_path / "own.zip")
    with pytest.raises(AgentError, match=r"does not say whether VecNormalize .*: give --vec-normalize FILE, or --vec"):
        load_sb3_zip(tmp_path / "own.zip", CRUISE)
    assert_acts_as(load_sb3_zip(tmp_path / "own.zip", CRUISE, "none"), model, OBSERVATIONS)


def test_statistics_of_rewards_alone_leave_observations_as_they_are(tmp_path):
    model, _ = saved_with_statistics(tmp_path, norm_obs=False)
    assert_acts_as(load_sb3_zip(tmp_path / "own.zip", CRUISE, tmp_path / "vecnormalize.pkl"), model, OBSERVATIONS)


def test_statistics_of_other_observations_are_refused(tmp_path):
    model, _ = saved_with_statistics(tmp_path)
    other = VecNormalize(SB3VecEnv(LoopConfig(env="ncs_gym/CartPole-v0").vector(2)))
    other.save(str(tmp_path / "other.pkl"))
    with pytest.raises(AgentError, match=r"other.pkl has statistics of 5 entries, .* has 3"):
        load_sb3_zip(tmp_path / "own.zip", CRUISE, tmp_path / "other.pkl")
    assert model is not None


@pytest.mark.parametrize("protocol", [3, 4, 5])
@pytest.mark.parametrize("dtype", [np.float64, np.float32, ">f8"])
def test_numbers_of_every_pickle_are_those_that_unpickling_gives(protocol, dtype, tmp_path):
    normalized = VecNormalize(env(), epsilon=np.float64(1e-6))
    normalized.reset()
    statistics = normalized.obs_rms
    statistics.mean, statistics.var = statistics.mean.astype(dtype), np.asfortranarray(statistics.var).astype(dtype)
    (tmp_path / "v.pkl").write_bytes(pickle.dumps(normalized, protocol=protocol))
    found = read_statistics(tmp_path / "v.pkl")
    expected = Normalization.of(normalized)
    np.testing.assert_array_equal(found.mean, expected.mean)
    np.testing.assert_array_equal(found.variance, expected.variance)
    assert (found.epsilon, found.clip) == (expected.epsilon, expected.clip)


class Sprung(Exception):
    pass


class Trap:
    def __reduce__(self):
        return _spring, ()

    def __setstate__(self, state):
        _spring()


def _spring():
    raise Sprung


def test_settings_that_are_pickled_are_refused_unread(tmp_path):
    saved = PPO("MlpPolicy", env(), policy_kwargs=dict(SMALL), device="cpu")
    saved.policy_kwargs["trap"] = Trap()
    saved.save(tmp_path / "own.zip")
    with pytest.raises(AgentError, match="pickles are not read"):
        load_sb3_zip(tmp_path / "own.zip", CRUISE)


def test_what_fits_no_environment_or_is_no_zip_is_one_sentence(tmp_path):
    PPO("MlpPolicy", env(), policy_kwargs=dict(SMALL), device="cpu").save(tmp_path / "own.zip")
    with pytest.raises(AgentError, match="does not fit ncs_gym/CartPole-v0"):
        load_sb3_zip(tmp_path / "own.zip", "ncs_gym/CartPole-v0")
    (tmp_path / "no.zip").write_bytes(b"PK")
    with pytest.raises(AgentError, match="is no agent that stable-baselines3 saved"):
        load_sb3_zip(tmp_path / "no.zip", CRUISE)


@pytest.mark.parametrize("where", ["itself", "statistics", "mean", "epsilon", "unread"])
def test_nothing_in_a_file_of_statistics_is_run(where, tmp_path):
    normalized = VecNormalize(env())
    if where == "statistics":
        normalized.obs_rms = Trap()
    elif where == "mean":
        normalized.obs_rms.mean = Trap()
    elif where != "itself":
        setattr(normalized, where, Trap())
    (tmp_path / "v.pkl").write_bytes(pickle.dumps(Trap() if where == "itself" else normalized))
    with pytest.raises(Sprung):
        pickle.loads((tmp_path / "v.pkl").read_bytes())
    if where == "unread":
        assert read_statistics(tmp_path / "v.pkl") is not None
    else:
        with pytest.raises(AgentError, match=r"has no statistics that VecNormalize\.save wrote"):
            read_statistics(tmp_path / "v.pkl")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x80\x04.",
        b"cos\nsystem\n(S'true'\ntR.",
        b"\x80\x04\x95",
        b"\x80\x04(((((.",
        b"\x80\x04]\x94h\x05.",
        b"\x80\x04" + b"(" * 10_000 + b".",
        b"\x80\x04N\x8d" + b"\xff" * 8 + b".",
        b"PK\x03\x04",
        b"{}",
        pickle.dumps([1, 2]),
        pickle.dumps(np.zeros(3)),
    ],
)
def test_what_are_no_statistics_is_one_sentence(data, tmp_path):
    (tmp_path / "v.pkl").write_bytes(data)
    with pytest.raises(AgentError, match=r"has no statistics that VecNormalize\.save wrote") as caught:
        read_statistics(tmp_path / "v.pkl")
    assert "\n" not in str(caught.value)
    with pytest.raises(AgentError, match=r"cannot read .*nowhere\.pkl"):
        read_statistics(tmp_path / "nowhere.pkl")


class Forged:
    """What is pickled as an array of a type that has no state."""

    def __reduce__(self):
        made = np.zeros(3).__reduce__()
        return made[0], made[1], (*made[2][:2], ForgedType(), *made[2][3:])


class ForgedType:
    def __reduce__(self):
        return np.dtype, ("f8", False, True), ()


@pytest.mark.parametrize(
    ("name", "value"),
    [("epsilon", 10**400), ("clip_obs", -(10**400)), ("obs_rms.mean", Forged())],
    ids=["epsilon", "clip_obs", "mean"],
)
def test_numbers_that_are_none_in_a_file_of_statistics_are_one_sentence(name, value, tmp_path):
    normalized = VecNormalize(env())
    owner, _, own = name.rpartition(".")
    setattr(getattr(normalized, owner) if owner else normalized, own, value)
    (tmp_path / "v.pkl").write_bytes(pickle.dumps(normalized, protocol=4))
    with pytest.raises(AgentError, match=r"has no statistics that VecNormalize\.save wrote"):
        read_statistics(tmp_path / "v.pkl")


def test_damaged_statistics_are_refused_or_finite(tmp_path):
    normalized = VecNormalize(env())
    normalized.reset()
    whole, rng = pickle.dumps(normalized), random.Random(0)
    read = 0
    for _ in range(400):
        data = bytearray(whole)
        for _ in range(rng.randint(1, 3)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        (tmp_path / "v.pkl").write_bytes(data[: rng.choice([len(data), rng.randrange(len(data))])])
        try:
            found = read_statistics(tmp_path / "v.pkl")
        except AgentError:
            continue
        read += 1
        assert found is None or np.isfinite(found(OBSERVATIONS)).all()
    assert read > 10


def test_pickled_data_is_told_and_not_made():
    shared = [1, -2, 2**70, 0.5, None, True, "text", b"bytes", (1, 2, 3, 4), {3, 4}, frozenset({5})]
    data = {"a": shared, "b": shared, "class": nn.ReLU, "object": Trap()}
    found = pickled_data(pickle.dumps(data))
    assert found["a"] == found["b"] == shared
    assert found["class"] == Named("torch.nn.modules.activation.ReLU")
    assert isinstance(found["object"], Made)
    assert found["object"].name == f"{__name__}._spring"
    for value in (np.zeros((2, 3), order="F"), np.float64(3.0), np.zeros(0)):
        np.testing.assert_array_equal(array_of(pickled_data(pickle.dumps(value))), value)
    for value in (np.array([None]), np.array(["a"]), np.zeros(2, np.int64), "text", None):
        with pytest.raises(ValueError, match="it has"):
            array_of(pickled_data(pickle.dumps(value)))


@pytest.mark.parametrize("cls", [PPO, A2C, TRPO, SAC, TD3, DDPG, TQC, CrossQ])
def test_agent_of_every_algorithm_acts_as_the_model_did_and_is_saved_and_loaded(cls, tmp_path):
    policy = {} if cls in (A2C, CrossQ) else {"activation_fn": nn.ELU} | SMALL
    model = cls(
        "MlpPolicy", env(), policy_kwargs=policy, device="cpu", **(REPLAY if cls not in (PPO, A2C, TRPO) else {})
    )
    assert_saved_and_loaded(model, tmp_path)


def assert_saved_and_loaded(model, folder):
    """The agent of a model's zip acts as the model does, also after it was saved as an agent."""
    model.save(folder / "own.zip")
    assert is_sb3_zip(folder / "own.zip")
    agent = load_sb3_zip(folder / "own.zip", CRUISE, "none")
    assert_acts_as(agent, model, OBSERVATIONS)
    agent.save(folder / "agent")
    assert_acts_as(Agent.load(folder / "agent"), model, OBSERVATIONS)


@pytest.mark.parametrize("cls", [PPO, SAC])
def test_noise_that_depends_on_the_state_and_squashed_actions_are_taken_over(cls, tmp_path):
    policy = SMALL | ({"squash_output": True} if cls is PPO else {})
    assert_saved_and_loaded(trained(cls, env(), policy=policy, use_sde=True), tmp_path)


class Switch(Sampled):
    """Two actions, of which one may be masked; observations as in the cruise, or of another kind."""

    def action_masks(self):
        return np.array([True, False])


THREE = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
FRAMES = gym.spaces.Box(0, 255, (3, 36, 36), np.uint8)


class OwnPolicy(ActorCriticPolicy):
    pass


def of_wrapped(wrapper, **settings):
    return PPO("MlpPolicy", DummyVecEnv([lambda: wrapper(gym.make(CRUISE), **settings)]), policy_kwargs=dict(SMALL))


NEEDING = {
    "a recurrent state": lambda: RecurrentPPO("MlpLstmPolicy", env()),
    "action masks": lambda: MaskablePPO("MlpPolicy", Switch(THREE)),
    "observations that are dictionaries": lambda: PPO(
        "MultiInputPolicy", DummyVecEnv([lambda: Switch(gym.spaces.Dict(a=THREE))])
    ),
    "images": lambda: PPO("CnnPolicy", DummyVecEnv([lambda: Switch(FRAMES)])),
    "of none of the policies": lambda: DQN("MlpPolicy", Switch(THREE), buffer_size=10),
    "OwnPolicy": lambda: PPO(OwnPolicy, env()),
    "actions of another kind.*Discrete": lambda: PPO("MlpPolicy", Switch(THREE)),
    "of 4 stacked frames": lambda: PPO("MlpPolicy", VecFrameStack(env(), 4)),
    r"\(4,\): perhaps with observe=.* makes an id, and those here": lambda: PPO("MlpPolicy", env(observe=("age",))),
    "NormalizeObservation": lambda: of_wrapped(NormalizeObservation),
    "a wrapper that rescales them": lambda: of_wrapped(RescaleAction, min_action=-2.0, max_action=2.0),
}


@pytest.mark.parametrize("need", NEEDING)
def test_what_a_policy_needs_besides_is_named(need, tmp_path):
    NEEDING[need]().save(tmp_path / "own.zip")
    with pytest.raises(AgentError, match=need) as caught:
        load_sb3_zip(tmp_path / "own.zip", CRUISE, "none")
    assert "\n" not in str(caught.value)


def test_other_bounds_of_observations_are_told_of(tmp_path):
    PPO("MlpPolicy", env(task={"fastest": 5.0})).save(tmp_path / "own.zip")
    with pytest.warns(UserWarning, match="saw observations within other bounds"):
        load_sb3_zip(tmp_path / "own.zip", CRUISE, "none")


def test_agent_of_a_recorded_channel_is_saved_and_loaded(tmp_path):
    """The channel's file has what the channel has: `save` writes nothing that `load` refuses."""
    agent = untrained(LoopConfig(env=CRUISE, kwargs={"channel": TraceChannel(trace=(0, 1, -1))}), seed=0)
    agent.save(tmp_path)
    assert Agent.load(tmp_path).channel == agent.channel == TraceChannel(trace=(0, 1, -1))


def test_command_refuses_without_and_evaluates_with_the_statistics(tmp_path):
    saved_with_statistics(tmp_path)
    given = "evaluate", tmp_path / "own.zip", "--env", CRUISE, "--episodes", 2, "--shield", "none"
    assert_one_sentence(ncs(*given), "saw observations that VecNormalize normalized: give --vec-normalize", "pkl, or")
    run = succeeded(*given, "--vec-normalize", tmp_path / "vecnormalize.pkl")
    assert f"with --vec-normalize {tmp_path / 'vecnormalize.pkl'}" in run.prose


def test_statistics_for_what_is_no_zip_are_refused(tmp_path):
    given = "evaluate", "pretrained", "--env", CRUISE, "--vec-normalize", tmp_path / "vecnormalize.pkl"
    assert_one_sentence(ncs(*given), "--vec-normalize is for zips of stable-baselines3")
