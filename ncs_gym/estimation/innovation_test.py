"""The innovation test: whether an error and a noise within their bounds explain a residual."""

from __future__ import annotations

import numpy as np

from ncs_gym.uncertainty.minkowski_sum import common_axes, outside_sum

# An innovation this far beyond its exact bound counts as rounding, not as an alarm.
ALARM_TOLERANCE = 1e-9
# Up to this condition number, in the norm of Frobenius, an inverse says which residuals are possible to within 1e-3.
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
        units = extent[:, None] * extent
        try:
            scaled = bound / units  # in units of its own
            inverse = np.linalg.inv(scaled)
            is_sure = np.vdot(scaled, scaled) * np.vdot(inverse, inverse) <= MAX_CONDITION_NUMBER**2  # NaN is not
        except np.linalg.LinAlgError:
            is_sure = False
        return inverse / units if is_sure else np.diag(np.full(len(bound), np.inf))

    def axes(self, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the axes common to H Sigma_k H' and N, in which many residuals are tested; see `common_axes`."""
        return common_axes(spread, self._noise)

    def are_impossible(self, residuals: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """Returns which residuals, shape (k, p), lie outside the Minkowski sum, shape (k,); NaN lies outside."""
        return outside_sum(residuals, spread, self._noise, ALARM_TOLERANCE)
