"""The certainty-equivalent filter: the shield's one-step test with the estimate taken for the true state."""

from __future__ import annotations

import numpy as np

from ncs_gym import LinearPlant
from shields import Certificate
from shields.runtime.safety_filter import SafetyFilter


class CertaintyEquivalentFilter:
    """Decides as the shield does, with Sigma_k = 0 in the place of the true error ellipsoid.

    This is what a safety filter does that is handed an estimate as if it were the state. Everything else is kept: the
    safe set S, the disturbance bound E(D), the projection onto the inputs that pass, the margins against rounding,
    K x_hat where no input passes, and in mode "lookahead" the plans. With the error ellipsoid goes the proof: x = x_hat
    is all it would hold for.

    Args:
        certificate: Verified exactly here.
        plant: The plant it was made for.
        mode: "project" or "lookahead"; see `SafetyFilter`.
        horizon: Longest plan of mode "lookahead" [steps]; None for that of `SafetyFilter`.
        margin: Fraction of the safe set that is kept free after the next step: the next state is taken to be off by as
            much, margin^2 L in the place of A Sigma_k A'.

    Raises:
        CertificateError: If the certificate does not verify for the plant.
        ValueError: If there is no such mode.
    """

    def __init__(
        self,
        certificate: Certificate,
        plant: LinearPlant,
        mode: str = "project",
        horizon: int | None = None,
        margin: float = 0.0,
    ) -> None:
        self._filter = SafetyFilter(certificate, plant, mode, horizon)
        back = np.linalg.inv(plant.A) if margin else np.zeros_like(plant.A)
        self._assumed = self._filter.errors_of_many((margin**2 * back @ certificate.L @ back.T)[None])
        self._plans = np.empty((0, plant.m, 0))

    def __call__(self, estimates: np.ndarray, proposed: np.ndarray, begun: np.ndarray) -> np.ndarray:
        """Returns the inputs to apply, shape (N, m).

        Args:
            estimates: x_hat, shape (N, n).
            proposed: Shape (N, m) [physical units].
            begun: Where an episode has just begun, shape (N,): earlier plans do not count.
        """
        errors, plans = self._assumed.of(np.zeros(len(estimates), np.intp)), None
        if self._plans.shape[-1] == len(estimates):
            plans = np.where(begun, np.nan, self._plans)
        decided = self._filter.decide_many(estimates.T, errors, proposed.T, plans)
        self._plans = decided.plan
        return decided.input.T
