"""The shield's decision for many environments at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym.ellipsoid import is_inside
from shields import kernels
from shields.filter import MARGIN, SafetyFilter
from shields.plane import FARTHEST, SMALLEST_RADIUS

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
        outlooks: For the one-step test.
        certified: Whether a shape lies in one of the certificate's, (k,).
        extent: Half-widths, shape (k, n).
        largest: sqrt(lambda_max(M Sigma_k)) with its rounding, shape (k,).
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        self._filter = safety_filter
        n = safety_filter.plant.n
        self._index: dict[bytes, int] = {}
        zeros = np.zeros
        self.outlooks = kernels.Outlooks(
            zeros((FIRST_CAPACITY, n, n)), zeros(FIRST_CAPACITY), zeros(FIRST_CAPACITY), zeros(FIRST_CAPACITY, np.bool_)
        )
        self.certified = zeros(FIRST_CAPACITY, np.bool_)
        self.extent = zeros((FIRST_CAPACITY, n))
        self.largest = zeros(FIRST_CAPACITY)

    def number(self, shape: np.ndarray) -> int:
        """Returns the index of a shape, (n, n)."""
        key = shape.tobytes()
        if key not in self._index:
            self._index[key] = len(self._index)
            self._add(self._index[key], shape)
        return self._index[key]

    def _add(self, k: int, shape: np.ndarray) -> None:
        if k == len(self.largest):
            self.outlooks = kernels.Outlooks(*(np.concatenate([array, array]) for array in self.outlooks))
            for name in ("certified", "extent", "largest"):
                setattr(self, name, np.concatenate([getattr(self, name)] * 2))
        weight, radius, spread, usable = self.outlooks
        view = self._filter.test.shape_view(shape)
        usable[k] = view is not None
        if view is None:
            return
        weight[k], radius[k], spread[k] = view
        self.certified[k] = any(is_inside(shape, Sigma) for Sigma in self._filter.certificate.error_shapes)
        self.extent[k] = np.sqrt(np.abs(np.diag(shape)))
        self.largest[k] = self._filter.test.largest_error(shape)


class VectorFilter:
    """`SafetyFilter.decide` in batches, for error shapes that recur.

    Args:
        safety_filter: Whose decisions these are.
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        self.scalar, self.book = safety_filter, ShapeBook(safety_filter)
        test, plant, mode = safety_filter.test, safety_filter.plant, safety_filter.mode
        self._rule = kernels.Rule(
            moved=np.ascontiguousarray(test.moved),
            effect=np.ascontiguousarray(test.effect),
            columns=test.columns,
            gain=np.ascontiguousarray(safety_filter.certificate.K),
            limits=np.ascontiguousarray(plant.u_max),
            vertices=np.ascontiguousarray(test.vertices) if mode == "boundary" else np.zeros((0, plant.m)),
            pushed=test.pushed,
            rounding=test.rounding,
            margin=MARGIN,
            reserve=safety_filter.reserve,
            farthest=FARTHEST,
            smallest=SMALLEST_RADIUS,
            monitors=mode == "monitor",
            projects=mode == "project",
        )

    def decide(self, estimates: np.ndarray, numbers: np.ndarray, inputs_proposed: np.ndarray) -> Decisions:
        """Returns what to apply.

        Args:
            estimates: x_hat, shape (n, N).
            numbers: Indices in `book` of the error shapes Sigma_k, shape (N,).
            inputs_proposed: Within the limits, shape (m, N) [physical units].
        """
        count = numbers.size
        u = np.empty_like(inputs_proposed)
        intervened, passed, fallback = np.empty((3, count), np.bool_)
        margin, reason = np.empty(count), np.empty(count, np.int64)
        outlooks = self.book.outlooks
        flags = intervened, passed, fallback
        kernels.decide(self._rule, outlooks, numbers, estimates, inputs_proposed, u, *flags, margin, reason)
        return Decisions(u, intervened, passed, fallback, margin, reason)

    def margins(self, estimates: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Returns the margin of no input, shape (N,)."""
        zero = np.zeros((self.scalar.plant.m, numbers.size))
        u, codes = np.empty_like(zero), np.empty(numbers.size, np.int64)
        flags, margin = np.empty((3, numbers.size), np.bool_), np.empty(numbers.size)
        rule = self._rule._replace(monitors=True, projects=False)
        kernels.decide(rule, self.book.outlooks, numbers, estimates, zero, u, *flags, margin, codes)
        return margin
