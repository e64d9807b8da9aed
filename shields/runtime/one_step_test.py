"""The one-step test: which inputs keep every possible next state in the safe set."""

from __future__ import annotations

from functools import cached_property
from itertools import product
from math import isfinite, sqrt

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dsyev  # pyright: ignore[reportAttributeAccessIssue]  # f2py makes them

from ncs_gym import LinearPlant
from ncs_gym.uncertainty.ellipsoid import SMALLEST_SHARE
from ncs_gym.validation import read_only
from shields.certificate import CertificateError
from shields.runtime.plane import FARTHEST, INDEFINITE, SMALLEST_RADIUS, PlaneOutlook, outlook_in_plane
from shields.runtime.projection import closest_admissible, closest_on_line
from shields.verification.rational_matrix import congruence, is_positive_semidefinite, rational, subtract

# The test of all inputs looks at the 2^m vertices of the input box.
MOST_INPUTS_WITH_VERTICES = 12
# Growths of the root that are tried until it provably does not understate the norm of S.
ROOT_GROWTHS = (1e-13, 1e-12, 1e-11, 1e-10, 1e-9)


class OneStepTest:
    """Whether everything one step can reach lies in S = {x : x'Mx <= 1} = E(L) (docs/shield.md, "One step").

    x+ lies in {c} + E(Sigma_pred) with c = A x_hat + B u. In coordinates where M = I, with p_i the eigenvalues of
    Sigma_pred, c_i the coordinates of c along their axes and h = sqrt(max p) < 1, that set is inside S if

        sum_i (1-h) h / (h - p_i) c_i^2 <= (1-h)^2,

    the exact containment test at the multiplier that is best if all p_i are equal. It admits more than |c|_M <= 1 - h,
    since every weight is at most 1, and is as cheap: the inputs that pass form an ellipsoid in both. The radius 1 - h
    is reduced, and Sigma_pred enlarged, by a bound on the rounding of all products and of simulating the step.

    Args:
        L: Shape of S, (n, n), positive definite.
        plant: Gives A, B, D and the limits.

    Raises:
        CertificateError: If S is so thin that no norm computed in float64 provably describes it.
    """

    def __init__(self, L: np.ndarray, plant: LinearPlant) -> None:
        self.plant = plant
        self.root = read_only(certified_root(L))
        self.moved = read_only(self.root @ plant.A)
        self.effect = read_only(self.root @ plant.B)
        # Products with |G| bound what rounding does to products with G, in units of `rounding`.
        self.rounding = 8.0 * (plant.n + plant.m) * float(np.finfo(float).eps)
        size = np.abs(self.root)
        self.columns = np.linalg.norm(size @ np.abs(plant.A), axis=0)
        self.own_columns = np.linalg.norm(size, axis=0)
        self.pushed = float(np.linalg.norm(size @ np.abs(plant.B), axis=0) @ plant.u_max)
        bound = plant.disturbance.shape
        extent = float(self.own_columns @ np.sqrt(np.diag(bound)))
        D = self.root @ bound @ self.root.T + self.rounding * extent**2 * np.eye(plant.n)
        self.D = read_only(0.5 * (D + D.T))
        # The trace-optimal share of the ellipsoid around E(Sigma_k moved) + E(D) needs the traces of both.
        self._gram = self.moved.T @ self.moved
        self._second = float(np.trace(self.D)) ** 0.5
        # Two states and one input, the commonest small plant, go ten times faster in plain floats.
        self._plane = None
        if (plant.n, plant.m) == (2, 1):
            moved, effect, D = self.moved.tolist(), self.effect[:, 0].tolist(), self.D.tolist()
            self._plane = (moved, effect, D, self.columns.tolist(), self.pushed, self.rounding, plant.u_max.item())

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
        return self._in_space(estimate, error_shape)

    @np.errstate(all="ignore")  # what overflows is seen below, what underflows does not count
    def _in_space(self, estimate: np.ndarray, error_shape: np.ndarray) -> Outlook | None:
        """Returns the test for any number of states and inputs."""
        # The trace of G A Sigma_k A' G'; not finite if any entry of Sigma_k is not.
        first = float(np.vdot(self._gram, error_shape))
        if not (isfinite(first) and _is_shape(error_shape)):
            return None
        spread = float(self.columns.dot(np.sqrt(np.abs(error_shape.diagonal()))))
        reach = float(self.columns.dot(np.abs(estimate)))
        first = max(abs(first) ** 0.5, SMALLEST_SHARE * self._second)
        predicted = self.moved.dot(0.5 * (error_shape + error_shape.T)).dot(self.moved.T)
        predicted.flat[:: len(predicted) + 1] += self.rounding * spread * spread
        predicted = predicted * (1.0 + self._second / first) + self.D * (1.0 + first / self._second)
        values, axes, failed = dsyev(predicted)  # numpy's eigh, without its three times longer preparation
        loss = self.rounding * (reach + spread + self.pushed)
        if failed or not (reach < FARTHEST and isfinite(float(values[0]) + loss) and 0.0 < values[-1] < np.inf):
            return None
        return Outlook(self, self.moved.dot(estimate), values, axes, loss)

    @np.errstate(all="ignore")
    def shape_view(self, error_shape: np.ndarray) -> tuple[np.ndarray, float, float] | None:
        """Returns what the test knows without an estimate: W of |z|^2 = z'Wz, 1 - h, and what rounding grows with.

        W holds for radii of at least SMALLEST_RADIUS. None if the shape, (n, n), is unusable.
        """
        seen = self._in_space(np.zeros(self.plant.n), error_shape)
        if seen is None:
            return None
        spread = float(self.columns.dot(np.sqrt(np.abs(error_shape.diagonal()))))
        return seen.weight, 1.0 - seen.h, spread

    def largest_error(self, error_shape: np.ndarray) -> float:
        """Returns a bound of sqrt(lambda_max(M Sigma_k)), with its rounding."""
        spread = float(self.own_columns @ np.sqrt(np.abs(np.diag(error_shape))))
        shape = self.root @ (0.5 * (error_shape + error_shape.T)) @ self.root.T
        return max(float(np.linalg.eigvalsh(shape)[-1]) + self.rounding * spread**2, 0.0) ** 0.5

    def knows_inside(self, estimate: np.ndarray, error_shape: np.ndarray, margin: float) -> bool:
        """Returns whether |x_hat|_M + sqrt(lambda_max(M Sigma_k)) <= 1 - margin, which proves that x is in S."""
        if self.at(estimate, error_shape) is None:
            return False
        reach = float(self.own_columns @ np.abs(estimate))
        level = float(np.linalg.norm(self.root @ estimate)) + self.largest_error(error_shape)
        return level <= 1.0 - margin - self.rounding * reach


def certified_root(L: np.ndarray) -> np.ndarray:
    """Returns G, shape (n, n), such that |z|_M <= |G z| for all z: G L G' >= I, decided in exact arithmetic.

    Raises:
        CertificateError: If no such G within 1e-9 of the best was found.
    """
    identity = rational(np.eye(len(L)))
    try:
        root = solve_triangular(np.linalg.cholesky(L), np.eye(len(L)), lower=True)
    except np.linalg.LinAlgError:
        root = np.zeros_like(L)
    for growth in ROOT_GROWTHS:
        grown = (1.0 + growth) * root
        if is_positive_semidefinite(subtract(congruence(rational(grown), rational(L)), identity)):
            return grown
    raise CertificateError("the safe set is too thin to decide in float64 what lies in it")


def _is_shape(matrix: np.ndarray) -> bool:
    """Returns whether a matrix (n, n) is positive semidefinite up to rounding, in whatever units."""
    padded = matrix.copy()
    padded.flat[:: len(matrix) + 1] *= 1.0 + INDEFINITE
    padded.flat[:: len(matrix) + 1] += 1e-300  # a state known perfectly
    return dpotrf(0.5 * (padded + padded.T))[1] == 0


class Outlook:
    """The test at one estimate: an input u keeps x+ in S if |offset + effect u| <= radius in the norm of the test.

    Args:
        test: What holds at every estimate.
        offset: G A x_hat, shape (n,), where |z|_M = |G z|.
        values: Eigenvalues of G Sigma_pred G', shape (n,), ascending.
        axes: Its eigenvectors, shape (n, n).
        loss: What rounding may do.

    Attributes:
        h: Of the test.
        radius: 1 - h less rounding; no input passes if it is negative.
    """

    def __init__(
        self, test: OneStepTest, offset: np.ndarray, values: np.ndarray, axes: np.ndarray, loss: float
    ) -> None:
        self.h = h = sqrt(values[-1])
        self.radius = 1.0 - h - loss
        self._test, self._reached = test, offset
        turn = axes
        if self.radius >= SMALLEST_RADIUS:
            turn = axes * np.sqrt(h * (1.0 - h) / (h - values))
        else:
            self.radius = min(self.radius, 0.0)
        self._turn = turn
        self._offset, self._effect = offset.dot(turn), test.effect.T.dot(turn)

    @property
    def weight(self) -> np.ndarray:
        """W with |z|^2 = z'Wz in the norm of the test, shape (n, n)."""
        return self._turn.dot(self._turn.T)

    @np.errstate(all="ignore")
    def judge(self, u: list[float]) -> tuple[float, float]:
        """Returns room and margin of an input u, m numbers.

        The room is radius - |offset + effect u|: x+ is in S unless it is negative. The margin is
        1 - h - |A x_hat + B u|_M, less rounding, which is at most the room.
        """
        moved = self._offset + np.dot(u, self._effect)
        reached = self._reached + np.dot(u, self._test.effect.T)
        return self.radius - float(moved.dot(moved)) ** 0.5, self.radius - float(reached.dot(reached)) ** 0.5

    @np.errstate(all="ignore")
    def smallest_room(self) -> float:
        """Returns the room of the worst input within the limits: a vertex, since the norm is convex."""
        moved = self._offset + self._test.vertices @ self._effect
        return self.radius - float((moved * moved).sum(axis=1).max()) ** 0.5

    @np.errstate(all="ignore")
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
