"""The one-step test: which inputs keep every possible next state in the safe set."""

from __future__ import annotations

from functools import cached_property
from itertools import product
from math import isfinite

import numpy as np
from scipy.linalg.lapack import dsyev

from ncs_gym import LinearPlant
from ncs_gym.ellipsoid import SMALLEST_SHARE
from ncs_gym.frozen import read_only
from shields.plane import PlaneOutlook, outlook_in_plane
from shields.projection import closest_admissible, closest_on_line

# The test of all inputs looks at the 2^m vertices of the input box.
MOST_INPUTS_WITH_VERTICES = 12


class OneStepTest:
    """Whether everything one step can reach lies in S = {x : x'Mx <= 1} (docs/shield.md, "One step").

    x+ lies in {c} + E(Sigma_pred) with c = A x_hat + B u. In coordinates where M = I, with p_i the eigenvalues of
    Sigma_pred, c_i the coordinates of c along their axes and h = sqrt(max p), that set is inside S if

        sum_i (1-h) h / (h - p_i) c_i^2 <= (1-h)^2,

    the exact containment test at the multiplier that is best if all p_i are equal. It admits more than |c|_M <= 1 - h,
    since every weight is at most 1, and is as cheap: the inputs that pass form an ellipsoid in both.

    Args:
        M: Shape (n, n), positive definite.
        plant: Gives A, B, D and the limits.
    """

    def __init__(self, M: np.ndarray, plant: LinearPlant) -> None:
        self.plant = plant
        self.root = read_only(np.linalg.cholesky(M).T)
        self.moved = read_only(self.root @ plant.A)
        self.effect = read_only(self.root @ plant.B)
        self.D = read_only(self.root @ plant.disturbance.shape @ self.root.T)
        # The trace-optimal share of the ellipsoid around E(Sigma_k moved) + E(D) needs the traces of both.
        self._gram = self.moved.T @ self.moved
        self._second = float(np.trace(self.D)) ** 0.5
        # Two states and one input, the commonest small plant, go ten times faster in plain floats.
        self._plane = None
        if (plant.n, plant.m) == (2, 1):
            self._plane = (self.moved.tolist(), self.effect[:, 0].tolist(), self.D.tolist(), plant.u_max.item())

    @cached_property
    def vertices(self) -> np.ndarray:
        """Corners of the input box, shape (2^m, m)."""
        return read_only(np.array(list(product(*((-limit, limit) for limit in self.plant.u_max.tolist())))))

    def at(self, estimate: np.ndarray, error_shape: np.ndarray) -> Outlook | PlaneOutlook | None:
        """Returns the test at an estimate and its error ellipsoid; None if it cannot be computed from them.

        Args:
            estimate: x_hat, shape (n,), float64.
            error_shape: Sigma_k, shape (n, n), float64.
        """
        n = self.plant.n
        if estimate.shape != (n,) or error_shape.shape != (n, n):
            return None
        if self._plane is not None:
            return outlook_in_plane(*self._plane, estimate.tolist(), error_shape.tolist())
        first = float(
            np.vdot(self._gram, error_shape)
        )  # the trace of G A Sigma_k A' G', NaN or infinite if an entry is
        if not (isfinite(first) and error_shape.diagonal().min() >= 0.0):
            return None
        first = max(abs(first) ** 0.5, SMALLEST_SHARE * self._second)
        predicted = self.moved.dot(error_shape).dot(self.moved.T)
        predicted = predicted * (1.0 + self._second / first) + self.D * (1.0 + first / self._second)
        values, axes, failed = dsyev(predicted)  # numpy's eigh, without its three times longer preparation
        offset = self.moved.dot(estimate)
        if failed or not isfinite(float(values[0]) + float(values[-1]) + float(offset.dot(offset))):
            return None
        return Outlook(self, offset, values, axes)


class Outlook:
    """The test at one estimate: an input u keeps x+ in S if |offset + effect u| <= radius in the norm of the test.

    Args:
        test: What holds at every estimate.
        offset: G A x_hat, shape (n,), where |z|_M = |G z|.
        values: Eigenvalues of G Sigma_pred G', shape (n,), ascending.
        axes: Its eigenvectors, shape (n, n).

    Attributes:
        radius: 1 - h; no input passes unless it is positive.
    """

    def __init__(self, test: OneStepTest, offset: np.ndarray, values: np.ndarray, axes: np.ndarray) -> None:
        h = float(values[-1]) ** 0.5
        self.radius = 1.0 - h
        self._test, self._reached = test, offset
        turn = axes * np.sqrt(h * (1.0 - h) / (h - values)) if h < 1.0 else axes
        self._offset, self._effect = offset.dot(turn), test.effect.T.dot(turn)

    def judge(self, u: list[float]) -> tuple[float, float]:
        """Returns room and margin of an input u, m numbers.

        The room is radius - |offset + effect u|: x+ is in S unless it is negative. The margin is
        1 - h - |A x_hat + B u|_M, which is at most the room.
        """
        moved = self._offset + np.dot(u, self._effect)
        reached = self._reached + np.dot(u, self._test.effect.T)
        return self.radius - float(moved.dot(moved)) ** 0.5, self.radius - float(reached.dot(reached)) ** 0.5

    def smallest_room(self) -> float:
        """Returns the room of the worst input within the limits: a vertex, since the norm is convex."""
        moved = self._offset + self._test.vertices @ self._effect
        return self.radius - float((moved * moved).sum(axis=1).max()) ** 0.5

    def closest(self, u: list[float], reserve: float) -> list[float] | None:
        """Returns the input within the limits, m numbers, closest to u with a room of `reserve`; None if none has."""
        target = self.radius - reserve
        if len(u) > 1:
            found = closest_admissible(np.array(u), self._offset, self._effect.T, target, self._test.plant.u_max)
            return None if found is None else found.tolist()
        effect, offset = self._effect[0], self._offset
        a, b, c = float(effect @ effect), float(effect @ offset), float(offset @ offset)
        found = closest_on_line(u[0], a, b, c, target, self._test.plant.u_max.item())
        return None if found is None else [found]
