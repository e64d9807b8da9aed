"""The one-step test: which inputs keep every possible next state in the safe set."""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.linalg import solve_triangular

from ncs_gym import LinearPlant
from ncs_gym.uncertainty.shape_matrices import SMALLEST_MULTIPLIER, is_inside
from ncs_gym.validation import frozen, own_error_state, read_only
from shields.certificate import Certificate, CertificateError
from shields.runtime.projection import closest_admissible, closest_on_line
from shields.verification import ACTION_ROUNDING
from shields.verification.rational_matrix import congruence, is_positive_semidefinite, rational, subtract

# The test of all inputs looks at the 2^m vertices of the input box.
MOST_INPUTS_WITH_VERTICES = 12
# As many pairs of vertex and environment are looked at in one array.
LARGEST_BLOCK = 100_000
# Growths of the root that are tried until it provably does not understate the norm of S.
ROOT_GROWTHS = (1e-13, 1e-12, 1e-11, 1e-10, 1e-9)
# An estimate this far out, in units of S, is not worth a test (and its square overflows at 1e154).
FARTHEST = 1e100
# With a smaller radius 1 - h, rounding of the weights would no longer be small against it.
SMALLEST_RADIUS = 1e-5
# An error shape may be indefinite by this fraction of its diagonal: rounding of flat ones.
INDEFINITE = 1e-9


class OneStepTest:
    """Whether everything one step can reach lies in S = {x : x'Mx <= 1} = E(L) (docs/shield_proof.md, "One step").

    x+ lies in {c} + E(Sigma_pred) with c = A x_hat + B u. In coordinates where M = I, with p_i the eigenvalues of
    Sigma_pred, c_i the coordinates of c along their axes and h = sqrt(max p) < 1, that set is inside S if

        sum_i (1-h) h / (h - p_i) c_i^2 <= (1-h)^2,

    the exact containment test at the multiplier that is best if all p_i are equal. It admits more than |c|_M <= 1 - h,
    since every weight is at most 1, and is as cheap: the inputs that pass form an ellipsoid in both. The radius 1 - h
    is reduced, and Sigma_pred enlarged, by a bound on the rounding of all products and of simulating the step.

    Args:
        L: Shape of S, (n, n), positive definite.
        plant: Gives A, B, D and the limits.

    Attributes:
        root: G with |z|_M <= |G z|, shape (n, n).
        moved, effect: G A and G B, shapes (n, n) and (n, m).
        D: G D G' with the rounding of computing it, shape (n, n).
        rounding: Bound on the rounding of a product with G, relative to the product of absolute values.
        columns, own_columns: Norms of the columns of |G| |A| and of |G|, shape (n,).
        pushed: Largest norm of |G| |B| |u| within the limits.
        shift: Largest norm of G B u within the limits, to which the rounding of an action is relative.
        limits: Entries of u_max.

    Raises:
        CertificateError: If S is so thin that no norm computed in float64 provably describes it.
    """

    def __init__(self, L: np.ndarray, plant: LinearPlant) -> None:
        self.plant = plant
        self.limits = plant.u_max.tolist()
        self.root = read_only(certified_root(L))
        self.moved = read_only(self.root @ plant.A)
        self.effect = read_only(self.root @ plant.B)
        self.rounding = 8.0 * (plant.n + plant.m) * float(np.finfo(float).eps)
        size = np.abs(self.root)
        self.columns = read_only(np.linalg.norm(size @ np.abs(plant.A), axis=0))
        self.own_columns = read_only(np.linalg.norm(size, axis=0))
        self.pushed = float(np.linalg.norm(size @ np.abs(plant.B), axis=0) @ plant.u_max)
        self.shift = float(np.linalg.norm(self.effect, axis=0) @ plant.u_max)
        bound = plant.disturbance.shape_matrix
        extent = float(self.own_columns @ np.sqrt(np.diag(bound)))
        D = self.root @ bound @ self.root.T + self.rounding * extent**2 * np.eye(plant.n)
        self.D = read_only(0.5 * (D + D.T))

    @own_error_state  # what overflows is found below, what underflows does not count
    def predicted(self, shapes: np.ndarray, certified_shapes: np.ndarray) -> PredictedErrors:
        """Returns what the test and the guarantee need of error shapes (docs/shield_proof.md, "One step").

        Sigma_pred is the trace-smallest G (A Sigma_k A'/nu + D/(1-nu)) G', enlarged by the rounding of computing it.

        Args:
            shapes: Sigma_k, shape (k, n, n).
            certified_shapes: Shapes of the certified error sets, shape (l, n, n).
        """
        symmetric, usable, inside = judged_shapes(shapes, certified_shapes)
        half_widths = np.sqrt(np.diagonal(symmetric, axis1=1, axis2=2))
        identity = self.rounding * np.eye(self.plant.n)
        spread = half_widths @ self.columns
        moved = self.moved @ symmetric @ self.moved.T + (spread**2)[:, None, None] * identity
        second = np.trace(self.D) ** 0.5
        first = np.maximum(np.abs(np.trace(moved, axis1=1, axis2=2)) ** 0.5, SMALLEST_MULTIPLIER * second)[
            :, None, None
        ]
        squares, axes = _eigh(moved * (1.0 + second / first) + self.D * (1.0 + first / second))
        h = np.sqrt(squares[:, -1])
        radius = 1.0 - h - self.rounding * (spread + self.pushed)
        weights = np.where(radius[:, None] >= SMALLEST_RADIUS, (h * (1.0 - h))[:, None] / (h[:, None] - squares), 1.0)
        weighting = np.sqrt(weights)[:, :, None] * axes.swapaxes(1, 2)
        own_spread = half_widths @ self.own_columns
        own = _eigh(self.root @ symmetric @ self.root.T)[0][:, -1] + self.rounding * own_spread**2
        usable &= np.all(np.isfinite(weighting), axis=(1, 2)) & np.isfinite(radius) & (h > 0.0)
        unusable = np.where(usable, 0.0, np.nan)
        return PredictedErrors(
            weighting=np.ascontiguousarray(np.where(usable[:, None, None], weighting, 0.0).transpose(1, 2, 0)),
            radius=radius + unusable,
            half_widths=np.ascontiguousarray((half_widths + unusable[:, None]).T),
            own=(np.sqrt(np.maximum(own, 0.0)) + unusable)[None],
            row_limits=np.empty((0, len(shapes))),
            certified=inside & usable,
            shape=np.ascontiguousarray(shapes.transpose(1, 2, 0)),
        )

    def reachable(self, estimates: np.ndarray, errors: PredictedErrors) -> ReachableSets:
        """Returns the sets of next states that N estimates allow, shape (n, N)."""
        reach = self.columns @ np.abs(estimates)
        radius = errors.radius - self.rounding * reach
        near, small = reach < FARTHEST, radius < SMALLEST_RADIUS
        if np.count_nonzero(near) < len(near):  # what is too far out or not finite has no radius
            radius[~near] = np.nan
        if np.count_nonzero(small):  # too small for the weights: nothing passes
            radius[small] = np.minimum(radius[small], 0.0)
        return ReachableSets(self, self.moved @ estimates, errors.weighting, radius)

    def reachable_alone(self, estimate: np.ndarray, errors: PredictedErrors) -> ReachableSet | None:
        """Returns what `reachable` does for one estimate, shape (n,), and one error shape; None if nothing passes."""
        radius = errors.radius - self.rounding * float(self.columns.dot(np.abs(estimate)))
        if not radius >= SMALLEST_RADIUS:  # neither NaN
            return None
        return ReachableSet(self, self.moved.dot(estimate), errors.weighting, radius)

    @own_error_state
    def knows_inside(self, estimates: np.ndarray, errors: PredictedErrors, margin: float) -> np.ndarray:
        """Returns whether |x_hat|_M + sqrt(lambda_max(M Sigma_k)) <= 1 - margin, which proves that x is in S.

        For estimates of shape (n, N), or a single one, (n,).
        """
        level = norms(self.root.dot(estimates)) + errors.own[0]
        return level <= 1.0 - margin - self.rounding * self.own_columns.dot(np.abs(estimates))

    def keeps_between(
        self, estimate: np.ndarray, errors: PredictedErrors, margin: float, u: np.ndarray | None = None
    ) -> bool:
        """Returns whether the box is kept until the next sample, where that counts (`EllipsoidOnGrid`); here not."""
        return True


class ReachableSets(NamedTuple):
    """Where next states lie: in {A x_hat + B u} + E(Sigma_pred), for each of N environments.

    Errors, disturbance and rounding are taken off the limits first. What is left for A x_hat + B u is the `radius`, of
    rows the `row_limits`; what an input leaves of that is its margin, which is negative where it asks for more. The
    test margin, radius - |T G (A x_hat + B u)|, decides: x+ is in S unless it is negative. The reported margin,
    1 - h - |A x_hat + B u|_M less rounding (`Decision.margin`), is at most that. Of rows both are the least
    row limit - |g (A x_hat + B u)|.

    Attributes:
        test: What holds for all of them.
        offset: G A x_hat, shape (n, N).
        weighting: T of `PredictedErrors`, shape (n, n, N).
        radius: 1 - h less rounding, shape (N,); no input passes if it is not positive. NaN if nothing is known.
    """

    test: OneStepTest
    offset: np.ndarray
    weighting: np.ndarray
    radius: np.ndarray

    def some(self, chosen: np.ndarray) -> ReachableSets:
        """Returns the sets of some environments, given by their indices."""
        offset, weighting, radius = (array.take(chosen, axis=-1) for array in self[1:])
        return ReachableSets(self.test, offset, weighting, radius)

    def margins(self, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns test and reported margins of inputs u, shape (m, N); shape (N,), NaN where nothing is known."""
        effect = self.test.effect  # with a single input, products without the sums are the same and faster
        center = self.offset + (effect * inputs if len(inputs) == 1 else effect @ inputs)
        return self.radius - norms((self.weighting * center).sum(axis=1)), self.radius - norms(center)

    def smallest_test_margin(self) -> np.ndarray:
        """Returns that of the worst input within the limits, shape (N,): a vertex, since the norm is convex."""
        vertices = np.array(list(product(*((-limit, limit) for limit in self.test.limits)))).T
        pieces = max(1, vertices.shape[1] * len(self.radius) // LARGEST_BLOCK)
        worst = self.radius
        for some in np.array_split(vertices, pieces, axis=1):
            centers = self.offset[:, None] + (self.test.effect @ some)[:, :, None]
            farthest = norms((self.weighting[:, :, None] * centers).sum(axis=1)).max(axis=0)
            worst = np.minimum(worst, self.radius - farthest)
        return worst

    def closest(self, inputs: np.ndarray, margin: float) -> np.ndarray:
        """Returns the inputs within the limits, (m, N), closest to given ones with this test margin, else NaN."""
        effect = (self.weighting[:, :, None] * self.test.effect[:, :, None]).sum(axis=1)
        offset = (self.weighting * self.offset).sum(axis=1)
        return closest_admissible(inputs, offset, effect, self.radius - margin, self.test.plant.u_max)


class ReachableSet(NamedTuple):
    """`ReachableSets` of a single environment: the same formulas without its axis, in a fifth of the time.

    Attributes:
        test: What holds for all environments.
        offset: G A x_hat, shape (n,).
        weighting: T of `PredictedErrors`, shape (n, n).
        radius: 1 - h less rounding, at least SMALLEST_RADIUS.
    """

    test: OneStepTest
    offset: np.ndarray
    weighting: np.ndarray
    radius: float

    def margins(self, u: np.ndarray) -> tuple[float, float]:
        """Returns test and reported margin of an input u, shape (m,)."""
        center = self.offset + self.test.effect.dot(u)
        weighted = self.weighting.dot(center)
        return self.radius - float(weighted.dot(weighted)) ** 0.5, self.radius - float(center.dot(center)) ** 0.5

    def closest(self, u: float, margin: float) -> float:
        """Returns what `ReachableSets.closest` does for plants with a single input."""
        effect, offset = self.weighting.dot(self.test.effect[:, 0]), self.weighting.dot(self.offset)
        form = (float(effect.dot(effect)), float(effect.dot(offset)), float(offset.dot(offset)))
        return closest_on_line(u, *form, self.radius - margin, self.test.limits[0])


class PredictedErrors(NamedTuple):
    """What follows from error shapes alone; the last axis counts them (no such axis: a single one).

    The norm of S is weighted, a polytope and the grid between samples are judged row by row; what a test does not need
    has no entries. Radius, half_widths, own and row_limits are NaN for an unusable shape.

    Attributes:
        weighting: T with |T z|^2 = sum_i (1-h) h / (h - p_i) z_i^2 along the axes of Sigma_pred, shape (n, n, k).
        row_limits: 1 - sqrt(g A Sigma_k A' g') - sqrt(g D g') less the rounding that does not depend on the estimate,
            for rows g, shape (r, k).
        radius: 1 - h less that rounding; of a polytope the least row limit, shape (k,).
        half_widths: Largest error of each state, shape (n, k).
        own: Bound of the largest error norm, sqrt(lambda_max(M Sigma_k)), shape (1, k); of a polytope sqrt(g Sigma_k
            g'), shape (r, k).
        certified: Whether E(Sigma_k) lies inside a certified error set, shape (k,).
        shape: Sigma_k itself, shape (n, n, k); the filter keeps it in mode "lookahead" alone, else (0, n, k).
    """

    weighting: np.ndarray
    row_limits: np.ndarray
    radius: Any
    half_widths: np.ndarray
    own: np.ndarray
    certified: Any
    shape: np.ndarray

    def of(self, numbers: np.ndarray) -> Self:
        """Returns those of environments that have the shapes with these numbers, shape (N,)."""
        return self._make(array.take(numbers, axis=-1) for array in self)

    def single(self, number: int = 0) -> Self:
        """Returns one of them without a last axis."""
        return self._make(array.item(number) if array.ndim == 1 else array[..., number].copy() for array in self)

    def read_only(self) -> Self:
        """Returns the same, read-only."""
        return self._make(frozen(each) if isinstance(each, np.ndarray) else each for each in self)

    def batch(self) -> Self:
        """Returns a single one as a batch of one."""
        return self._make(np.asarray(each)[..., None] for each in self)

    def followed_by(self, other: Self) -> Self:
        """Returns these shapes and then the others."""
        return self._make(np.concatenate(pair, axis=-1) for pair in zip(self, other, strict=True))


def judged_shapes(shapes: np.ndarray, certified_shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns error shapes made symmetric, which are usable, and which lie inside a certified error set.

    Shapes are (k, n, n), (k,) and (k,). The identity stands for an unusable one.
    """
    symmetric = 0.5 * (shapes + shapes.swapaxes(1, 2))
    usable = _are_shapes(symmetric)
    inside = [
        bool(fine) and any(is_inside(S, Sigma) for Sigma in certified_shapes)
        for S, fine in zip(shapes, usable, strict=True)
    ]
    return np.where(usable[:, None, None], symmetric, np.eye(shapes.shape[-1])), usable, np.array(inside, np.bool_)


def _are_shapes(matrices: np.ndarray) -> np.ndarray:
    """Returns whether symmetric matrices (k, n, n) are finite and positive semidefinite up to rounding, shape (k,).

    Judged by the correlations S_ij / sqrt(S_ii S_jj), which do not depend on units.
    """
    widths = np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
    products = widths[:, :, None] * widths[:, None, :]
    possible = np.all(np.abs(matrices) <= (1.0 + INDEFINITE) * products, axis=(1, 2)) & np.all(widths < np.inf, axis=1)
    correlations = np.where(products > 0.0, matrices / products, 0.0)
    correlations = np.where(possible[:, None, None], correlations, 0.0)
    return possible & (_eigh(correlations)[0][:, 0] >= -INDEFINITE)


def _eigh(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns ascending eigenvalues (k, n) and eigenvectors (k, n, n); NaN where they cannot be computed."""
    finite = np.all(np.isfinite(matrices), axis=(1, 2))
    try:
        values, axes = np.linalg.eigh(np.where(finite[:, None, None], matrices, 0.0))
    except np.linalg.LinAlgError:
        return np.full(matrices.shape[:2], np.nan), np.full(matrices.shape, np.nan)
    return np.where(finite[:, None], values, np.nan), axes


def norms(vectors: np.ndarray) -> np.ndarray:
    """Returns the Euclidean norms of the columns of an array (n, N), shape (N,)."""
    if len(vectors) == 1:
        return np.abs(vectors[0])
    return np.sqrt((vectors * vectors).sum(axis=0))


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


def require_computable(certificate: Certificate, plant: LinearPlant) -> None:
    """Raises unless float64 computes K x_hat on S, or the polytope, more accurately than the conditions allow for.

    D_u allows a shift by 2^-24 u_max, twice what rounding an action to float32 does; the other half is for this.

    Raises:
        CertificateError: If it does not.
    """
    extent = np.sqrt(np.diag(certificate.L))
    if certificate.polytope is not None:  # anywhere in the box: x'C'Cx is at most the number of its rows there
        extent = np.maximum(extent, len(plant.box_rows) ** 0.5 * plant.half_widths)
    extent = extent + np.sqrt(np.diagonal(certificate.error_shapes, axis1=1, axis2=2)).max(axis=0)
    error = (plant.n + 2) * np.finfo(float).eps * (np.abs(certificate.K) @ extent)
    if (error > 0.25 * float(ACTION_ROUNDING) * plant.u_max).any():
        raise CertificateError("the gain is too large against the input limits to compute K x_hat in float64")
