"""The shield's one-step test with the estimate taken for the true state."""

from __future__ import annotations

import numpy as np

from ncs_gym import LinearPlant
from shields import Certificate
from shields.runtime.filter import SafetyFilter


class TrustingFilter:
    """Decides as mode "project" of the shield does, with Sigma_k = 0 in the place of the true error ellipsoid.

    This is what a safety filter does that is handed an estimate as if it were the state. Everything else is kept: the
    safe set S, the disturbance bound E(D), the projection onto the inputs that pass, the margins against rounding, and
    K x_hat where no input passes. With the error ellipsoid goes the proof: x = x_hat is all it would hold for.

    Args:
        certificate: Verified exactly here.
        plant: The plant it was made for.

    Raises:
        CertificateError: If the certificate does not verify for the plant.
    """

    def __init__(self, certificate: Certificate, plant: LinearPlant) -> None:
        self._filter = SafetyFilter(certificate, plant, "project")
        self._no_error = self._filter.errors_of_many(np.zeros((1, plant.n, plant.n)))

    def __call__(self, estimates: np.ndarray, proposed: np.ndarray, begun: np.ndarray) -> np.ndarray:
        """Returns the inputs to apply, shape (N, m).

        Args:
            estimates: x_hat, shape (N, n).
            proposed: Shape (N, m) [physical units].
            begun: Where an episode has just begun, shape (N,); nothing is remembered here.
        """
        errors = self._no_error.of(np.zeros(len(estimates), np.intp))
        return self._filter.decide_many(estimates.T, errors, proposed.T).input.T
