"""The innovation test: whether an error and a noise within their bounds explain a residual."""

from __future__ import annotations

import numpy as np

from ncs_gym.estimation.set_membership import solved
from ncs_gym.uncertainty.minkowski_sum import common_axes, outside_sum

# An innovation this far beyond its exact bound counts as rounding, not as an alarm.
ALARM_TOLERANCE = 1e-9
# Up to this condition number an inverse says which residuals are possible to within 1e-3.
MAX_CONDITION_NUMBER = 1e7


class InnovationTest:
    """Tests residuals r = y - H x_hat, which lie in E(H Sigma_k H') + E(N) while the assumptions hold.

    Args:
        H: Output matrix, shape (p, n).
        noise: N, shape (p, p).
    """

    def __init__(self, H: np.ndarray, noise: np.ndarray) -> None:
        self._H, self._noise = H, noise

    def spread(self, shape: np.ndarray) -> np.ndarray:
        """Returns H Sigma_k H', shape (p, p)."""
        return self._H @ shape @ self._H.T

    def inverse_of_bound(self, spread: np.ndarray) -> np.ndarray:
        """Returns the matrix W, shape (p, p), of the quick test: a residual with r'Wr <= 1 is possible.

        The ellipsoid of shape H Sigma_k H' + N lies inside the Minkowski sum. Where its inverse would be too inexact to
        vouch for anything, W is infinite on the diagonal: no residual passes then.
        """
        bound = spread + self._noise
        extent = np.sqrt(bound.diagonal())
        if not _condition(bound / np.outer(extent, extent)) <= MAX_CONDITION_NUMBER:  # in units of its own; NaN fails
            return np.diag(np.full(len(bound), np.inf))
        return solved(bound, np.eye(len(bound)))

    def axes(self, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the axes common to H Sigma_k H' and N, in which many residuals are tested; see `common_axes`."""
        return common_axes(spread, self._noise)

    def are_impossible(self, residuals: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """Returns which residuals, shape (k, p), lie outside the Minkowski sum, shape (k,); NaN lies outside."""
        return outside_sum(residuals, spread, self._noise, ALARM_TOLERANCE)


def _condition(matrix: np.ndarray) -> float:
    """Returns the condition number of a symmetric matrix; NaN where it has no eigenvalues."""
    if not np.isfinite(matrix).all():
        return float("nan")
    values = np.abs(np.linalg.eigvalsh(matrix))
    return float(values.max() / values.min()) if values.min() > 0.0 else float("inf")
