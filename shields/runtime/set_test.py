"""The test of an input: whether everything that one step can reach with it lies in the set that a certificate keeps.

A set is rows with two ends, or a cone: an ellipsoid has no rows, a polytope no cone. Limits within a step stand below
the rows: of states and inputs together, and of the box at other times (docs/shield_proof.md).
"""

from __future__ import annotations

from itertools import product
from math import nan
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.linalg import solve_triangular

from ncs_gym import LinearPlant
from ncs_gym.ellipsoid import SMALLEST_MULTIPLIER, is_inside
from ncs_gym.validation import frozen, read_only
from shields.certificate import Certificate, CertificateError
from shields.polytope import Polytope
from shields.runtime.projection import closest_admissible, closest_between, closest_in_interval, closest_on_line
from shields.verification import ACTION_ROUNDING
from shields.verification.polytope_conditions import faces_of
from shields.verification.rational_matrix import congruence, is_positive_semidefinite, rational, subtract

# The test of all inputs looks at the 2^m vertices of the input box.
MOST_INPUTS_WITH_VERTICES = 12
# As many pairs of vertex and environment are looked at in one array.
LARGEST_BLOCK = 100_000
# Entries of an array that are worked on together: as many as a processor keeps near.
BLOCK = 32_768
# Growths of the root that are tried until it provably does not understate the norm of S.
ROOT_GROWTHS = (1e-13, 1e-12, 1e-11, 1e-10, 1e-9)
# An estimate this far out, in units of S, is not worth a test (and its square overflows at 1e154).
FARTHEST = 1e100
# With a smaller radius 1 - h, rounding of the weights would no longer be small against it.
SMALLEST_RADIUS = 1e-5
# An error shape may be indefinite by this fraction of its diagonal: rounding of flat ones.
INDEFINITE = 1e-9
# An end of a row that is open counts as this far from the other one, in units of the row: a closer end is no less safe,
# and no set is that wide.
OPEN = 1e4


def supports(rows: np.ndarray, shapes: np.ndarray, rounding: Any) -> np.ndarray:
    """Returns upper bounds of sqrt(g S g'), shape (..., r), for rows g, (..., r, n), and shapes S, (..., n, n).

    Computing g S g' is off by at most the rounding.
    """
    squares = ((rows @ shapes) * rows).sum(axis=-1)
    return np.sqrt(np.maximum(squares, 0.0) + rounding)


def closed(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns finite ends for ends of which one may be open."""
    return np.where(np.isfinite(low), low, high - OPEN), np.where(np.isfinite(high), high, low + OPEN)


class SetTest:
    """Whether everything that one step can reach lies in a set (docs/shield_proof.md).

    x+ = A x_hat + B u - A e + d with e in E(Sigma_k) and d in E(D). An input u passes if c = A x_hat + B u meets both:

    - Cone, for S = {x : x'Mx <= 1} = E(L) ("One step"): x+ lies in {c} + E(Sigma_pred). In coordinates where M = I,
      with p_i the eigenvalues of Sigma_pred, c_i the coordinates of c along their axes and h = sqrt(max p) < 1, that
      set is inside S if

          sum_i (1-h) h / (h - p_i) c_i^2 <= (1-h)^2,

      the exact containment test at the multiplier that is best if all p_i are equal. It admits more than |c|_M <= 1 -
      h, since every weight is at most 1, and is as cheap: the inputs that pass form an ellipsoid in both.
    - Rows, for P = {x : low <= G x <= high} ("Polytopes"). For all rows g

          low + reach <= g c <= high - reach,    reach = sqrt(g A Sigma_k A' g') + sqrt(g D g'),

      which is exact for what is known: the supports of errors and disturbances add up. The plant's `step_rows`, on
      x_hat and u, follow.

    Radius and row limits are reduced, and Sigma_pred enlarged, by a bound on the rounding of all products and of
    simulating the step.

    Args:
        plant: Gives A, B, D and the limits; symmetric ones without any within a step for S.
        root: G with |z|_M <= |G z| for S (`certified_root`), shape (n, n), or the rows of P, shape (r, n).
        ends: Low and high ends of the rows of P, shape (2, r); None for S.

    Attributes:
        cone: n for S, 0 for P.
        root: As given.
        state_rows, input_rows: The root times A and B, and then the rows within a step, shapes (.., n) and (.., m).
        joint: Both beside each other.
        middle, half: Of the ends of the rows, those within a step included: low <= v <= high is |v - middle| <= half,
            which is as fast as one end. The half is less by the rounding of both.
        D: G D G' with the rounding of computing it.
        disturbed: sqrt(g D g') of the rows with the rounding of computing it; 0 within a step, whose ends hold it.
        rounding: Bound on the rounding of a product with G, relative to the product of absolute values.
        columns, own_columns: Norms of the columns of |G| |A| and of |G|, of rows their largest entries, shape (n,).
        pushed: Largest norm of |G| |B| |u| within the limits, or its largest entry.
        shift: Largest norm of G B u within the limits, or its largest entry, to which the rounding of an action is
            relative.
        limits: The low and the high end of each input.
    """

    def __init__(self, plant: LinearPlant, root: np.ndarray, ends: np.ndarray | None = None) -> None:
        self.plant, self.root, self.limits = plant, read_only(root), plant.input_ends.T.tolist()
        self.cone, of_rows = (len(root), np.empty((2, 0))) if ends is None else (0, ends)
        of_state, of_input = np.hsplit(plant.step_rows, [plant.n])
        self.state_rows = read_only(np.concatenate([self.root @ plant.A, of_state]))
        self.input_rows = read_only(np.concatenate([self.root @ plant.B, of_input]))
        self.rounding = 8.0 * (plant.n + plant.m) * float(np.finfo(float).eps)
        low, high = closed(*np.hstack([of_rows, plant.step_ends]))
        self.middle = read_only(0.5 * (low + high))
        self.half = read_only(0.5 * (high - low) - self.rounding * np.abs(self.middle))
        self.joint = read_only(np.hstack([self.state_rows, self.input_rows]))
        self._limited_rows = read_only(np.concatenate([self.input_rows, np.eye(plant.m)]))
        self._input_range = read_only(plant.input_middle[:, None]), read_only(plant.input_half[:, None])
        size = np.abs(self.root)
        sizes = np.concatenate([size @ np.abs(plant.A), np.abs(of_state)])
        pushes = np.concatenate([size @ np.abs(plant.B), np.abs(of_input)])
        self.columns, self.own_columns = read_only(self._norms(sizes)), read_only(self._norms(size))
        self.pushed, self.shift = self._largest(pushes), self._largest(np.abs(self.input_rows))
        D = plant.disturbance.shape_matrix
        rounding = self.rounding * float(self.own_columns @ np.sqrt(np.diag(D))) ** 2
        spread = root @ D @ root.T + rounding * np.eye(len(root))
        self.D = read_only(0.5 * (spread + spread.T))
        reach = supports(root, D, rounding) if ends is not None else np.empty(0)
        self.disturbed = read_only(np.pad(reach, (0, len(of_state))))

    def _norms(self, sizes: np.ndarray) -> np.ndarray:
        """Returns the norms of the columns in a cone, their largest entries in rows."""
        columns: np.ndarray = np.linalg.norm(sizes, axis=0) if self.cone else sizes.max(axis=0)
        return columns

    def _largest(self, pushes: np.ndarray) -> float:
        """Returns the same of the products with inputs within the limits."""
        limits = self.plant.largest_input
        return float(np.linalg.norm(pushes, axis=0) @ limits if self.cone else (pushes @ limits).max())

    def predicted(self, shapes: np.ndarray, certified_shapes: np.ndarray) -> PredictedErrors:
        """Returns what the test and the guarantee need of error shapes (docs/shield_proof.md, "One step").

        Args:
            shapes: Sigma_k, shape (k, n, n).
            certified_shapes: Those of the certified error sets, shape (l, n, n).
        """
        symmetric, usable, inside = judged_shapes(shapes, certified_shapes)
        half_widths = np.sqrt(np.diagonal(symmetric, axis1=1, axis2=2))
        spread, own_rounding = half_widths @ self.columns, self.rounding * (half_widths @ self.own_columns) ** 2
        center, rows = self.state_rows[: self.cone], self.state_rows[self.cone :]
        reach = supports(rows, symmetric, self.rounding * spread[:, None] ** 2).T + self.disturbed[:, None]
        row_limits = self.half[:, None] - reach * (1.0 + self.rounding) - self.rounding * (spread + self.pushed)
        if self.cone:
            weighting, radius = ball(center, self.D, symmetric, spread, self.pushed, self.rounding)
            own = _eigh(self.root @ symmetric @ self.root.T)[0][:, -1] + own_rounding
            own = np.sqrt(np.maximum(own, 0.0))[None]
        else:
            weighting, radius = np.empty((len(shapes), 0, 0)), row_limits.min(axis=0)
            own = supports(self.root, symmetric, own_rounding[:, None]).T
        usable &= np.isfinite(radius) & np.isfinite(row_limits).all(axis=0) & np.isfinite(own).all(axis=0)
        unusable = np.where(usable, 0.0, np.nan)
        return PredictedErrors(
            weighting=np.ascontiguousarray(np.where(usable[:, None, None], weighting, 0.0).transpose(1, 2, 0)),
            row_limits=np.ascontiguousarray(row_limits + unusable),
            radius=radius + unusable,
            half_widths=np.ascontiguousarray((half_widths + unusable[:, None]).T),
            own=np.ascontiguousarray(own + unusable),
            certified=inside & usable,
            stays=np.zeros(len(usable), np.bool_),
            shape=np.ascontiguousarray(shapes.transpose(1, 2, 0)),
        )

    def reachable(self, estimates: np.ndarray, errors: PredictedErrors) -> ReachableSets:
        """Returns the sets of next states that N estimates allow, shape (n, N)."""
        reach = self.columns @ np.abs(estimates)
        rounding = self.rounding * reach
        near = reach < FARTHEST
        if np.count_nonzero(near) < len(near):  # what is too far out or not finite has no radius
            rounding[~near] = np.nan
        radius = errors.radius - rounding
        small = radius < SMALLEST_RADIUS
        if np.count_nonzero(small):  # too small for the weights: nothing passes
            radius[small] = np.minimum(radius[small], 0.0)
        center = self.state_rows[: self.cone] @ estimates  # none of rows
        return ReachableSets(self, estimates, center, errors.weighting, errors.row_limits, rounding, radius)

    def margins_alone(self, estimate: np.ndarray, errors: PredictedErrors, u: np.ndarray) -> tuple[float, float]:
        """Returns `ReachableSets.margins` of one estimate, error shape and input, (m,), in a fifth of the time."""
        rounding = self.rounding * float(self.columns.dot(np.abs(estimate)))
        radius = errors.radius - rounding
        if not radius >= SMALLEST_RADIUS:  # neither NaN
            return nan, nan
        center = self.state_rows.dot(estimate) + self.input_rows.dot(u)
        if not self.cone:
            left = errors.row_limits - rounding - np.abs(center - self.middle)
            least = left.item(left.argmin())  # NaN if one is, as min() would say, in half the time
            return least, least
        weighted = errors.weighting.dot(center)
        return radius - float(weighted.dot(weighted)) ** 0.5, radius - float(center.dot(center)) ** 0.5

    def closest_alone(self, estimate: np.ndarray, errors: PredictedErrors, u: float, margin: float) -> float:
        """Returns `ReachableSets.closest` of one estimate, shape (n,), and error shape, for plants with one input."""
        rounding = self.rounding * float(self.columns.dot(np.abs(estimate)))
        center = self.state_rows.dot(estimate)
        if self.cone:
            pushed, offset = (errors.weighting.dot(each) for each in (self.input_rows[:, 0], center))
            form = (float(pushed.dot(pushed)), float(pushed.dot(offset)), float(offset.dot(offset)))
            return closest_on_line(u, *form, errors.radius - rounding - margin, self.limits[0][1])
        middle, half = self.plant.input_middle.item(), self.plant.input_half.item()
        offset = [*(center - self.middle).tolist(), -middle]
        limits = [*(errors.row_limits - rounding - margin).tolist(), half]
        return closest_in_interval(u, offset, self._limited_rows[:, 0].tolist(), limits)

    def closest_on_rows(self, inputs: np.ndarray, offset: np.ndarray, row_limits: np.ndarray) -> np.ndarray:
        """Returns the inputs within the limits closest to given ones, (m, N), with |offset + rows u| <= row_limits."""
        count, (middle, half) = inputs.shape[1], self._input_range
        offset = np.concatenate([offset, np.repeat(-middle, count, axis=1)])
        bounds = np.concatenate([row_limits, np.repeat(half, count, axis=1)])
        return closest_between(inputs, offset, self._limited_rows, bounds)

    def knows_inside(self, estimates: np.ndarray, errors: PredictedErrors, margin: float) -> np.ndarray:
        """Returns whether estimates of shape (n, N), or a single one, (n,), prove that x is in the set.

        With a cone |x_hat|_M + sqrt(lambda_max(M Sigma_k)) <= 1 - margin does, else low + margin <= g x_hat +- sqrt(g
        Sigma_k g') <= high - margin for all rows.
        """
        values = self.root.dot(estimates)
        if self.cone:
            left = 1.0 - (norms(values) + errors.own[0])
        else:
            of_one = (len(values), *[1] * (values.ndim - 1))
            middle, half = self.middle[: len(values)].reshape(of_one), self.half[: len(values)].reshape(of_one)
            left = (half - (np.abs(values - middle) + errors.own)).min(axis=0)
        return left >= margin + self.rounding * self.own_columns.dot(np.abs(estimates))

    def keeps_within_step(self, estimate: np.ndarray, errors: PredictedErrors, margin: float) -> bool:
        """Returns whether the limits within this step are kept under a zero input."""
        first = len(self.root)
        rounding = self.rounding * float(self.columns.dot(np.abs(estimate)))
        values = self.state_rows[first:].dot(estimate)
        return bool((np.abs(values - self.middle[first:]) <= errors.row_limits[first:] - rounding - margin).all())


class ReachableSets(NamedTuple):
    """Where next states lie, for each of N environments.

    Errors, disturbance and rounding are taken off the limits first. What is left for c = A x_hat + B u is the `radius`,
    of rows the `row_limits`; what an input leaves of that is its margin, negative where it asks for more. The test
    margin, the least of radius - |T G c| and of row limit - |g c - middle|, decides: x+ is in the set unless it is
    negative. The reported margin (`Decision.margin`) has no T, and is at most that.

    Attributes:
        test: What holds for all of them.
        estimates: x_hat, shape (n, N).
        center: G A x_hat of the cone, shape (k, N).
        weighting: T of `PredictedErrors`, shape (k, k, N).
        row_limits: Largest |g c - middle| that passes, shape (r, N), before rounding.
        rounding: What they lose by it, shape (N,); NaN if nothing is known.
        radius: That of the cone, else the least row limit, less rounding, shape (N,); no input passes if it is not
            positive. NaN if nothing is known.
    """

    test: SetTest
    estimates: np.ndarray
    center: np.ndarray
    weighting: np.ndarray
    row_limits: np.ndarray
    rounding: np.ndarray
    radius: np.ndarray

    def some(self, chosen: np.ndarray) -> ReachableSets:
        """Returns those of some environments, given by their indices."""
        return ReachableSets(self.test, *(array.take(chosen, axis=-1) for array in self[1:]))

    def margins(self, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns test and reported margins of inputs u, shape (m, N); shape (N,), NaN where nothing is known."""
        if not self.test.cone:
            least = self._least_of_rows(inputs)
            return least, least.copy()
        effect = self.test.input_rows  # with a single input, products without the sums are the same and faster
        center = self.center + (effect * inputs if len(inputs) == 1 else effect @ inputs)
        return self.radius - norms((self.weighting * center).sum(axis=1)), self.radius - norms(center)

    def _least_of_rows(self, inputs: np.ndarray) -> np.ndarray:
        """Returns the least that inputs u, shape (m, N), leave of a row limit, shape (N,)."""
        joint, least = np.concatenate([self.estimates, inputs]), np.empty(inputs.shape[1])
        block = max(1, BLOCK // len(self.test.joint))
        for start in range(0, len(least), block):
            part = slice(start, start + block)
            center = self.test.joint @ joint[:, part]
            center -= self.test.middle[:, None]
            np.abs(center, out=center)
            np.subtract(self.row_limits[:, part], center, out=center)
            least[part] = center.min(axis=0)
        least -= self.rounding
        return least

    def smallest_test_margin(self) -> np.ndarray:
        """Returns that of the worst input within the limits, shape (N,); in the cone a vertex: the norm is convex."""
        test, plant = self.test, self.test.plant
        if not test.cone:
            shift = test.input_rows @ plant.input_middle - test.middle
            center = np.abs(test.state_rows @ self.estimates + shift[:, None])
            pushed = np.abs(test.input_rows) @ plant.input_half
            worst: np.ndarray = (self.row_limits - center - pushed[:, None]).min(axis=0) - self.rounding
            return worst
        vertices, worst = np.array(list(product(*test.limits))).T, np.full(len(self.radius), np.inf)
        pieces = max(1, vertices.shape[1] * len(self.radius) // LARGEST_BLOCK)
        for some in np.array_split(vertices, pieces, axis=1):
            centers = self.center[:, None] + (test.input_rows @ some)[:, :, None]
            farthest = norms((self.weighting[:, :, None] * centers).sum(axis=1)).max(axis=0)
            worst = np.minimum(worst, self.radius - farthest)
        return worst

    def closest(self, inputs: np.ndarray, margin: float) -> np.ndarray:
        """Returns the inputs within the limits, (m, N), closest to given ones with this test margin, else NaN."""
        if not self.test.cone:
            return self._closest_on_rows(inputs, margin)
        effect = (self.weighting[:, :, None] * self.test.input_rows[:, :, None]).sum(axis=1)
        offset = (self.weighting * self.center).sum(axis=1)
        return closest_admissible(inputs, offset, effect, self.radius - margin, self.test.plant.largest_input)

    def _closest_on_rows(self, inputs: np.ndarray, margin: float) -> np.ndarray:
        test, rows, closest = self.test, self.test.state_rows, np.empty(inputs.shape)
        block = max(1, BLOCK // len(rows))
        for start in range(0, inputs.shape[1], block):
            part = slice(start, start + block)
            offset = rows @ self.estimates[:, part]
            offset -= test.middle[:, None]
            room = self.row_limits[:, part] - (self.rounding[part] + margin)
            closest[:, part] = test.closest_on_rows(inputs[:, part], offset, room)
        return closest


class PredictedErrors(NamedTuple):
    """What follows from error shapes alone; the last axis counts them (no such axis: a single one).

    Radius, half_widths, own and row_limits are NaN for an unusable shape; what a test does not need has no entries.

    Attributes:
        weighting: T with |T z|^2 = sum_i (1-h) h / (h - p_i) z_i^2 along the axes of Sigma_pred, shape (n, n, k).
        row_limits: Half of a row's range less sqrt(g A Sigma_k A' g') + sqrt(g D g') and the rounding that does not
            depend on the estimate, for rows g, shape (r, k).
        radius: 1 - h less that rounding; without a cone the least row limit, shape (k,).
        half_widths: Largest error of each state, shape (n, k).
        own: Bound of the largest error norm, sqrt(lambda_max(M Sigma_k)), shape (1, k); of a polytope
            sqrt(g Sigma_k g'), shape (r, k).
        certified: Whether E(Sigma_k) lies inside a certified error set, shape (k,).
        stays: Whether it is known to stay in one while the contract is kept, which no shape alone says, shape (k,).
        shape: Sigma_k itself, shape (n, n, k); the filter keeps it in mode "lookahead" alone, else (0, n, k).
    """

    weighting: np.ndarray
    row_limits: np.ndarray
    radius: Any
    half_widths: np.ndarray
    own: np.ndarray
    certified: Any
    stays: Any
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
    """Returns error shapes (k, n, n) made symmetric, which are usable, and which lie inside a certified error set.

    The identity stands for an unusable one.
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


def ball(
    moved: np.ndarray, D: np.ndarray, shapes: np.ndarray, spread: np.ndarray, pushed: float, rounding: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns where the center of {c} + E(Sigma_pred) may be: T, shape (k, n, n), and the radius, (k,), of |T G c|.

    Sigma_pred is the trace-smallest G (A Sigma_k A'/nu + D/(1-nu)) G', enlarged by the rounding of computing it. The
    radius is NaN where nothing is known.

    Args:
        moved: G A, shape (n, n); of several steps that of all of them.
        D: What disturbances add up to, in the coordinates of G, shape (n, n).
        shapes: Sigma_k, symmetric, shape (k, n, n).
        spread: Bounds of |G| |A| |e|, shape (k,).
        pushed: Bound of |G| |B| |u|.
        rounding: Relative to the products of absolute values.
    """
    reached = moved @ shapes @ moved.T + (spread**2)[:, None, None] * (rounding * np.eye(len(moved)))
    second = np.trace(D) ** 0.5
    first = np.abs(np.trace(reached, axis1=1, axis2=2)) ** 0.5
    first = np.maximum(first, SMALLEST_MULTIPLIER * second)[:, None, None]
    squares, axes = _eigh(reached * (1.0 + second / first) + D * (1.0 + first / second))
    h = np.sqrt(squares[:, -1])
    radius = 1.0 - h - rounding * (spread + pushed)
    weights = np.where(radius[:, None] >= SMALLEST_RADIUS, (h * (1.0 - h))[:, None] / (h[:, None] - squares), 1.0)
    weighting = np.sqrt(weights)[:, :, None] * axes.swapaxes(1, 2)
    usable = np.all(np.isfinite(weighting), axis=(1, 2)) & np.isfinite(radius) & (h > 0.0)
    return weighting, np.where(usable, radius, np.nan)


def norms(vectors: np.ndarray) -> np.ndarray:
    """Returns the Euclidean norms of the columns of an array (n, N), shape (N,)."""
    if len(vectors) == 1:
        return np.abs(vectors[0])
    return np.sqrt((vectors * vectors).sum(axis=0))


def certificate_test(certificate: Certificate, plant: LinearPlant) -> SetTest:
    """Returns the test of the set that a certificate keeps.

    Raises:
        CertificateError: If the ellipsoid is so thin that no norm computed in float64 provably describes it.
    """
    S = certificate.safe_set
    if isinstance(S, Polytope):
        return SetTest(plant, S.rows, np.array([S.low, S.high]))
    return ellipsoid_test(S.shape_matrix, plant)


def ellipsoid_test(L: np.ndarray, plant: LinearPlant) -> SetTest:
    """Returns the test of S = E(L); raises CertificateError as `certificate_test` does."""
    return SetTest(plant, certified_root(L))


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
    """Raises CertificateError unless float64 computes K x_hat on the safe set more accurately than is allowed for.

    D_u allows a shift by 2^-24 u_max, twice what rounding an action to float32 does; the other half is for this.
    """
    S = certificate.safe_set
    if isinstance(S, Polytope):
        faces = faces_of(S, len(plant.box))
        assert faces is not None  # it was verified
        extent = np.array([float(width) for width in faces.widths])
    else:
        extent = np.sqrt(np.diag(S.shape_matrix))
    extent = extent + np.sqrt(np.diagonal(certificate.error_shapes, axis1=1, axis2=2)).max(axis=0)
    extent = extent + 2.0 * np.abs(certificate.resting_state)
    sizes = np.abs(certificate.K) @ extent + np.abs(certificate.resting_input)
    error = (plant.n + 2) * np.finfo(float).eps * sizes
    if not (error <= 0.25 * float(ACTION_ROUNDING) * plant.input_half).all():
        raise CertificateError("the gain is too large against the input limits to compute K x_hat in float64")
