"""The Kalman filter without its mean: covariance, gain and error ellipsoid, which do not depend on what is measured."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ncs_gym.estimation.error_bound import ErrorSet
from ncs_gym.estimation.set_membership import SHAPE_STEP, SetMembership
from ncs_gym.plants.linear_plant import FLAT_INFLATION, LinearPlant
from ncs_gym.uncertainty.shape_matrices import is_inside

# Covariances grow no further than this, in squared half-widths of the safe box.
LARGEST_COVARIANCE = 1e12
# Factors of covariances keep this many bits, so that covariances recur when a pattern of arrivals does.
COVARIANCE_BITS = 6


class ErrorStatistics(NamedTuple):
    """Everything that is known of an estimation error; none of it depends on measurements or inputs.

    Attributes:
        covariance: P, shape (n, n), of a Kalman filter that takes the same samples. It picks gains and is never used
            for safety.
        shape: Sigma_k, shape (n, n): the error x_hat - x lies in E(Sigma_k).
        age: Steps since the newest sample used was taken; the first estimate counts as a sample at step 0.
    """

    covariance: np.ndarray
    shape: np.ndarray
    age: int


class Update(NamedTuple):
    """What using a sample does to an estimate.

    Attributes:
        gain: T, shape (n, p), of x_hat + T (y - H x_hat).
        statistics: Those of the error afterwards.
    """

    gain: np.ndarray
    statistics: ErrorStatistics


class ErrorRecursion:
    """Moves error statistics through predictions and updates, with gains that keep the error in its certified set.

    Args:
        plant: The plant with its bounds.
        quantization_step: Step of the channel's quantizer, in the units of y.
        error_set: The certified sets, by age under a contract.
        covariance_bits: Bits that are kept of the factors of covariances (a gain's optimality is of second order in
            them).
        shape_step: What shapes are rounded up to, as a fraction of the certified set's square extent.
        first: The statistics at the start; by default those of a first estimate.
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
        self._kalman, self._first = _kalman_filter(plant, quantization_step), first

    @property
    def first(self) -> ErrorStatistics:
        """The statistics at the start: by default those of a first estimate, whose error lies in E(r0^2 I)."""
        if self._first is not None:
            return self._first
        return ErrorStatistics(self.plant.kalman_covariances[2].copy(), self.plant.initial_error.shape_matrix.copy(), 0)

    def predicted(self, statistics: ErrorStatistics) -> ErrorStatistics:
        """Returns the statistics one step later, without a sample."""
        covariance, shape, age = statistics
        kalman = self._kalman
        kalman.x, kalman.P = np.zeros(self.plant.n), covariance
        kalman.predict()
        # The covariance of an unstable plant grows without end in an outage; it picks gains and may stop growing.
        if np.vdot(self.plant.weight, kalman.P) < LARGEST_COVARIANCE:
            covariance = kalman.P
        return ErrorStatistics(_rounded(covariance, self._bits), self.sets.predicted(shape, age), age + 1)

    def updated(self, statistics: ErrorStatistics) -> Update | None:
        """Returns what an update does, with the first gain whose ellipsoid lies inside the certified set of age 0.

        After the Kalman and the set-membership gain comes the certified one of the estimate's age, which (C2) maps into
        that set. Without a contract there is none, and None says that the sample must not be used.
        """
        covariance, shape, age = statistics
        newest, ages = self.error_set.shape_at(0), self.error_set.ages
        kalman = self._kalman_update(covariance)
        covariance = covariance if kalman is None else kalman[1]
        if kalman is not None and is_inside(updated := self.sets.updated(shape, kalman[0]), newest):
            return Update(kalman[0], ErrorStatistics(covariance, updated, 0))
        gain = self.sets.gain(shape)
        updated = self.sets.updated(shape, gain)
        if not is_inside(updated, newest):
            if ages is None:
                return None
            certified = self.error_set.shape_at(age)
            if certified is not None and is_inside(shape, certified):
                gain, updated = ages.gains[age - 1], newest  # by (C2)
        return Update(gain, ErrorStatistics(covariance, updated, 0))

    def prefers(self, replayed: ErrorStatistics, present: ErrorStatistics) -> bool:
        """Returns whether a replayed history is better than the present one.

        Under a contract the sets depend on the age, and a newer sample must count.
        """
        if self.error_set.ages is not None and replayed.age < present.age:
            return True
        weight = self.plant.weight
        return bool(np.vdot(weight, replayed.shape) <= np.vdot(weight, present.shape))

    def _kalman_update(self, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns gain and covariance by filterpy; None if it is too ill-conditioned (after a long outage)."""
        kalman = self._kalman
        kalman.x, kalman.P = np.zeros(self.plant.n), covariance
        try:
            kalman.update(np.zeros(self.plant.p))
        except np.linalg.LinAlgError:
            return None
        if not (np.isfinite(kalman.K).all() and np.isfinite(kalman.P).all()):
            return None
        return kalman.K, _rounded(kalman.P, self._bits)


def _rounded(covariance: np.ndarray, bits: int) -> np.ndarray:
    """Returns a covariance whose Cholesky factor has some bits only, relative to powers of two near the deviations."""
    try:
        factor = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return covariance
    steps = np.exp2(np.ceil(0.5 * np.log2(covariance.diagonal())) - bits)[:, None]
    factor = steps * np.rint(factor / steps)
    return factor @ factor.T


def _kalman_filter(plant: LinearPlant, quantization_step: float) -> Any:
    """Returns filterpy's `KalmanFilter`, which has no types, with every matrix set.

    The covariances are the plant's own for this purpose, and that of the sensor plus q^2/12 of a quantizer.
    """
    from filterpy.kalman import KalmanFilter  # takes long to import

    kalman: Any = KalmanFilter(dim_x=plant.n, dim_z=plant.p)
    kalman.F, kalman.H = plant.A, plant.H
    process, sensor, _ = plant.kalman_covariances
    kalman.Q = process
    kalman.R = sensor + quantization_step**2 / 12.0 * np.eye(plant.p)
    if np.linalg.eigvalsh(kalman.R)[0] <= 0.0:  # perfect sensors: keep the innovation covariance invertible
        kalman.R = kalman.R + FLAT_INFLATION * np.diag((np.abs(plant.H) @ plant.half_widths) ** 2)
    return kalman
