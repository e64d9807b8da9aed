"""The delay-aware Kalman filter with a running hard ellipsoid around its error."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.linalg import solve_triangular

from ncs_gym.estimation.error_bound import ErrorSet, certified_error_set
from ncs_gym.network.channel import Channel, Packet
from ncs_gym.plants.linear_plant import FLAT_INFLATION, INFLATION, LinearPlant
from ncs_gym.uncertainty.ellipsoid import is_inside, outer_sum
from ncs_gym.uncertainty.minkowski_sum import common_axes, outside_sum

# Per dimension, the growth of computed shapes that covers the rounding of F S F' (see `_grown`).
ROUNDING = 1e-13
# An innovation this far beyond its exact bound counts as rounding, not as an alarm.
ALARM_TOLERANCE = 1e-9
# Covariances grow no further than this, in squared half-widths of the safe box.
LARGEST_COVARIANCE = 1e12
# Up to this condition number an inverse says which residuals are possible to within 1e-3.
FAITHFUL = 1e7
# Factors of covariances keep this many bits, and shapes are rounded up to multiples of this in coordinates where the
# certified set of age 0 is the unit ball. Then both recur when a pattern of arrivals does, and can be tabulated.
COVARIANCE_BITS, SHAPE_STEP = 6, 2.0**-13
# Shares mu that the set-membership gain is chosen from; any share is sound.
SHARES = np.linspace(0.01, 0.99, 99)


class Belief(NamedTuple):
    """What is known about the state at one step.

    Attributes:
        mean: x_hat, shape (n,).
        covariance: P, shape (n, n), of a Kalman filter that takes the same samples; picks gains and is never used for
            safety.
        shape: Sigma_k, shape (n, n): x_hat - x lies in E(Sigma_k).
        newest: Step of the newest sample used (0: the first estimate).
    """

    mean: np.ndarray
    covariance: np.ndarray
    shape: np.ndarray
    newest: int


class Update(NamedTuple):
    """What a measurement does to a belief, whatever it says.

    Attributes:
        gain: T, shape (n, p).
        covariance: P afterwards, shape (n, n).
        shape: Sigma_k afterwards, shape (n, n).
    """

    gain: np.ndarray
    covariance: np.ndarray
    shape: np.ndarray


class Estimator:
    """Estimates the state from time-stamped packets that may be lost, late, reordered or duplicated.

    A packet is applied at its own step and everything after it is replayed. Next to mean and covariance
    runs a hard ellipsoid E(Sigma_k) that holds the error at every step and never leaves the certified
    E(Sigma) (theory.md section 3): predictions and updates are accepted only inside it.

    Args:
        plant: The plant, whose inputs the estimator knows exactly.
        channel: Gives the quantizer's error and the longest delay, hence the replay buffer.
        error_set: E(Sigma) with its rate; computed from the plant by default.
        covariance_bits: Bits kept of the factors of covariances (a gain's optimality is of second order in them).
        shape_step: What shapes are rounded up to, as a share of the certified set's square extent.

    Raises:
        UnstablePlantError: If no error set is given and the plant is not Schur stable.
        ValueError: If the channel rounds more coarsely than the contract of the error set allows.
    """

    def __init__(
        self,
        plant: LinearPlant,
        channel: Channel,
        error_set: ErrorSet | None = None,
        covariance_bits: int = COVARIANCE_BITS,
        shape_step: float = SHAPE_STEP,
    ) -> None:
        self.plant, self._bits, self._step = plant, covariance_bits, shape_step
        self.error_set = certified_error_set(plant) if error_set is None else error_set
        ages = self.error_set.ages
        if ages is not None and not ages.contract.is_fine_enough_for(channel):
            raise ValueError(f"the channel rounds more coarsely than the contract of the error set: {ages.contract}")
        self.channel, self.buffer = channel, channel.longest_delay
        Sigma = self.error_set.Sigma
        self._ball = np.linalg.cholesky(self.error_set.shape_at(0))
        identity = np.eye(plant.n)
        self._to_ball = solve_triangular(self._ball, identity, lower=True)
        # Entries of |ball to_ball - I| are at most these.
        self._ball_error = 4.0 * plant.n * np.finfo(float).eps * (np.abs(self._ball) @ np.abs(self._to_ball))
        noise = plant.sensor_error_with(channel.quantization_step).shape
        # Perfect sensors get a little noise, relative to what they measure: a larger bound is a bound.
        self._noise = noise + FLAT_INFLATION * np.diag(np.diag(plant.H @ Sigma @ plant.H.T))
        self._noise_extent = np.sqrt(np.diag(self._noise))
        self._abs_A, self._abs_H = np.abs(plant.A), np.abs(plant.H)
        self._information = plant.H.T @ np.linalg.solve(self._noise, plant.H)
        self._identity = identity
        self._filter = _kalman_filter(plant, channel.quantization_step)
        self.reset(np.zeros(plant.n))

    def reset(self, mean: np.ndarray) -> None:
        """Starts an episode at step 0 with a first estimate, shape (n,), whose error lies in E(r0^2 I)."""
        self.step = 0
        self.alarm = False
        first = self.plant.initial_error.shape
        self.belief = Belief(np.array(mean, dtype=np.float64), self.plant.initial_cov.copy(), first.copy(), 0)
        self._priors: dict[int, Belief] = {}
        self._inputs: dict[int, np.ndarray] = {}
        self._samples: dict[int, np.ndarray] = {}

    @property
    def age(self) -> int:
        """Steps since the newest sample used was taken; the first estimate counts as a sample at step 0."""
        return self.step - self.belief.newest

    def advance(self, u: np.ndarray, packets: Iterable[Packet]) -> None:
        """Moves one step on: predicts with the input really applied, then takes in what arrived.

        Args:
            u: Applied input, shape (m,) [physical units].
            packets: In any order. Stamps from the future, from before the first step, older than the
                replay buffer or seen before are discarded.
        """
        self._inputs[self.step] = np.array(u, dtype=np.float64)
        self.step += 1
        self.belief = self._priors[self.step] = self._predict(self.belief, u, self.step - 1 - self.belief.newest)
        for packet in packets:
            self._receive(packet)
        expired = self.step - self.buffer - 1
        for history in (self._priors, self._inputs, self._samples):
            history.pop(expired, None)

    def _receive(self, packet: Packet) -> None:
        """Replays from the packet's stamp and keeps whichever history ends with the smaller ellipsoid."""
        stamp = packet.stamp
        if stamp not in self._priors or stamp in self._samples:
            return
        if not np.isfinite(packet.measurement).all():
            self.alarm = True  # no sensor within the assumptions sends this
            return
        self._samples[stamp] = packet.measurement
        priors = {stamp: self._priors[stamp]}
        for step in range(stamp, self.step + 1):
            belief = priors[step]
            if step in self._samples:
                belief = self._update(belief, self._samples[step], step)
            if step < self.step:
                priors[step + 1] = self._predict(belief, self._inputs[step], step - belief.newest)
        if self.prefers(belief.shape, self.step - belief.newest, self.belief.shape, self.age):
            self.belief = belief
            self._priors.update(priors)

    def _predict(self, belief: Belief, u: np.ndarray, age: int) -> Belief:
        """Returns the belief, of some age, one step later: mean A x_hat + B u, shape A Sigma_k A'/lam + D/(1-lam)."""
        kalman = self._filter
        kalman.x, kalman.P = belief.mean, belief.covariance
        kalman.predict(u)
        mean = np.clip(kalman.x, -self.plant.farthest, self.plant.farthest)
        # The covariance of an unstable plant grows without end in an outage; it picks gains and may stop growing.
        grows = np.vdot(self.plant.weight, kalman.P) < LARGEST_COVARIANCE
        covariance = kalman.P if grows else belief.covariance
        covariance = _settled(covariance, self._bits)
        return Belief(mean, covariance, self._predicted_shape(belief.shape, age), belief.newest)

    def _predicted_shape(self, shape: np.ndarray, age: int) -> np.ndarray:
        """Returns the first of: trace-optimal lam, certified rate, certified set, that lies inside the next age's set.

        That set itself is sound if E(shape) lies inside the set of its age, which (E1) or (C1) maps into it. Beyond
        the contract no set is certified; the trace-optimal shape still holds the error.
        """
        A, D, certified = self.plant.A, self.plant.disturbance.shape, self.error_set.shape_at(age + 1)
        extent = self._abs_A @ np.sqrt(shape.diagonal())
        moved = _grown(A @ shape @ A.T, extent)
        predicted = self._settled_shape(outer_sum(moved, D, self.plant.weight))
        if certified is None:
            return self._bounded(predicted)
        if is_inside(predicted, certified):
            return predicted
        rate = self.error_set.rate_at(age)
        carried = self._settled_shape(moved / rate + D / (1.0 - rate))
        if is_inside(carried, certified):
            return carried
        present = self.error_set.shape_at(age)
        return certified if present is not None and is_inside(shape, present) else self._bounded(predicted)

    def _bounded(self, shape: np.ndarray) -> np.ndarray:
        """Returns a shape, or one around all differences of states that do not lie beyond `plant.farthest`."""
        widest = (2.0 * self.plant.farthest) ** 2
        return shape if (np.diag(shape) <= widest).all() else self.plant.n * np.diag(widest)

    def _update(self, belief: Belief, measurement: np.ndarray, step: int) -> Belief:
        """Returns the belief after a measurement; the same if the guard turns it down."""
        H = self.plant.H
        residual = measurement - H @ belief.mean
        self._monitor(residual, H @ belief.shape @ H.T)
        update = self.update_of(belief.covariance, belief.shape, step - belief.newest)
        if update is None:
            return belief
        return Belief(belief.mean + update.gain @ residual, update.covariance, update.shape, step)

    def update_of(self, covariance: np.ndarray, shape: np.ndarray, age: int) -> Update | None:
        """Returns what an update does to a belief, with the first gain whose ellipsoid lies inside the set of age 0.

        After the Kalman and the set-membership gain comes the certified one of the belief's age, which (C2) maps into
        that set. Without a contract there is none, and None says that the sample must not be used.

        Args:
            covariance: P, shape (n, n).
            shape: Sigma_k, shape (n, n).
            age: Of the newest sample used.
        """
        newest = self.error_set.shape_at(0)
        kalman = self._kalman_update(covariance)
        updated_covariance = covariance if kalman is None else kalman[1]
        if kalman is not None and is_inside(updated := self._updated_shape(shape, kalman[0]), newest):
            return Update(kalman[0], updated_covariance, updated)
        gain = self._membership_gain(shape)
        updated = self._updated_shape(shape, gain)
        ages = self.error_set.ages
        if not is_inside(updated, newest):
            if ages is None:
                return None
            certified = self.error_set.shape_at(age)
            if certified is not None and is_inside(shape, certified):
                gain, updated = ages.gains[age - 1], newest  # by (C2)
        return Update(gain, updated_covariance, updated)

    def prefers(self, shape: np.ndarray, age: int, present: np.ndarray, present_age: int) -> bool:
        """Returns whether a replayed belief is better than the present one, by their shapes (n, n) and ages.

        Under a contract the sets depend on the age, and a newer sample must count.
        """
        if self.error_set.ages is not None and age < present_age:
            return True
        return bool(np.vdot(self.plant.weight, shape) <= np.vdot(self.plant.weight, present))

    def _kalman_update(self, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns gain and covariance by filterpy; None if it is too ill-conditioned (after a long outage)."""
        kalman = self._filter
        kalman.x, kalman.P = np.zeros(self.plant.n), covariance
        try:
            kalman.update(np.zeros(self.plant.p))
        except np.linalg.LinAlgError:
            return None
        if not (np.isfinite(kalman.K).all() and np.isfinite(kalman.P).all()):
            return None
        return kalman.K, _settled(kalman.P, self._bits)

    def _updated_shape(self, shape: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """Returns (I-TH) Sigma_k (I-TH)'/mu + T N T'/(1-mu) with the trace-optimal mu: sound for any gain T."""
        kept = self._identity - gain @ self.plant.H
        size = np.abs(gain)
        extent = np.sqrt(shape.diagonal())
        carried = _grown(kept @ shape @ kept.T, extent + size @ (self._abs_H @ extent))
        noise = _grown(gain @ self._noise @ gain.T, size @ self._noise_extent)
        return self._settled_shape(
            INFLATION * outer_sum(carried, noise, self.plant.weight) + self.plant.estimate_rounding
        )

    def _settled_shape(self, shape: np.ndarray) -> np.ndarray:
        """Returns a shape rounded up to multiples of a step where the certified set of age 0 is the unit ball.

        Rounding moves an entry by half a step, hence no direction by more than n halves of one, which is added before.
        """
        inward, outward = self._to_ball, self._ball
        inner = _grown(inward @ shape @ inward.T, np.abs(inward) @ np.sqrt(np.abs(shape.diagonal())))
        inner.flat[:: len(inner) + 1] += len(inner) * self._step
        inner = self._step * np.round(inner / self._step)
        settled = _grown(outward @ inner @ outward.T, np.abs(outward) @ np.sqrt(inner.diagonal()))
        # Both products together move the shape S by at most E S + S E', |E| at most `ball_error`; with s the extent and
        # a = max |E| s / s that is at most 2 n a diag(s^2).
        extent = np.sqrt(np.abs(shape.diagonal()))
        turned = float(np.max(self._ball_error @ extent / np.maximum(extent, 1e-300)))
        settled.flat[:: len(inner) + 1] += 2.0 * len(inner) * turned * extent**2
        return settled

    def _membership_gain(self, shape: np.ndarray) -> np.ndarray:
        """Returns T_mu = S H'/mu (H S H'/mu + N/(1-mu))^-1, shape (n, p), with the trace-optimal mu.

        Its updated shape is (mu S^-1 + (1-mu) H' N^-1 H)^-1 (theory.md section 3); with S = G G' and
        G'H'N^-1HG = V diag(j) V' the weighted trace is a sum of w_i / (mu + (1-mu) j_i).
        """
        H = self.plant.H
        values, vectors = np.linalg.eigh(shape)
        factor = vectors * np.sqrt(np.maximum(values, 0.0))
        gains, basis = np.linalg.eigh(factor.T @ self._information @ factor)
        axes = factor @ basis
        weights = (axes * (self.plant.weight @ axes)).sum(axis=0)
        traces = (weights / (SHARES[:, None] + (1.0 - SHARES[:, None]) * np.maximum(gains, 0.0))).sum(axis=1)
        mu = SHARES[int(np.argmin(traces))]
        spread = shape @ H.T / mu
        return _solved(H @ spread + self._noise / (1.0 - mu), spread.T).T

    def _monitor(self, residual: np.ndarray, spread: np.ndarray) -> None:
        """Latches the alarm if a residual y - H x_hat lies outside E(H Sigma H') + E(N).

        The ellipsoid of shape H Sigma H' + N lies inside that sum, so passing it settles the matter.
        """
        if residual @ _solved(spread + self._noise, residual) > 1.0:
            self.alarm |= bool(self.are_impossible(residual[None], spread)[0])

    def are_impossible(self, residuals: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """Returns which residuals, shape (k, p), lie outside E(spread) + E(N), spread = H Sigma_k H'."""
        return outside_sum(residuals, spread, self._noise, ALARM_TOLERANCE)

    def residual_axes(self, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the axes common to H Sigma_k H' and N, in which `are_impossible` is quick; see `common_axes`."""
        return common_axes(spread, self._noise)

    def inverse_of_bound(self, spread: np.ndarray) -> np.ndarray:
        """Returns (spread + N)^-1, shape (p, p), of the quick test: r'(spread + N)^-1 r <= 1 is possible.

        Infinite on the diagonal where an inverse would be too inexact to vouch for anything: no residual passes then.
        """
        bound = spread + self._noise
        extent = np.sqrt(bound.diagonal())
        if not np.linalg.cond(bound / np.outer(extent, extent)) <= FAITHFUL:  # in units of its own, or not a number
            return np.diag(np.full(self.plant.p, np.inf))
        return _solved(bound, np.eye(self.plant.p))


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Returns matrix^-1 right, by the pseudo-inverse where the matrix is singular in float64 (after long outages)."""
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(matrix) @ right


def _settled(covariance: np.ndarray, bits: int) -> np.ndarray:
    """Returns a covariance whose Cholesky factor has some bits only, relative to powers of two near the deviations."""
    try:
        factor = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return covariance
    steps = np.exp2(np.ceil(0.5 * np.log2(covariance.diagonal())) - bits)[:, None]
    factor = steps * np.round(factor / steps)
    return factor @ factor.T


def _grown(product: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Returns a computed F S F', symmetric and enlarged by its rounding in whatever units (in place).

    With a = |F| sqrt(diag S) entry (i, j) is off by at most c eps a_i a_j, c of the order of n, and by Cauchy-Schwarz
    such a matrix is at most n c eps diag(a^2). The few roundings of what follows are covered by D's own inflation.

    Args:
        product: F S F' as computed, shape (n, n).
        extent: a, shape (n,).
    """
    size = len(extent)
    product = 0.5 * (product + product.T)
    product.flat[:: size + 1] += ROUNDING * size * extent**2
    return product


def _kalman_filter(plant: LinearPlant, quantization_step: float) -> Any:
    """Returns filterpy's `KalmanFilter`, which has no types, with every matrix set.

    The process covariance is Q + gamma I (Liu et al. Definition 3), the sensor's R plus q^2/12 of a quantizer.
    """
    kalman: Any = KalmanFilter(dim_x=plant.n, dim_z=plant.p, dim_u=plant.m)
    kalman.x = np.zeros(plant.n)
    kalman.F, kalman.B, kalman.H = plant.A, plant.B, plant.H
    kalman.Q = plant.process_noise_cov + plant.gamma * np.eye(plant.n)
    kalman.R = plant.measurement_noise_cov + quantization_step**2 / 12.0 * np.eye(plant.p)
    if np.linalg.eigvalsh(kalman.R)[0] <= 0.0:  # perfect sensors: keep the innovation covariance invertible
        kalman.R = kalman.R + FLAT_INFLATION * np.diag((np.abs(plant.H) @ plant.half_widths) ** 2)
    return kalman
