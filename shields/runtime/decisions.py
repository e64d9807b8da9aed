"""What a decision of the shield says."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ncs_gym.validation import read_only

REASONS = ("safe", "projected", "fallback", "unsafe", "invalid", "planned", "stored")
SAFE, PROJECTED, FALLBACK, UNSAFE, INVALID, PLANNED, STORED = range(7)
NO_PLAN = read_only(np.empty((0, 0)))


class Decision(NamedTuple):
    """What the shield decided; of many decisions, arrays whose last axis is the environment.

    S is the certificate's safe set: its polytope, or its ellipsoid if it has none.

    Attributes:
        input: Input to apply, shape (m,), within the limits; u_max times a float32 action if not the proposed one.
        intervened: Whether it differs from the proposed one, so that `~intervened` is a mask of proposals that may act;
            in mode "monitor": whether that of "switch" would differ.
        proved: Whether the input to apply, not the proposed one, meets the one-step test, so that x+ is in S even if x
            is not, or begins a certified plan, so that x+ is in the box and what is left of the plan keeps it there.
        fallback: Whether it is K x_hat, so that x+ is in S if x is and Sigma_k lies inside the certificate's Sigma.
        margin: 1 - h - |A x_hat + B u|_M at the input to apply, where h is the farthest that error and disturbance
            move x+, measured by |.|_M. Positive only if the test is met; the test is sharper and admits some inputs
            for which this is slightly negative. With a polytope it is the least that is left of a row. NaN without a
            usable estimate.
        reason: "safe" (passed as proposed), "projected", "fallback" (u = K x_hat), "unsafe" (applied as proposed by
            "monitor"), or "invalid" (what was proposed is no input within the limits, or estimate or error shape is
            unusable: u = K x_hat, zero without a usable estimate, in "monitor" what was proposed if it is an input).
            In mode "lookahead" also "planned" (a new plan begins, perhaps with the input proposed) and "stored" (the
            next input of the stored plan, also in the place of "invalid"). Of many decisions, indices of `REASONS`.
        plan: Inputs still stored after this decision, shape (k, m), to be handed to the next one; of many decisions
            shape (horizon, m, N), NaN beyond a plan's end. Empty in other modes than "lookahead".
        stored: Whether the input is the next one of the stored plan.
    """

    input: np.ndarray
    intervened: Any
    proved: Any
    fallback: Any
    margin: Any
    reason: Any
    plan: np.ndarray = NO_PLAN
    stored: Any = False
