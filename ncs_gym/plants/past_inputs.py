"""Past inputs as states of a plant: of inputs that take effect later, or of limits of how fast they change."""

from __future__ import annotations

import numpy as np

from ncs_gym.limits import LimitValues, Rows

# Rows of the box keep inputs under way within this many times their limits. They never leave those, so the rows only
# bound the safe set: closer ones would forbid inputs near their limit, farther ones enlarge the set by little.
STORED_INPUT_REACH = 4.0


def with_past_inputs(own: LimitValues, delay: int, change: np.ndarray | None) -> LimitValues:
    """Returns the plant with the inputs that it has to remember as further states: x, u_{k-d}, .., u_{k-1}.

    Args:
        own: The plant of its own states.
        delay: d, the steps after which an input takes effect.
        change: Largest change of each input from one step to the next, shape (m,); None for any.
    """
    (n, m), half = own.B.shape, own.input_half
    stored = m * (delay or int(change is not None))
    if not stored:
        return own
    A, B = np.zeros((n + stored, n + stored)), np.zeros((n + stored, m))
    A[:n, :n], A[n:-m, n + m :] = own.A, np.eye(stored - m)
    if delay:
        A[:n, n : n + m] = own.B
    else:
        B[:n] = own.B
    B[-m:] = np.eye(m)
    past = np.hstack([np.zeros((stored, n)), np.diag(np.tile(1.0 / (STORED_INPUT_REACH * half), stored // m))])
    box = [Rows(np.pad(own.box, ((0, 0), (0, stored))), own.box_ends)]
    box += [Rows(past, np.tile(own.input_ends / half, stored // m))]
    # An input that takes effect later is in the limits of states and inputs when it does, and a state by then.
    of_state, of_input = own.mixed_rows[:, :n], own.mixed_rows[:, n:]
    others = np.zeros((len(of_state), stored + (0 if delay else m)))
    others[:, slice(m) if delay else slice(stored, None)] = of_input
    coupled, mixed = Rows(np.hstack([of_state, others]), own.mixed_ends), []
    (box if delay else mixed).append(coupled)
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
