"""The running error ellipsoid: how a prediction and an update change the set that holds the estimation error."""

from __future__ import annotations

import numpy as np

from ncs_gym.estimation.error_sets import ErrorSet
from ncs_gym.plants.hard_bounds import FLAT_INFLATION, INFLATION
from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.uncertainty.ellipsoid import is_inside, outer_sum

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
        """Returns T_mu."""
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
