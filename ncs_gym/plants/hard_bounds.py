"""Hard bounds of what is declared of a plant's uncertainties: what proofs take, and simulations draw from.

They are the same numbers on every machine (`ncs_gym.exact`).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import DELTA, Ball, Sum
from ncs_gym.uncertainty.ellipsoid import Ellipsoid, ellipsoid_around_sum
from ncs_gym.uncertainty.truncated_gaussian import TruncatedGaussian, truncation_energy
from ncs_gym.validation import ReadOnlyArrays, read_only

# Relative growth of every hard bound, so that rounding in sampling and quantizing stays inside (docs/shield_proof.md).
INFLATION = 1.0 + 1e-9
# The same for directions in which a bound is flat: growth of its diagonal alone.
FLAT_INFLATION = 1e-12
# No disturbance set is thinner than this, in squared half-widths of the safe box.
THINNEST = 1e-19
# Simulating a step in float64 rounds; the disturbance bound has room for that up to this many half-widths out.
SIMULATED_REACH = 100.0
# A state that the box says nothing of is as large as this many times what it reaches from rest in n steps.
FREE_REACH = 100.0


class Source(NamedTuple):
    """What is declared of one uncertainty, in the dimension of the plant: the sum of all.

    Attributes:
        ball: Squared radius of a ball.
        noise: Truncated Gaussian noise, whose covariance is zero where there is none.
        bound: An ellipsoid around what else is declared; None if nothing is.
    """

    ball: float
    noise: TruncatedGaussian
    bound: Ellipsoid | None

    def ellipsoids(self) -> list[Ellipsoid]:
        """Returns the bounds that add up to the whole one, in dimension n."""
        ball = Ellipsoid(self.ball * np.eye(len(self.noise.covariance)))
        return [ball, self.noise.bound, *([] if self.bound is None else [self.bound])]

    def drawn(self, rng: np.random.Generator, count: int | None = None, *, truncated: bool = True) -> np.ndarray:
        """Returns noise, truncated or not, plus a uniform point of the bound unless that is one, (n,) or (count, n)."""
        samples = self.noise.sample(rng, count, truncated=truncated)
        if self.bound is None or not self.bound.shape_matrix.any():
            return samples
        return samples + self.bound.sample(rng, count)


def source_of(declared: Any, weight: np.ndarray, past: int = 0, *, keeps_ball: bool = False) -> Source:
    """Returns what a sum of sets declares of the own states of a plant, or of its outputs.

    Args:
        declared: The sum.
        weight: W, by which a sum of several sets becomes one ellipsoid.
        past: How many past inputs follow, of which nothing is uncertain.
        keeps_ball: Whether a `Ball` stands for itself, which it cannot beside past inputs.

    Raises:
        ValueError: If a set is in another dimension, or one with two different ends is added to others.
    """
    size, gaussian = len(weight), declared.gaussian
    covariance, delta = (np.zeros((size, size)), DELTA) if gaussian is None else (gaussian.covariance, gaussian.delta)
    noise = TruncatedGaussian(np.pad(covariance, (0, past)), truncation_energy(delta, size), past)
    others = [each for each in declared.parts if each is not gaussian]
    balls = [each for each in others if isinstance(each, Ball)] if keeps_ball and not past else []
    others = tuple(each for each in others if each not in balls)
    bound = Sum(others).sized(size).as_one(weight).ellipsoid() if others else None
    if bound is not None and past:
        bound = Ellipsoid(np.pad(bound.shape_matrix, (0, past)))
    return Source(float(np.square(sum(each.radius for each in balls))), noise, bound)


class HardBounds(ReadOnlyArrays):
    """The bounds of disturbances, sensor noise and first estimates of a `LinearPlant`, by what is declared of them."""

    A: np.ndarray
    B: np.ndarray
    box: np.ndarray
    n: int
    m: int
    p: int
    past: int
    largest_input: np.ndarray
    of_disturbance: Source
    of_sensor: Source
    of_first_error: Source
    remainder: Any

    @property
    def gamma(self) -> float:
        """Squared radius of the ball that disturbances add."""
        return self.of_disturbance.ball

    @property
    def process_noise_cov(self) -> np.ndarray:
        """Q, shape (n, n); zero where no Gaussian is declared."""
        return self.of_disturbance.noise.covariance

    @property
    def measurement_noise_cov(self) -> np.ndarray:
        """R, shape (p, p), alike."""
        return self.of_sensor.noise.covariance

    @property
    def initial_cov(self) -> np.ndarray:
        """P0, shape (n, n), alike."""
        return self.of_first_error.noise.covariance

    @property
    def disturbance_bound(self) -> Ellipsoid | None:
        """What holds the other disturbances; None if no other set is declared."""
        return self.of_disturbance.bound

    @property
    def sensor_bound(self) -> Ellipsoid | None:
        """What holds other sensor noise, alike."""
        return self.of_sensor.bound

    @property
    def initial_bound(self) -> Ellipsoid | None:
        """What holds another error of the first estimate, alike."""
        return self.of_first_error.bound

    @cached_property
    def remainder_bound(self) -> Ellipsoid | None:
        """What holds the remainder of a model, shape (n, n); None if there is none."""
        bound = None if self.remainder is None else self.remainder.bound
        return bound if bound is None or not self.past else Ellipsoid(np.pad(bound.shape_matrix, (0, self.past)))

    @cached_property
    def weight(self) -> np.ndarray:
        """Positive definite W, shape (n, n), that measures ellipsoids in units of the safe box: C'C, regularized."""
        return read_only(weight_of(self.box, self.reach_from_rest))

    @cached_property
    def reach_from_rest(self) -> np.ndarray:
        """How far inputs take each state in n steps at most, from about as far as noise does in one, shape (n,)."""
        sources = self.of_disturbance, self.of_first_error
        bounded = [ball_or for each in sources for ball_or in each.ellipsoids() if ball_or is not each.noise.bound]
        shapes = [*(each.noise.covariance for each in sources), *(each.shape_matrix for each in bounded)]
        noise = [np.diag(each) for each in shapes]
        reach = np.sqrt(np.sum(noise, axis=0))
        return read_only(reach_in_steps(self.A, self.B, self.largest_input, reach))

    @cached_property
    def _box_shape(self) -> np.ndarray:
        """The inverse of `weight`, shape (n, n): that of the ellipsoid {x : x'Wx <= 1}."""
        return exact.inverse(self.weight)

    @cached_property
    def relative_weight(self) -> np.ndarray:
        """W in units of its largest entry, shape (n, n): the identity exactly if the box is a cube."""
        return read_only(self.weight / self.weight.max())

    @cached_property
    def half_widths(self) -> np.ndarray:
        """Half-widths of the ellipsoid {x : x'Wx <= 1} around the safe box' center, shape (n,)."""
        return read_only(np.sqrt(np.diag(self._box_shape)))

    @cached_property
    def process_noise(self) -> TruncatedGaussian:
        """w ~ N(0, Q) truncated at chi2_{n,1-delta}."""
        return self.of_disturbance.noise

    @cached_property
    def sensor_noise(self) -> TruncatedGaussian:
        """v ~ N(0, R) truncated at chi2_{p,1-delta}; what lies in `sensor_bound` is added to it."""
        return self.of_sensor.noise

    @cached_property
    def initial_noise(self) -> TruncatedGaussian:
        """e_0 ~ N(0, P0) truncated at chi2_{n,1-delta}; what lies in `initial_bound` is added to it."""
        return self.of_first_error.noise

    @cached_property
    def disturbance(self) -> Ellipsoid:
        """D, shape (n, n): holds declared disturbances, truncated process noise, remainder, rounding of a simulation.

        It is larger than `allowed_disturbance` by what holds that plus E(F), F = n diag(r^2), with r the rounding of
        A x + B u + d for x up to SIMULATED_REACH half-widths out: (1+s/4) allowed + (1+4/s) F, s the inflation.
        """
        return Ellipsoid(inflated(self.nominal_disturbance.shape_matrix) + self._rounding_margin)

    @cached_property
    def allowed_disturbance(self) -> Ellipsoid:
        """What a disturbance may use of D: the rest is for the rounding of a simulation, shape (n, n)."""
        nominal = self.nominal_disturbance.shape_matrix
        return Ellipsoid(0.5 * (nominal + inflated(nominal)) + 0.5 * self._rounding_margin)

    @cached_property
    def _rounding_margin(self) -> np.ndarray:
        """What D gains for rounding, shape (n, n)."""
        reach = SIMULATED_REACH * self.half_widths
        rounding = exact.product(np.abs(self.A), reach) + exact.product(np.abs(self.B), self.largest_input) + reach
        rounding *= (self.n + self.m + 2) * np.finfo(float).eps
        return THINNEST * self._box_shape + 10.0 * self.n / (INFLATION - 1.0) * np.diag(np.square(rounding))

    @cached_property
    def nominal_disturbance(self) -> Ellipsoid:
        """D before inflation: where extremal disturbances are drawn, so that their rounding stays inside E(D)."""
        W = self.relative_weight
        return ellipsoid_around_sum(W, *self.of_disturbance.ellipsoids(), self.remainder_bound)

    @cached_property
    def nominal_sensor_error(self) -> Ellipsoid:
        """Holds the sensor noise v before inflation, shape (p, p): the truncated noise plus `sensor_bound`."""
        return ellipsoid_around_sum(np.eye(self.p), *self.of_sensor.ellipsoids())

    @cached_property
    def sensor_error(self) -> Ellipsoid:
        """Holds the sensor noise v, shape (p, p), without the channel's quantizer (see `sensor_error_with`)."""
        return Ellipsoid(inflated(self.nominal_sensor_error.shape_matrix))

    def sensor_error_with(self, quantization_step: float) -> Ellipsoid:
        """Returns N, shape (p, p): sensor noise plus the ball of squared radius p q^2/4 around a quantizer's box."""
        ball = Ellipsoid(self.p * quantization_step**2 / 4.0 * np.eye(self.p))
        return Ellipsoid(inflated(ellipsoid_around_sum(np.eye(self.p), ball, self.nominal_sensor_error).shape_matrix))

    @cached_property
    def initial_radius_squared(self) -> float:
        """r0^2 = lambda_max(P0) chi2_{n,1-delta}: the truncated first error is no longer than r0."""
        return max(exact.largest_eigenvalue(self.initial_noise.bound.shape_matrix), 0.0)

    @cached_property
    def nominal_initial_error(self) -> Ellipsoid:
        """Holds the error of the first estimate before inflation, shape (n, n): the ball of r0 plus `initial_bound`."""
        unknown = np.arange(self.n) < self.n - self.past
        ball = Ellipsoid(self.initial_radius_squared * np.diag(unknown.astype(float)))
        return ellipsoid_around_sum(self.relative_weight, ball, self.initial_bound)

    @cached_property
    def initial_error(self) -> Ellipsoid:
        """Holds the error of the first estimate, shape (n, n), with slack for rounding."""
        return Ellipsoid(inflated(self.nominal_initial_error.shape_matrix) + self.estimate_rounding)

    @cached_property
    def estimate_rounding(self) -> np.ndarray:
        """Room for the rounding of x_hat up to SIMULATED_REACH half-widths out, shape (n, n), next to an inflation."""
        rounding = 4.0 * np.finfo(float).eps * SIMULATED_REACH * self.half_widths
        return read_only(2.0 * self.n / (INFLATION - 1.0) * np.diag(np.square(rounding)))

    @cached_property
    def kalman_covariances(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Covariances (Q, R, P0) from which a Kalman filter picks its gains, shapes (n, n), (p, p), (n, n).

        Q + gamma I (Liu et al. Definition 1), where a declared disturbance counts as the ball of gamma does; sensor
        noise and first errors that are bounded count with the covariance of a uniform draw, P / (dim + 2).
        """

        def summed(source: Source, divisor: float) -> np.ndarray:
            shapes = [each.shape_matrix / divisor for each in source.ellipsoids() if each is not source.noise.bound]
            return np.sum([source.noise.covariance, *shapes], axis=0)

        Q, R = summed(self.of_disturbance, 1.0), summed(self.of_sensor, self.p + 2)
        P0 = summed(self.of_first_error, self.n + 2)
        Q = Q if self.remainder_bound is None else Q + self.remainder_bound.shape_matrix
        return read_only(Q), read_only(R), read_only(P0)


def reach_in_steps(A: np.ndarray, B: np.ndarray, largest_input: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Returns a bound on every |x_j|, shape (n,), n steps after |x| <= reach, (n,), with |u| <= largest_input, (m,)."""
    for _ in range(len(A)):
        reach = exact.product(np.abs(np.hstack([A, B])), np.concatenate([reach, largest_input]))
    return reach


def inflated(shape: np.ndarray) -> np.ndarray:
    """Returns a slightly larger bound, also in directions in which it is flat: room for the rounding of its entries."""
    return INFLATION * shape + FLAT_INFLATION * np.diag(np.diag(shape))


def weight_of(rows: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Returns positive definite W, shape (n, n), of rows c_j, (k, n): C'C, regularized.

    Args:
        rows: Of the box.
        reach: `reach_from_rest` of the states, shape (n,): it counts for those in no row; 0 stands for 1.
    """
    gram = exact.product(rows.T, rows)
    squares, sizes = np.diag(gram), FREE_REACH * np.where(reach > 0.0, reach, 1.0)
    return gram + np.diag(np.where(squares > 0.0, 1e-6 * squares, 1.0 / np.square(sizes)))
