"""Hard bounds of what is declared of a plant's uncertainties: what proofs take, and simulations draw from.

They are the same numbers on every machine (`ncs_gym.exact`).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ncs_gym import exact
from ncs_gym.bounds import DELTA, Ball, Sum, pushes_of
from ncs_gym.limits import LimitValues, reach_in_steps, weight_of
from ncs_gym.uncertainty.ellipsoid import Ellipsoid, ellipsoid_around_sum
from ncs_gym.uncertainty.truncated_gaussian import TruncatedGaussian, truncation_energy
from ncs_gym.validation import read_only, setting

# Relative growth of every hard bound for the rounding of sampling and quantizing (docs/shield_proof.md), and of its
# diagonal, where it is flat.
INFLATION, FLAT_INFLATION = 1.0 + 1e-9, 1e-12
# No disturbance set is thinner than this, in squared half-widths of the safe box.
THINNEST = 1e-19
# Simulating a step in float64 rounds; the disturbance bound has room for that up to this many half-widths out.
SIMULATED_REACH = 100.0


class Source(NamedTuple):
    """What is declared of one uncertainty, in the dimension of the plant: the sum of three.

    Attributes:
        ball: Squared radius of a ball.
        noise: Truncated Gaussian noise; without any its covariance is zero.
        bound: An ellipsoid around what else is declared; None if nothing is.
    """

    ball: float
    noise: TruncatedGaussian
    bound: Ellipsoid | None

    @classmethod
    def of(cls, declared: Sum, weight: np.ndarray, past: int = 0, *, keeps_ball: bool = False) -> Source:
        """Returns what a sum of sets declares of the own states of a plant, or of its outputs.

        Args:
            declared: The sum.
            weight: W, by which a sum of several sets becomes one ellipsoid.
            past: How many past inputs, which are known, follow.
            keeps_ball: Whether a `Ball` stands for itself, which it cannot beside past inputs.

        Raises:
            ValueError: If a set with two different ends is added to others.
        """
        size, gaussian = len(weight), declared.gaussian
        covariance, delta = (gaussian.covariance, gaussian.delta) if gaussian else (np.zeros((size, size)), DELTA)
        noise = TruncatedGaussian(np.pad(covariance, (0, past)), truncation_energy(delta, size), past)
        balls = [each for each in declared.parts if isinstance(each, Ball) and keeps_ball and not past]
        others = Sum(tuple(each for each in declared.parts if each is not gaussian and each not in balls)).sized(size)
        if len(others.parts) > 1 and pushes_of(others):
            raise ValueError("a set with two different ends is not added to others: give the sum as Through(E, Box)")
        shape = others.ellipsoid(weight).shape_matrix if others.parts else None
        bound = None if shape is None else Ellipsoid(np.pad(shape, (0, past)))
        return cls(float(np.square(sum(each.radius for each in balls))), noise, bound)

    def bounded(self) -> list[Ellipsoid]:
        """Returns the bounds of all but the noise."""
        ball = Ellipsoid(self.ball * np.eye(len(self.noise.covariance)))
        return [ball, *([] if self.bound is None else [self.bound])]

    def around(self, weight: np.ndarray, *others: Ellipsoid | None) -> Ellipsoid:
        """Returns an ellipsoid around the sum of all and of others, of the smallest tr(W P)."""
        ball, *rest = self.bounded()
        return ellipsoid_around_sum(weight, ball, self.noise.bound, *rest, *others)

    def covariance(self, divisor: float) -> np.ndarray:
        """Returns the covariance of the noise, plus the shapes of the other bounds over a divisor."""
        return np.sum([self.noise.covariance, *(each.shape_matrix / divisor for each in self.bounded())], axis=0)

    def drawn(self, rng: np.random.Generator, count: int | None = None, *, truncated: bool = True) -> np.ndarray:
        """Returns noise plus a uniform point of the bound unless that is one, shape (n,) or (count, n)."""
        samples = self.noise.sample(rng, count, truncated=truncated)
        if self.bound is None or not self.bound.shape_matrix.any():
            return samples
        return samples + self.bound.sample(rng, count)


class HardBounds(LimitValues):
    """The bounds of disturbances, sensor noise and first estimates of a plant.

    Attributes:
        n, m, p: Number of states, inputs and outputs.
        of_disturbance, of_sensor, of_first_error: What is declared of each; the attributes below name parts of these.
        remainder: What the model leaves out of the process that really moves; None if nothing.
        delta: Probability that Gaussian noise is truncated at.
    """

    n: int
    m: int
    p: int
    of_disturbance: Source
    of_sensor: Source
    of_first_error: Source
    remainder: Any
    delta: float
    gamma = setting("gamma", "of_disturbance.ball")
    process_noise = setting("process_noise", "of_disturbance.noise")
    sensor_noise = setting("sensor_noise", "of_sensor.noise")
    initial_noise = setting("initial_noise", "of_first_error.noise")
    disturbance_bound = setting("disturbance_bound", "of_disturbance.bound")
    sensor_bound = setting("sensor_bound", "of_sensor.bound")
    initial_bound = setting("initial_bound", "of_first_error.bound")
    process_noise_cov = setting("process_noise_cov", "of_disturbance.noise.covariance")
    measurement_noise_cov = setting("measurement_noise_cov", "of_sensor.noise.covariance")
    initial_cov = setting("initial_cov", "of_first_error.noise.covariance")

    @cached_property
    def remainder_bound(self) -> Ellipsoid | None:
        """What holds the remainder, with past inputs."""
        return self.remainder and Ellipsoid(np.pad(self.remainder.bound.shape_matrix, (0, self.past)))

    @cached_property
    def weight(self) -> np.ndarray:
        """Positive definite W, shape (n, n), that measures ellipsoids in units of the safe box: C'C, regularized."""
        return read_only(weight_of(self.box, self.reach_from_rest))

    @cached_property
    def reach_from_rest(self) -> np.ndarray:
        """How far inputs take each state in n steps, from about as far as noise does in one, shape (n,)."""
        sources = self.of_disturbance, self.of_first_error
        bounded = [each.shape_matrix for source in sources for each in source.bounded()]
        noise = [np.diag(each) for each in [*(source.noise.covariance for source in sources), *bounded]]
        return read_only(reach_in_steps(self.A, self.B, self.largest_input, np.sqrt(np.sum(noise, axis=0))))

    @cached_property
    def _box_shape(self) -> np.ndarray:
        return exact.inverse(self.weight)

    @cached_property
    def relative_weight(self) -> np.ndarray:
        """W in units of its largest entry: the identity exactly if the box is a cube."""
        return read_only(self.weight / self.weight.max())

    @cached_property
    def half_widths(self) -> np.ndarray:
        """Half-widths of the ellipsoid {x : x'Wx <= 1}, shape (n,)."""
        return read_only(np.sqrt(np.diag(self._box_shape)))

    @cached_property
    def disturbance(self) -> Ellipsoid:
        """D: holds declared disturbances, truncated process noise, remainder and rounding of a simulation.

        It holds `allowed_disturbance` plus E(F), F = n diag(r^2), with r the rounding of A x + B u + d for x up to
        SIMULATED_REACH half-widths out: (1+s/4) allowed + (1+4/s) F, s the inflation.
        """
        return Ellipsoid(inflated(self.nominal_disturbance.shape_matrix) + self._rounding_margin)

    @cached_property
    def allowed_disturbance(self) -> Ellipsoid:
        """What a disturbance may use of D: the rest is for the rounding of a simulation."""
        nominal = self.nominal_disturbance.shape_matrix
        return Ellipsoid(0.5 * (nominal + inflated(nominal)) + 0.5 * self._rounding_margin)

    @cached_property
    def _rounding_margin(self) -> np.ndarray:
        reach = SIMULATED_REACH * self.half_widths
        rounding = exact.product(np.abs(self.A), reach) + exact.product(np.abs(self.B), self.largest_input) + reach
        rounding *= (self.n + self.m + 2) * np.finfo(float).eps
        return THINNEST * self._box_shape + 10.0 * self.n / (INFLATION - 1.0) * np.diag(np.square(rounding))

    @cached_property
    def nominal_disturbance(self) -> Ellipsoid:
        """D before inflation: extremal disturbances drawn here stay inside E(D) when rounded."""
        return self.of_disturbance.around(self.relative_weight, self.remainder_bound)

    @cached_property
    def nominal_sensor_error(self) -> Ellipsoid:
        """Holds the sensor noise v before inflation."""
        return self.of_sensor.around(np.eye(self.p))

    @cached_property
    def sensor_error(self) -> Ellipsoid:
        """Holds the sensor noise v, without the channel's quantizer (see `sensor_error_with`)."""
        return Ellipsoid(inflated(self.nominal_sensor_error.shape_matrix))

    def sensor_error_with(self, quantization_step: float) -> Ellipsoid:
        """Returns N: sensor noise plus the ball of squared radius p q^2/4 around a quantizer's box."""
        ball = Ellipsoid(self.p * quantization_step**2 / 4.0 * np.eye(self.p))
        return Ellipsoid(inflated(ellipsoid_around_sum(np.eye(self.p), ball, self.nominal_sensor_error).shape_matrix))

    @cached_property
    def initial_radius_squared(self) -> float:
        """r0^2 = lambda_max(P0) chi2_{n,1-delta}: the truncated first error is no longer than r0."""
        return max(exact.largest_eigenvalue(self.initial_noise.bound.shape_matrix), 0.0)

    @cached_property
    def nominal_initial_error(self) -> Ellipsoid:
        """Holds the error of the first estimate before inflation: the ball of r0 plus `initial_bound`."""
        unknown = np.arange(self.n) < self.n - self.past
        ball = Ellipsoid(self.initial_radius_squared * np.diag(unknown.astype(float)))
        return ellipsoid_around_sum(self.relative_weight, ball, self.initial_bound)

    @cached_property
    def initial_error(self) -> Ellipsoid:
        """Holds the error of the first estimate, with slack for rounding."""
        return Ellipsoid(inflated(self.nominal_initial_error.shape_matrix) + self.estimate_rounding)

    @cached_property
    def estimate_rounding(self) -> np.ndarray:
        """Room for the rounding of x_hat up to SIMULATED_REACH half-widths out, shape (n, n), next to an inflation."""
        rounding = 4.0 * np.finfo(float).eps * SIMULATED_REACH * self.half_widths
        return read_only(2.0 * self.n / (INFLATION - 1.0) * np.diag(np.square(rounding)))

    @cached_property
    def kalman_covariances(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Covariances (Q, R, P0) from which a Kalman filter picks its gains.

        Q + gamma I (Liu et al. Definition 1), where a declared disturbance counts as the ball of gamma does; other
        bounds count with the covariance of a uniform draw, P / (dim + 2).
        """
        Q, R = self.of_disturbance.covariance(1.0), self.of_sensor.covariance(self.p + 2)
        Q = Q if self.remainder_bound is None else Q + self.remainder_bound.shape_matrix
        return read_only(Q), read_only(R), read_only(self.of_first_error.covariance(self.n + 2))


def inflated(shape: np.ndarray) -> np.ndarray:
    """Returns a slightly larger bound, with room for the rounding of its entries, also where it is flat."""
    return INFLATION * shape + FLAT_INFLATION * np.diag(np.diag(shape))
