"""The Kalman filter without its mean: covariance, gain and error ellipsoid, which do not depend on what is measured."""

from __future__ import annotations

from math import ceil, isfinite, log2
from typing import NamedTuple

import numpy as np

from ncs_gym.estimation.error_sets import ErrorSet
from ncs_gym.estimation.set_membership import SHAPE_STEP, SetMembership
from ncs_gym.plants.hard_bounds import FLAT_INFLATION
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.ellipsoid import is_inside

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
        self.Q, self.R = plant.kalman_covariances[0], _sensor_covariance(plant, quantization_step)
        if first is None:
            shape = plant.initial_error.shape_matrix
            first = ErrorStatistics(plant.kalman_covariances[2], shape, 0, is_inside(shape, error_set.shapes[0]))
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
    R = plant.kalman_covariances[1] + quantization_step**2 / 12.0 * np.eye(plant.p)
    scale = np.sqrt(np.diag(R))
    # Of perfect sensors the innovation covariance stays invertible.
    if not scale.all() or np.linalg.eigvalsh(R / np.outer(scale, scale))[0] <= 0.0:
        R = R + FLAT_INFLATION * np.diag((np.abs(plant.H) @ plant.half_widths) ** 2)
    return R
