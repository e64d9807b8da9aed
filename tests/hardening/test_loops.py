"""Random sequences of steps, resets and bad actions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ncs_gym import Channel
from tests.fuzz import NOTHING_USABLE, examples
from tests.product import loop_env, safety_shield, vector_env, vector_shield

# Inside a safe set, and outside of any.
CHANNEL = Channel(0.3, quantization_step=0.05, send_period=2, delay=1, jitter=1)
STARTS = [[0.0, 0.0], [0.3, -0.1], [5.0, 5.0]]
BAD_ACTIONS = [*NOTHING_USABLE, np.nan, [np.nan], [np.inf], [0.0, 0.0], [[0.0]], None, 0.5, np.zeros(0), {"u": 1.0}]
BAD_OPTIONS = [{"state": [np.nan, 0.0]}, {"state": [1.0]}, {"start": [0.0, 0.0]}, {1: 2}, 3, {"channel": 0.3}]
BAD_OPTIONS += [{"channel": Channel(quantization_step=0.1)}, {"downlink": Channel()}]
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
            with pytest.raises(ValueError, match=r"option|channel|downlink"):
                env.reset(options=value)
    return [flat(each) for each in returned]


def pair(kind, certificate, loaded):
    """Two equal loops of a kind, and how many environments each has."""
    settings = {"plant": loaded, "channel": CHANNEL, "disturbance": "sphere"}
    if kind == "scalar":
        return [loop_env(**settings) for _ in range(2)], None
    if kind == "shield":
        return [safety_shield(loop_env(**settings), certificate) for _ in range(2)], None
    many = [vector_env(2, max_episode_steps=6, **settings) for _ in range(2)]
    return [vector_shield(env, certificate) for env in many] if kind == "vector shield" else many, 2


@pytest.mark.parametrize("kind", ["scalar", "vector", "shield", "vector shield"])
@given(moves=MOVES)
@examples(4)
def test_refused_actions_and_resets_move_nothing(kind, certificate, loaded, moves):
    (one, other), count = pair(kind, certificate, loaded)
    good = [move for move in moves if not move[0].startswith("bad")]
    assert played(one, moves, count) == played(other, good, count)
