"""The Kalman filter of Definition 1, for many episodes at once; it has no equation for late packets."""

from __future__ import annotations

import numpy as np

from experiments.paper.paper_example import PaperExample
from ncs_gym import LinearPlant


class DefinitionThreeFilter:
    """Predicts with G = A + BK, and corrects with y_k; the last axis of every array is the episode.

    Args:
        example: The printed numbers.
        plant: The plant with the covariances of its noise.
        mean: First estimates, shape (n, N).
        takes_late: Whether a late sample is taken for y_k; otherwise it is discarded.

    Attributes:
        mean: x_hat, shape (n, N).
    """

    def __init__(self, example: PaperExample, plant: LinearPlant, mean: np.ndarray, *, takes_late: bool) -> None:
        self.mean, self._plant, self._takes_late = mean, plant, takes_late
        self._G = plant.A + plant.B @ example.K
        self._Q_bar = plant.process_noise_cov + plant.gamma * np.eye(plant.n)
        self._covariance = np.repeat(plant.initial_cov[None], mean.shape[1], axis=0)
        # By age: what was measured, None where nobody sent.
        self._samples: list[np.ndarray | None] = []

    def advance(self, u: np.ndarray, samples: np.ndarray | None, arrivals: list[tuple[int, np.ndarray]]) -> None:
        """Moves one step on.

        Args:
            u: Applied inputs, shape (m, N); not used, because Definition 1 predicts with G.
            samples: What was measured at this step, shape (p, N); None if nobody sends.
            arrivals: Ages of samples that arrive now, each with the episodes, shape (N,).
        """
        self._samples.insert(0, samples)
        self.mean = self._G @ self.mean
        self._covariance = self._G @ self._covariance @ self._G.T + self._Q_bar
        for age, arrives in arrivals:
            sample = self._samples[age]
            if sample is not None and (age == 0 or self._takes_late):
                self._correct(sample, arrives)

    def _correct(self, sample: np.ndarray, arrives: np.ndarray) -> None:
        """Corrects the episodes in which a sample, shape (p, N), arrives, as if it were measured now."""
        H, P = self._plant.H, self._covariance[arrives]
        gains = P @ H.T @ np.linalg.inv(H @ P @ H.T + self._plant.measurement_noise_cov)
        residuals = (sample - H @ self.mean)[:, arrives]
        self.mean[:, arrives] += np.einsum("eij,je->ie", gains, residuals)
        self._covariance[arrives] = (np.eye(self._plant.n) - gains @ H) @ P
