"""The error statistics of an estimator, which depend on no measurement: the running ellipsoid, covariance and gains."""

from __future__ import annotations

from math import ceil, isfinite, log2
from typing import NamedTuple

import numpy as np

from ncs_gym.ellipsoid import FLAT_INFLATION, INFLATION, is_inside, outer_sum
from ncs_gym.estimation.error_bound import ErrorSet
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import read_only

# Per dimension, the growth of computed shapes that covers the rounding of F S F' (see `enlarged_by_rounding`).
ROUNDING = 1e-13
# Shapes are rounded up to multiples of this where the certified set of age 0 is the unit ball, so that they recur.
SHAPE_STEP = 2.0**-13
# Multipliers mu that the set-membership gain is chosen from; any of them is sound.
MULTIPLIERS = np.linspace(0.01, 0.99, 99)[:, None]


class SetMembership:
    """Moves the shape Sigma_k of the running ellipsoid: the error x_hat - x lies in E(Sigma_k) (docs/shield_proof.md).

    Args:
        plant: The plant with its bounds.
        quantization_step: Step of the channel's quantizer, in the units of y.
        error_set: The certified sets that shapes stay inside.
        shape_step: What shapes are rounded up to, as a fraction of the certified set's square extent.

    Attributes:
        noise: N, shape (p, p): holds sensor noise and quantization error.
    """

    def __init__(
        self, plant: LinearPlant, quantization_step: float, error_set: ErrorSet, shape_step: float = SHAPE_STEP
    ) -> None:
        from scipy.linalg import solve_triangular  # takes long to import

        self.plant, self.error_set, self.shape_step = plant, error_set, shape_step
        Sigma = error_set.Sigma
        self._ball = np.linalg.cholesky(error_set.shapes[0])
        self._to_ball = solve_triangular(self._ball, np.eye(plant.n), lower=True)
        self._abs_ball, self._abs_to_ball = np.abs(self._ball), np.abs(self._to_ball)
        # Entries of |ball to_ball - I| are at most these.
        self._ball_error = 4.0 * plant.n * np.finfo(float).eps * (self._abs_ball @ self._abs_to_ball)
        noise = plant.sensor_error_with(quantization_step).shape_matrix
        # Perfect sensors get a little noise, relative to what they measure: a larger bound is a bound.
        self.noise = noise + FLAT_INFLATION * np.diag(np.diag(plant.H @ Sigma @ plant.H.T))
        self._noise_extent = np.sqrt(np.diag(self.noise))
        self._abs_A, self._abs_H = np.abs(plant.A), np.abs(plant.H)
        self._information = plant.H.T @ np.linalg.solve(self.noise, plant.H)
        self._identity = np.eye(plant.n)
        self._largest_extent = (2.0 * plant.state_limit) ** 2

    def predicted(self, shape: np.ndarray, age: int) -> np.ndarray:
        """Returns the shape one step after Sigma_k, (n, n), without a sample, given the age of the newest one.

        It is the first of these that lies inside the set of the next age: A Sigma_k A'/lam + D/(1-lam) with the
        trace-optimal lam, the same with the certified rate, the certified set itself, if E(Sigma_k) lies inside the set
        of its own age, which (E1) or (C1) maps into it. If none does, lam is chosen for the way back: the shape reaches
        least far out of the set. Beyond the contract it is the trace-optimal shape.
        """
        A, D, certified = self.plant.A, self.plant.disturbance.shape_matrix, self.error_set.shape_at(age + 1)
        extent = self._abs_A.dot(np.sqrt(shape.diagonal()))
        moved = enlarged_by_rounding(A.dot(shape).dot(A.T), extent)
        predicted = self.rounded_up(outer_sum(moved, D, self.plant.weight))
        if certified is None:
            return self._bounded(predicted)
        if is_inside(predicted, certified):
            return predicted
        rate = self.error_set.rate_at(age)
        carried = self.rounded_up(moved / rate + D / (1.0 - rate))
        if is_inside(carried, certified):
            return carried
        present = self.error_set.shape_at(age)
        if present is not None and is_inside(shape, present):
            return certified
        rates, inward = MULTIPLIERS[..., None], np.linalg.inv(np.linalg.cholesky(certified))
        shapes = np.concatenate([predicted[None], moved / rates + D / (1.0 - rates)])
        best = _least_reach(inward @ shapes @ inward.T)
        return self._bounded(self.rounded_up(shapes[best]) if best else predicted)

    def _bounded(self, shape: np.ndarray) -> np.ndarray:
        """Returns a shape, or one around all differences of states within `plant.state_limit`."""
        limit = self._largest_extent
        return shape if (np.diag(shape) <= limit).all() else self.plant.n * np.diag(limit)

    def updated(self, shape: np.ndarray, gain: np.ndarray, mu: float | None = None) -> np.ndarray:
        """Returns (I-TH) Sigma_k (I-TH)'/mu + T N T'/(1-mu), sound for any T, (n, p); mu is trace-optimal if None."""
        kept = self._identity - gain.dot(self.plant.H)
        size = np.abs(gain)
        extent = np.sqrt(shape.diagonal())
        carried = enlarged_by_rounding(kept.dot(shape).dot(kept.T), extent + size.dot(self._abs_H.dot(extent)))
        noise = enlarged_by_rounding(gain.dot(self.noise).dot(gain.T), size.dot(self._noise_extent))
        total = outer_sum(carried, noise, self.plant.weight) if mu is None else carried / mu + noise / (1.0 - mu)
        return self.rounded_up(INFLATION * total + self.plant.estimate_rounding)

    def gain(self, shape: np.ndarray) -> np.ndarray:
        """Returns T_mu = S H'/mu (H S H'/mu + N/(1-mu))^-1, shape (n, p), S = Sigma_k, with the trace-optimal mu."""
        axes, shares = self._updates(shape)
        weights = (axes * (self.plant.weight @ axes)).sum(axis=0)
        return self._gain(shape, float(MULTIPLIERS[int(np.argmin((weights / shares).sum(axis=1))), 0]))

    def on_the_way_back(self, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the T_mu, and its updated shape, that reaches least far out of the certified set of age 0."""
        axes, shares = self._updates(shape)
        inner = self._to_ball @ axes
        mu = float(MULTIPLIERS[_least_reach((inner / shares[:, None]) @ inner.T), 0])
        gain = self._gain(shape, mu)
        return gain, self.updated(shape, gain, mu)

    def _updates(self, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns G V, shape (n, n), and mu + (1-mu) j for every multiplier, shape (multipliers, n).

        The updated shape of T_mu is (mu S^-1 + (1-mu) H' N^-1 H)^-1 (docs/shield_proof.md); with S = G G' and
        G'H'N^-1HG = V diag(j) V' that is G V diag(mu + (1-mu) j)^-1 V' G'.
        """
        values, vectors = np.linalg.eigh(shape)
        factor = vectors * np.sqrt(np.maximum(values, 0.0))
        gains, basis = np.linalg.eigh(factor.T @ self._information @ factor)
        return factor @ basis, MULTIPLIERS + (1.0 - MULTIPLIERS) * np.maximum(gains, 0.0)

    def _gain(self, shape: np.ndarray, mu: float) -> np.ndarray:
        H = self.plant.H
        spread = shape @ H.T / mu
        innovation = H @ spread + self.noise / (1.0 - mu)
        try:
            return np.linalg.solve(innovation, spread.T).T
        except np.linalg.LinAlgError:  # singular in float64, after long outages
            scale = np.sqrt(np.diag(innovation))
            return ((np.linalg.pinv(innovation / np.outer(scale, scale)) / np.outer(scale, scale)) @ spread.T).T

    def rounded_up(self, shape: np.ndarray) -> np.ndarray:
        """Returns a shape rounded up to multiples of a step where the certified set of age 0 is the unit ball.

        Rounding moves an entry by half a step, hence no direction by more than n halves of one, which is added before.
        """
        inward, outward, size = self._to_ball, self._ball, len(shape)
        extent = np.sqrt(np.abs(shape.diagonal()))
        inner = enlarged_by_rounding(inward.dot(shape).dot(inward.T), self._abs_to_ball.dot(extent))
        inner.flat[:: size + 1] += size * self.shape_step
        inner = self.shape_step * np.rint(inner / self.shape_step)
        reach = self._abs_ball.dot(np.sqrt(inner.diagonal()))
        rounded = enlarged_by_rounding(outward.dot(inner).dot(outward.T), reach)
        # Both products together move the shape S by at most E S + S E', |E| at most `ball_error`; with s the extent and
        # a = max |E| s / s that is at most 2 n a diag(s^2).
        turned = (self._ball_error.dot(extent) / np.maximum(extent, 1e-300)).max().item()
        rounded.flat[:: size + 1] += 2.0 * size * turned * extent**2
        return rounded


def _least_reach(shapes: np.ndarray) -> int:
    """Returns which of the shapes, (k, n, n), has the smallest largest eigenvalue."""
    return int(np.argmin(np.linalg.eigvalsh(shapes)[:, -1]))


def enlarged_by_rounding(product: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Returns a computed F S F', symmetric and enlarged by its rounding, given a = |F| sqrt(diag S), shape (n,).

    Entry (i, j) is off by at most c eps a_i a_j, c of the order of n, and by Cauchy-Schwarz such a matrix is at most
    n c eps diag(a^2). The few roundings of what follows are covered by D's own inflation.
    """
    size = len(extent)
    product = 0.5 * (product + product.T)
    product.flat[:: size + 1] += ROUNDING * size * extent**2
    return product


# Covariances grow no further than this, in squared half-widths of the safe box.
LARGEST_COVARIANCE = 1e12
# Factors of covariances keep this many bits, so that covariances recur when an arrival history does.
COVARIANCE_BITS = 6


def predicted_covariance(P: np.ndarray, A: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """Returns A P A' + Q, shape (n, n): the covariance one step later."""
    return A.dot(P).dot(A.T) + Q


def updated_covariance(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the gain K = P H' (H P H' + R)^-1, shape (n, p), and the covariance (I-KH) P (I-KH)' + K R K', (n, n).

    The products are taken in filterpy's order, so that both agree to the last bit.

    Raises:
        LinAlgError: If H P H' + R is singular.
    """
    spread = P.dot(H.T)
    gain = spread.dot(np.linalg.inv(H.dot(spread) + R))
    kept = np.eye(len(P)) - gain.dot(H)
    return gain, kept.dot(P).dot(kept.T) + gain.dot(R).dot(gain.T)


class ErrorStatistics(NamedTuple):
    """Everything that is known of an estimation error; none of it depends on measurements or inputs.

    Attributes:
        covariance: P, shape (n, n), of a Kalman filter that takes the same samples; it only picks gains.
        shape: Sigma_k, shape (n, n): the error x_hat - x lies in E(Sigma_k).
        age: Steps since the newest sample used was taken; the first estimate counts as one.
        certified: Whether E(Sigma_k) lies in the certified set of its age, and will while the contract is kept: an
            update, or the first estimate, brought it into that of age 0, and (C1) and (C2) lead on. Without a contract,
            whether it lies in the one certified set, which nothing leaves.
    """

    covariance: np.ndarray
    shape: np.ndarray
    age: int
    certified: bool


class ErrorRecursion:
    """Moves error statistics through predictions and updates, with gains that keep the error in its certified set.

    Args:
        plant: The plant with its bounds.
        quantization_step: Step of the channel's quantizer, in the units of y.
        error_set: The certified sets, by age under a contract.
        covariance_bits: Bits that are kept of the factors of covariances.
        shape_step: What shapes are rounded up to, as a fraction of the certified set's square extent.
        first: The statistics at the start; by default those of a first estimate.

    Attributes:
        plant, error_set, first: The same.
        sets: Moves the error shapes.
        Q, R: Covariances that the gains are picked from, shapes (n, n) and (p, p).
    """

    def __init__(
        self,
        plant: LinearPlant,
        quantization_step: float,
        error_set: ErrorSet,
        covariance_bits: int = COVARIANCE_BITS,
        shape_step: float = SHAPE_STEP,
        first: ErrorStatistics | None = None,
    ) -> None:
        self.plant, self.error_set, self._bits = plant, error_set, covariance_bits
        self.sets = SetMembership(plant, quantization_step, error_set, shape_step)
        # Q + gamma I (Liu et al. Definition 1), where a declared disturbance counts as the ball of gamma does; other
        # bounds count with the covariance of a uniform draw, P / (dim + 2).
        Q, remainder = plant.of_disturbance.covariance(1.0), plant.remainder_bound
        self.Q = read_only(Q if remainder is None else Q + remainder.shape_matrix)
        self.R = _sensor_covariance(plant, quantization_step)
        if first is None:
            shape, covariance = plant.initial_error.shape_matrix, plant.of_first_error.covariance(plant.n + 2)
            first = ErrorStatistics(read_only(covariance), shape, 0, is_inside(shape, error_set.shapes[0]))
        self.first = first
        # Deviations of states that nothing disturbs would become smaller for ever, and covariances would not recur:
        # they are no smaller than this share of the largest one, each in units of what the certified set allows.
        self._share, self._units = 2.0 ** -(covariance_bits + 4), np.sqrt(np.diag(error_set.shapes[0]))

    def predicted(self, statistics: ErrorStatistics) -> ErrorStatistics:
        """Returns the statistics one step later, without a sample."""
        covariance, shape, age, certified = statistics
        # The covariance of an unstable plant grows without end in an outage; it picks gains and may stop growing.
        grown = predicted_covariance(covariance, self.plant.A, self.Q)
        if np.vdot(self.plant.weight, grown) < LARGEST_COVARIANCE:
            covariance = grown
        predicted = self.sets.predicted(shape, age)
        certified = self.error_set.remains_certified(certified, age, predicted)
        return ErrorStatistics(self._rounded(covariance), predicted, age + 1, certified)

    def updated(self, statistics: ErrorStatistics) -> tuple[np.ndarray, ErrorStatistics] | None:
        """Returns the gain T, shape (n, p), of x_hat + T (y - H x_hat), and the statistics after that update.

        It is the first gain whose ellipsoid lies inside the certified set of age 0: the Kalman gain, the set-membership
        one, under a contract the certified one of the estimate's age, which (C2) maps into the set. If none does, it is
        that of the way back, which reaches least far out of the set; without a contract the sample must not be used
        then, which None says.
        """
        covariance, shape, age, _ = statistics
        certified = self.error_set
        newest = certified.shapes[0]
        kalman = self._kalman_update(covariance)
        covariance = covariance if kalman is None else kalman[1]
        gains = [self.sets.gain(shape)] if kalman is None else [kalman[0], self.sets.gain(shape)]
        for gain in gains:
            updated = self.sets.updated(shape, gain)
            if is_inside(updated, newest):
                return gain, ErrorStatistics(covariance, updated, 0, True)
        if certified.contract is not None:
            assert age > 0  # every update follows a prediction
            last = min(age, certified.oldest)  # whatever lies in a set is led back by its gain
            if is_inside(shape, certified.shapes[last]):
                return certified.gains[last - 1], ErrorStatistics(covariance, newest, 0, True)  # by (C2)
        gain, updated = self.sets.on_the_way_back(shape)
        inside = is_inside(updated, newest)
        if certified.contract is None and not inside:
            return None
        return gain, ErrorStatistics(covariance, updated, 0, inside)

    def prefers(self, replayed: ErrorStatistics, present: ErrorStatistics) -> bool:
        """Returns whether a replayed history is better than the present one; under a contract a newer sample counts."""
        if self.error_set.contract is not None and replayed.age < present.age:
            return True
        weight = self.plant.weight
        return bool(np.vdot(weight, replayed.shape) <= np.vdot(weight, present.shape))

    def _kalman_update(self, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns gain and covariance of the Kalman filter; None if it is too ill-conditioned."""
        try:
            gain, covariance = updated_covariance(covariance, self.plant.H, self.R)
        except np.linalg.LinAlgError:
            return None
        if not (isfinite(gain.sum()) and isfinite(covariance.sum()) and min(covariance.diagonal().tolist()) >= 0.0):
            return None
        return gain, self._rounded(covariance)

    def _rounded(self, covariance: np.ndarray) -> np.ndarray:
        largest = (np.sqrt(covariance.diagonal()) / self._units).max()
        smallest = self._share * min(max(largest, self._share), 1.0) * self._units
        return _rounded(covariance, self._bits, smallest)


def _rounded(covariance: np.ndarray, bits: int, smallest: np.ndarray) -> np.ndarray:
    """Returns a covariance whose Cholesky factor has some bits only, relative to powers of two near the deviations.

    Deviations are at least the `smallest`, shape (n,), but of states that are known exactly.
    """
    if not covariance.diagonal().all():
        uncertain = np.flatnonzero(covariance.diagonal())
        among, rounded = np.ix_(uncertain, uncertain), np.zeros_like(covariance)
        rounded[among] = _rounded(covariance[among], bits, smallest[uncertain])
        return rounded
    try:
        factor = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return covariance
    steps = np.array([[2.0 ** (ceil(0.5 * log2(variance)) - bits)] for variance in covariance.diagonal().tolist()])
    factor = steps * np.rint(factor / steps)
    np.fill_diagonal(factor, np.maximum(factor.diagonal(), smallest))
    return factor.dot(factor.T)


def _sensor_covariance(plant: LinearPlant, quantization_step: float) -> np.ndarray:
    """Returns R, shape (p, p), with q^2/12 of a quantizer, invertible."""
    R = plant.of_sensor.covariance(plant.p + 2) + quantization_step**2 / 12.0 * np.eye(plant.p)
    scale = np.sqrt(np.diag(R))
    # Of perfect sensors the innovation covariance stays invertible.
    if not scale.all() or np.linalg.eigvalsh(R / np.outer(scale, scale))[0] <= 0.0:
        R = R + FLAT_INFLATION * np.diag((np.abs(plant.H) @ plant.half_widths) ** 2)
    return R
