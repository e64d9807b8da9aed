"""Past inputs as states of a plant: of inputs that take effect later, or of limits of how fast they change."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym.limits import Rows, joined
from ncs_gym.model import Model

# Rows of the box keep inputs under way within this many times their limits. They never leave those, so the rows only
# bound the safe set: closer ones would forbid inputs near their limit, farther ones enlarge the set by little.
STORED_INPUT_REACH = 4.0


class Larger(NamedTuple):
    """The model and the rows of a plant of which so many last states are past inputs, the oldest input first."""

    A: np.ndarray
    B: np.ndarray
    H: np.ndarray
    box: Rows
    mixed: Rows
    past: int


def with_past_inputs(
    model: Model, box: Rows, mixed: Rows, inputs: tuple[np.ndarray, np.ndarray], change: np.ndarray | None
) -> Larger:
    """Returns the plant with the inputs that it has to remember as further states: x, u_{k-d}, .., u_{k-1}.

    Args:
        model: Of its own states; its delays are d.
        box: Rows of its own states.
        mixed: Rows of states and inputs together.
        inputs: The ends of the inputs, shape (2, m), and half their range, (m,).
        change: Largest change of each input from one step to the next, shape (m,); None for any.
    """
    (n, m), delay, (input_ends, half) = model.B.shape, model.delays, inputs
    stored = m * (delay or int(change is not None))
    if not stored:
        return Larger(model.A, model.B, model.H, box, mixed, 0)
    A, B = np.zeros((n + stored, n + stored)), np.zeros((n + stored, m))
    A[:n, :n], A[n:-m, n + m :] = model.A, np.eye(stored - m)
    if delay:
        A[:n, n : n + m] = model.B
    else:
        B[:n] = model.B
    B[-m:] = np.eye(m)
    past = np.hstack([np.zeros((stored, n)), np.diag(np.tile(1.0 / (STORED_INPUT_REACH * half), stored // m))])
    rows = [Rows(np.pad(box.rows, ((0, 0), (0, stored))), box.low, box.high)]
    rows += [Rows(past, *np.tile(input_ends / half, stored // m))]
    # An input that takes effect later is in the limits of states and inputs when it does, and a state by then.
    of_state, of_input = mixed.rows[:, :n], mixed.rows[:, n:]
    others = np.zeros((len(of_state), stored + (0 if delay else m)))
    others[:, slice(m) if delay else slice(stored, None)] = of_input
    coupled = Rows(np.hstack([of_state, others]), mixed.low, mixed.high)
    if delay:
        rows, coupled = [*rows, coupled], Rows(np.empty((0, n + stored + m)), np.empty(0), np.empty(0))
    if change is not None:
        rates = np.hstack([np.zeros((m, n + stored - m)), -np.eye(m), np.eye(m)]) / change[:, None]
        coupled = joined([coupled, Rows(rates, *np.array([[-1.0], [1.0]]) * np.ones(m))])
    return Larger(A, B, np.pad(model.H, ((0, 0), (0, stored))), joined(rows), coupled, stored)
