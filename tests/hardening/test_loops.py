"""Random sequences of steps, resets and bad actions, and random stacks of wrappers around and inside a shield."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from hypothesis import given
from hypothesis import strategies as st

from ncs_gym import Channel
from tests.fuzz import NOTHING_USABLE, examples
from tests.product import loop_env, safety_shield, vector_env, vector_shield

# Inside a safe set, and outside of any.
CHANNEL = Channel(0.3, quantization_step=0.05, send_period=2, delay=1, jitter=1)
STARTS = [[0.0, 0.0], [0.3, -0.1], [5.0, 5.0]]
BAD_ACTIONS = [*NOTHING_USABLE, np.nan, [np.nan], [np.inf], [0.0, 0.0], [[0.0]], None, 0.5, np.zeros(0), {"u": 1.0}]
BAD_OPTIONS = [{"state": [np.nan, 0.0]}, {"state": [1.0]}, {"start": [0.0, 0.0]}, 3]
MOVES = st.lists(
    st.tuples(st.just("step"), st.floats(-3.0, 3.0))
    | st.tuples(st.just("bad step"), st.sampled_from(BAD_ACTIONS))
    | st.tuples(st.just("reset"), st.sampled_from([None, *STARTS]))
    | st.tuples(st.just("bad reset"), st.sampled_from(BAD_OPTIONS)),
    min_size=5,
    max_size=40,
)


def flat(value):
    """What an environment returned, as one tuple of texts: equal exactly if every bit is."""
    if isinstance(value, dict):
        return tuple((key, flat(value[key])) for key in sorted(value))
    if isinstance(value, tuple):
        return tuple(flat(each) for each in value)
    array = np.asarray(value)
    return str(array.dtype), array.shape, array.tolist() if array.dtype == object else array.tobytes()


def played(env, moves, count=None):
    """What the good ones of some moves return; bad ones must be refused and leave no trace."""
    returned = [env.reset(seed=5)]
    for kind, value in moves:
        if kind == "step":
            action = np.full((1,) if count is None else (count, 1), value)
            returned.append(env.step(action))
        elif kind == "reset":
            returned.append(env.reset(options=None if value is None else {"state": value}))
        elif kind == "bad step":
            with pytest.raises(ValueError, match=r"must be finite with shape"):
                env.step(value)
        else:
            with pytest.raises(ValueError, match=r"option"):
                env.reset(options=value)
    return [flat(each) for each in returned]


def pair(kind, certificate, loaded):
    """Two equal loops of a kind, and how many environments each has."""
    settings = {
        "plant": loaded,
        "channel": CHANNEL,
        "disturbance": "sphere",
    }
    if kind == "scalar":
        return [loop_env(**settings) for _ in range(2)], None
    if kind == "shield":
        return [safety_shield(loop_env(**settings), certificate) for _ in range(2)], None
    many = [vector_env(2, max_episode_steps=6, **settings) for _ in range(2)]
    return [vector_shield(env, certificate) for env in many] if kind == "vector shield" else many, 2


@pytest.mark.parametrize("kind", ["scalar", "vector", "shield", "vector shield"])
@given(moves=MOVES)
@examples(6)
def test_refused_actions_and_resets_move_nothing(kind, certificate, loaded, moves):
    (one, other), count = pair(kind, certificate, loaded)
    good = [move for move in moves if not move[0].startswith("bad")]
    assert played(one, moves, count) == played(other, good, count)


# Wrappers that look, those that change what is done, and those that do so without saying it.
HARMLESS = {
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 15),
    "OrderEnforcing": wrappers.OrderEnforcing,
    "PassiveEnvChecker": wrappers.PassiveEnvChecker,
    # Under a key of its own: a second one of the same key ends in an assertion of gymnasium.
    "RecordEpisodeStatistics": lambda env: wrappers.RecordEpisodeStatistics(env, stats_key=f"episode {id(env)}"),
    "FlattenObservation": wrappers.FlattenObservation,
    "NormalizeObservation": wrappers.NormalizeObservation,
    "NormalizeReward": wrappers.NormalizeReward,
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 2),
    "DelayObservation": lambda env: wrappers.DelayObservation(env, 1),
    "TransformReward": lambda env: wrappers.TransformReward(env, lambda reward: 2.0 * reward - 1.0),
    "ClipReward": lambda env: wrappers.ClipReward(env, -1.0, 0.0),
    "TransformObservation": lambda env: wrappers.TransformObservation(env, lambda seen: 0.0 * seen, None),
}
CHANGING = {
    "ClipAction": wrappers.ClipAction,
    "RescaleAction": lambda env: wrappers.RescaleAction(env, np.float32(-2.0), np.float32(5.0)),
    "TransformAction": lambda env: wrappers.TransformAction(env, lambda action: -action, None),
    "StickyAction": lambda env: wrappers.StickyAction(env, 0.5),
    "RepeatAction": lambda env: wrappers.RepeatAction(env, 2),
    "MaxAndSkip": lambda env: wrappers.MaxAndSkipObservation(env, 2),
    "Autoreset": wrappers.Autoreset,
}


class Meddler(gym.Wrapper):
    """A wrapper of nobody's: changes actions, steps twice or resets by itself, without saying so."""

    def __init__(self, env, what):
        super().__init__(env)
        self.what = what

    def step(self, action):
        if self.what == "twice":
            self.env.step(action)
        if self.what == "resets":
            self.env.reset(options={"state": [0.99, 0.0]})
        return self.env.step(-np.asarray(action) if self.what == "turns" else action)


MEDDLERS = {what: lambda env, what=what: Meddler(env, what) for what in ("twice", "resets", "turns")}
ALL = HARMLESS | CHANGING | MEDDLERS
STACK = st.lists(st.sampled_from(sorted(ALL)), max_size=4)


def stacked(env, names):
    for name in names:
        env = ALL[name](env)
    return env


@given(
    inside=STACK,
    outside=STACK,
    mode=st.sampled_from(["project", "switch", "boundary"]),
    start=st.sampled_from([None, *STARTS]),
    seed=st.integers(0, 1000),
)
@examples(12)
def test_whatever_stands_around_a_guard_its_proof_is_right(certificate, loaded, inside, outside, mode, start, seed):
    """Where the shield says guaranteed the true state is in S, and it says so all along from a start in S."""
    bare = loop_env(loaded, Channel(0.5, quantization_step=0.05, delay=1), disturbance="adversarial")
    env = stacked(safety_shield(stacked(bare, inside), certificate, mode), outside)
    rng, claims = np.random.default_rng(seed), 0
    env.reset(seed=seed, options=None if start is None else {"state": start})
    for _ in range(25):
        _, _, terminated, truncated, _ = env.step(rng.uniform(0.0, 1.5, 1).astype(np.float32))
        if not bare.guard.code:
            claims += 1
            assert certificate.safe_set.gauge(bare.state) <= 1.0
        if terminated or truncated:
            env.reset()
    assert claims == 25 or start == STARTS[-1]
