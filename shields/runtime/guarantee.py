"""Tracks whether the proof of safety holds, step by step."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym import Ellipsoid
from ncs_gym.plants.linear_plant import SIMULATED_REACH
from ncs_gym.uncertainty.ellipsoid import is_inside
from ncs_gym.validation import as_numbers
from shields.certificate import Certificate
from shields.runtime.filter import Decision, SafetyFilter
from shields.verification.rational_matrix import is_positive_semidefinite, rational, subtract

ALARM = "a measurement contradicts the assumed bounds"
OTHER_INPUT = "the input applied is not the one decided"
OTHER_STEPS = "the environment did not move exactly one step"
LARGE_ERROR = "the error ellipsoid is not inside the certified one"
FAR_OUT = "the estimate is so far out of the safe box that rounding counts"
UNUSABLE = "the environment reports no usable estimate or error shape"
NO_ERROR_SET = "a certificate of the published method carries no error set"
NOT_KNOWN_INSIDE = "the state is not known to be in the safe set"


class ProofTracker:
    """Whether x in S is proved now, and why not (docs/shield.md, "How you see that an assumption broke").

    An alarm of the innovation monitor, an input other than the decided one, a step that is not one step and an estimate
    so far out that rounding counts break the error bound for the rest of the episode. The others are recoverable: a
    passed test proves the next state in S without x in S, and a running ellipsoid outside E(Sigma) is still a bound,
    only K x_hat is not proved safe with it.
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        self._filter = safety_filter
        self._reach = SIMULATED_REACH * safety_filter.plant.half_widths
        self._broken = ""
        self._error_certified = False
        self._inside = False

    @property
    def reason(self) -> str:
        """Why the proof does not hold now; empty while it does."""
        if self._broken:
            return self._broken
        if self._filter.certificate.Sigma is None:
            return NO_ERROR_SET
        if not self._inside:
            return NOT_KNOWN_INSIDE
        return "" if self._error_certified else LARGE_ERROR

    def start(self, known_inside: bool, at_start: bool, info: dict[str, Any]) -> None:
        """Begins an episode.

        Args:
            known_inside: Whether every possible start lies in S (`starts_inside`).
            at_start: Whether the environment has not moved since.
            info: The environment's, from reset.
        """
        self._broken = "" if at_start else OTHER_STEPS
        self._inside = known_inside
        self._observe(info)

    def step(self, decision: Decision, one_step: bool, info: dict[str, Any]) -> None:
        """Moves one step on.

        Args:
            decision: What was decided before the step.
            one_step: Whether the environment moved exactly one step since the last call.
            info: The environment's, from step.
        """
        carried = self._inside and self._error_certified and decision.fallback
        self._inside = decision.passed or carried
        if not one_step:
            self._broken = self._broken or OTHER_STEPS
        elif not np.array_equal(info["input"], decision.input):
            self._broken = self._broken or OTHER_INPUT
        self._observe(info)

    def _observe(self, info: dict[str, Any]) -> None:
        """Takes in the alarm, the running ellipsoid, and what the estimate alone proves."""
        if info["assumption_violated"] not in (False,):
            self._broken = self._broken or ALARM
        estimate, error_shape = as_numbers(info["estimate"]), as_numbers(info["error_shape"])
        if estimate is None or error_shape is None or self._filter.test.at(estimate, error_shape) is None:
            self._error_certified = False
            self._broken = self._broken or UNUSABLE
            return
        if not (np.abs(estimate) + np.sqrt(np.abs(np.diag(error_shape))) <= self._reach).all():
            self._broken = self._broken or FAR_OUT
        # K x_hat is proved safe with any of the certified sets; that of another age serves as well.
        shapes = self._filter.certificate.error_shapes
        self._error_certified = any(is_inside(error_shape, Sigma) for Sigma in shapes)
        if not self._inside:
            self._inside = self._filter.knows_inside(estimate, error_shape)


def starts_inside(certificate: Certificate, initial: Ellipsoid | np.ndarray) -> bool:
    """Returns whether all possible starts lie in S, decided in exact arithmetic.

    Args:
        certificate: Gives S = E(L).
        initial: An ellipsoid E(P), inside S exactly if L - P >= 0; or a single state, shape (n,), inside S exactly if
            [1, x'; x, L] >= 0.
    """
    L = rational(certificate.L)
    if isinstance(initial, Ellipsoid):
        return is_positive_semidefinite(subtract(L, rational(initial.shape)))
    state = rational(initial)[0]
    one = rational(np.ones(1))[0]
    return is_positive_semidefinite([one + state] + [[x, *row] for x, row in zip(state, L, strict=True)])
