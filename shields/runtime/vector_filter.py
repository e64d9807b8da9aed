"""The shield's decision for many environments at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym.uncertainty.ellipsoid import is_inside
from ncs_gym.validation import read_only
from shields.runtime.filter import MARGIN, SafetyFilter
from shields.runtime.judgement import (
    FELL_BACK,
    FLAGS,
    INTERVENED,
    PASSED,
    RADIUS,
    SPREAD,
    USABLE,
    WEIGHT,
    decide,
    override,
)
from shields.runtime.plane import FARTHEST, SMALLEST_RADIUS
from shields.runtime.rule import Rule, packed
from shields.runtime.tracking import CERTIFIED, EXTENT, LARGEST
from shields.runtime.tracking import USABLE as SEEN

REASONS = np.array(["safe", "projected", "fallback", "unsafe", "invalid"], dtype=object)
FIRST_CAPACITY = 256


class Decisions(NamedTuple):
    """What was decided, see `Decision`.

    Attributes:
        inputs: To apply, shape (m, N).
        intervened, passed, fallback: Shape (N,).
        margin: Shape (N,).
        reason: Codes, indices of REASONS, shape (N,).
    """

    inputs: np.ndarray
    intervened: np.ndarray
    passed: np.ndarray
    fallback: np.ndarray
    margin: np.ndarray
    reason: np.ndarray


class ShapeBook:
    """What a filter needs to know of error shapes, worked out once per shape by the scalar test.

    Attributes:
        outlooks: For the one-step test, shape (WEIGHT + n * n, k); see `judgement`.
        seen: For proofs, shape (EXTENT + n, k); see `tracking`.
        widest: Largest half-widths of all shapes, shape (n,); infinite once one of them is not certified.
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        self._filter = safety_filter
        n = safety_filter.plant.n
        self._index: dict[bytes, int] = {}
        self.outlooks = np.zeros((WEIGHT + n * n, FIRST_CAPACITY))
        self.seen = np.zeros((EXTENT + n, FIRST_CAPACITY))
        self.widest = np.zeros(n)

    def number(self, shape: np.ndarray) -> int:
        """Returns the index of a shape, (n, n)."""
        key = shape.tobytes()
        if key not in self._index:
            self._index[key] = len(self._index)
            self._add(self._index[key], shape)
        return self._index[key]

    def _add(self, k: int, shape: np.ndarray) -> None:
        if k == self.seen.shape[1]:
            self.outlooks, self.seen = (
                np.concatenate([rows, np.zeros_like(rows)], axis=1) for rows in (self.outlooks, self.seen)
            )
        outlook, seen = self.outlooks[:, k], self.seen[:, k]
        outlook[:] = seen[:] = 0.0
        view = self._filter.test.shape_view(shape)
        if view is None:
            self.widest[:] = np.inf
            return
        weight, outlook[RADIUS], outlook[SPREAD] = view
        outlook[USABLE], outlook[WEIGHT:] = 1.0, weight.ravel()
        seen[SEEN], seen[LARGEST] = 1.0, self._filter.test.largest_error(shape)
        seen[CERTIFIED] = any(is_inside(shape, Sigma) for Sigma in self._filter.certificate.error_shapes)
        seen[EXTENT:] = np.sqrt(np.abs(np.diag(shape)))
        self.widest = np.maximum(self.widest, seen[EXTENT:] if seen[CERTIFIED] else np.inf)


def overridden(actions: np.ndarray, decisions: Decisions, limits: np.ndarray) -> np.ndarray:
    """Returns the actions, shape (N, m), with those that stand for the inputs decided where the shield intervened."""
    numbers = np.asarray(actions)
    numbers = numbers if numbers.dtype == np.float32 else numbers.astype(np.float64)
    out = np.empty_like(numbers)
    override(numbers, decisions.intervened, decisions.inputs, limits, out)
    return out


class VectorFilter:
    """`SafetyFilter.decide` in batches, for error shapes that recur.

    Args:
        safety_filter: Whose decisions these are.
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        self.scalar, self.book = safety_filter, ShapeBook(safety_filter)
        test, plant, mode = safety_filter.test, safety_filter.plant, safety_filter.mode
        rule = Rule(
            moved=np.ascontiguousarray(test.moved),
            effect=np.ascontiguousarray(test.effect),
            columns=test.columns,
            gain=np.ascontiguousarray(safety_filter.certificate.K),
            limits=np.ascontiguousarray(plant.u_max),
            # Read-only as the others are: a kind of array more would compile everything once more.
            vertices=test.vertices if mode == "boundary" else read_only(np.zeros((0, plant.m))),
            pushed=test.pushed,
            rounding=test.rounding,
            margin=MARGIN,
            reserve=safety_filter.reserve,
            farthest=FARTHEST,
            smallest=SMALLEST_RADIUS,
            monitors=mode == "monitor",
            projects=mode == "project",
        )
        # Of decisions, and of margins without an input.
        self._rule, self._watching = packed(rule), packed(rule._replace(monitors=True, projects=False))

    def decide(self, estimates: np.ndarray, numbers: np.ndarray, inputs_proposed: np.ndarray) -> Decisions:
        """Returns what to apply.

        Args:
            estimates: x_hat, shape (n, N).
            numbers: Indices in `book` of the error shapes Sigma_k, shape (N,).
            inputs_proposed: Within the limits, shape (m, N) [physical units].
        """
        return self._decided(self._rule, estimates, numbers, inputs_proposed)

    def margins(self, estimates: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Returns the margin of no input, shape (N,)."""
        return self._decided(self._watching, estimates, numbers, np.zeros((self.scalar.plant.m, numbers.size))).margin

    def _decided(
        self, rule: tuple[np.ndarray, np.ndarray], estimates: np.ndarray, numbers: np.ndarray, proposed: np.ndarray
    ) -> Decisions:
        count = numbers.size
        u, flags = np.empty_like(proposed), np.empty((FLAGS, count), np.bool_)
        margin, reason = np.empty(count), np.empty(count, np.int64)
        decide(*rule, self.book.outlooks, numbers, estimates, proposed, u, flags, margin, reason)
        return Decisions(u, flags[INTERVENED], flags[PASSED], flags[FELL_BACK], margin, reason)
