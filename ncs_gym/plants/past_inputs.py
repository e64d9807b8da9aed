"""Past inputs as states of a plant: of inputs that take effect later, or of limits of how fast they change."""

from __future__ import annotations

import numpy as np

from ncs_gym.limits import LimitValues, Rows

# Rows of the box keep inputs under way within this many times their limits, which they never leave: the rows only bound
# the safe set. Closer ones would forbid inputs near their limit, farther ones enlarge the set by little.
STORED_INPUT_REACH = 4.0


def acting(delays: np.ndarray, past: int) -> np.ndarray:
    """Returns which of past and then present inputs act now, shape (m,), by delays of shape (n, m).

    Raises:
        ValueError: If an input acts on several states with several delays.
    """
    if np.ptp(delays, axis=0).any():
        raise ValueError("another process, or a limit of states and inputs together, needs one delay per input")
    return past - delays.shape[1] * delays[0] + np.arange(delays.shape[1])


def with_past_inputs(own: LimitValues, delays: np.ndarray, change: np.ndarray | None) -> LimitValues:
    """Returns the plant of the states x, u_{k-d}, .., u_{k-1}, with as many past inputs as it has to remember.

    Args:
        own: The plant of x.
        delays: As of its model, shape (n, m); d is the largest.
        change: Largest change of each input from one step to the next, shape (m,); None for any.

    Raises:
        ValueError: If a limit of states and inputs together does not say which past input it means.
    """
    (n, m), half, d = own.B.shape, own.input_half, int(delays.max())
    stored = m * (d or int(change is not None))
    if not stored:
        return own
    A, B = np.zeros((n + stored, n + stored)), np.zeros((n + stored, m))
    A[:n, :n], A[n:-m, n + m :], B[-m:] = own.A, np.eye(stored - m), np.eye(m)
    B[:n] = np.where(delays == 0, own.B, 0.0)
    for steps in range(1, d + 1):
        A[:n, n + stored - m * steps :][:, :m] = np.where(delays == steps, own.B, 0.0)
    past = np.hstack([np.zeros((stored, n)), np.diag(np.tile(1.0 / (STORED_INPUT_REACH * half), stored // m))])
    box = [Rows(np.pad(own.box, ((0, 0), (0, stored))), own.box_ends)]
    box += [Rows(past, np.tile(own.input_ends / half, stored // m))]
    # An input that takes effect later is in the limits of states and inputs when it does, and a state by then.
    of_state, of_input = own.mixed_rows[:, :n], own.mixed_rows[:, n:]
    others = np.zeros((len(of_state), stored + m))
    if len(others):
        others[:, acting(delays, stored)] = of_input
    is_now, coupled = others[:, stored:].any(axis=1), np.hstack([of_state, others])
    box.append(Rows(coupled[~is_now, : n + stored], own.mixed_ends[:, ~is_now]))
    mixed = [Rows(coupled[is_now], own.mixed_ends[:, is_now])]
    if change is not None:
        rates = np.hstack([np.zeros((m, n + stored - m)), -np.eye(m), np.eye(m)]) / change[:, None]
        mixed.append(Rows(rates, np.outer([-1.0, 1.0], np.ones(m))))
    limited, together = Rows.joined(box, n + stored), Rows.joined(mixed, n + stored + m)
    number = np.arange(len(limited.rows)) - len(own.box)
    return own.replaced(
        A=A,
        B=B,
        H=np.pad(own.H, ((0, 0), (0, stored))),
        box=limited.rows,
        box_ends=limited.ends,
        is_past_row=(number >= 0) & (number < stored),
        mixed_rows=together.rows,
        mixed_ends=together.ends,
        operating_state=np.concatenate([own.operating_state, np.tile(own.operating_input, stored // m)]),
        step_offset=np.pad(own.step_offset, (0, stored)),
        past=stored,
    )
