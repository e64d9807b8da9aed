"""Estimates the disturbance that persists, from what estimates do beyond the model's prediction."""

from __future__ import annotations

from typing import Any

import numpy as np

from ncs_gym import NCSEnv
from ncs_gym.estimation.kalman_filter import predicted_covariance, updated_covariance

# Where an estimate is older, what it has missed is taken for what it missed in so many steps.
_OLDEST = 50
# Steps after which the gain of a Kalman filter changes no more.
_SETTLED = 200


class DisturbanceObserver:
    """Estimates d of x+ = A x + B u + d in N control loops, each taken to stay as it is.

    The environment's estimator knows no d, so that x_hat lags: by G_0 d at a new sample, by G_{h+1} d = (A G_h + I) d
    where it has predicted for h+1 steps. With x = x_hat + G_h d_hat and the input u that was decided,

        d_hat += alpha (x+ - A x - B u - d_hat),

    which changes nothing while no sample arrives. G_0 = (I - F A)^-1 F, F = I - K H, is that of a Kalman filter whose
    gain K has settled. Behind a downlink x_hat is that of when u acts, c steps later (Muske and Badgwell 2002;
    Pannocchia and Rawlings 2003). Nothing is estimated beyond the plant's bound of disturbances in each coordinate.

    Args:
        env: A single environment with the plant and the networks.
        alpha: Between 0 and 1.

    Attributes:
        largest: The plant's bound of disturbances in each coordinate, shape (n,).
    """

    def __init__(self, env: NCSEnv, alpha: float) -> None:
        plant, recursion = env.plant, env.loop.histories(env.channel).recursion
        self._A, self._B, self._alpha, self._delay = plant.A, plant.B, alpha, env.downlink_protocol.input_delay
        self.largest = np.sqrt(np.diag(plant.nominal_disturbance.shape_matrix))
        eye, P = np.eye(plant.n), recursion.first.covariance
        gain = np.zeros((plant.n, len(plant.H)))
        for _ in range(_SETTLED):
            gain, P = updated_covariance(predicted_covariance(P, plant.A, recursion.Q), plant.H, recursion.R)
        kept = eye - gain @ plant.H
        lags = [np.linalg.solve(eye - kept @ plant.A, kept)]
        while len(lags) <= _OLDEST:
            lags.append(plant.A @ lags[-1] + eye)
        self._lags = np.array(lags)
        self._before: tuple[np.ndarray, np.ndarray] | None = None  # estimates (N, n) and lags (N, n, n)

    def see(self, infos: dict[str, Any], fresh: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Returns x and d_hat, shape (N, n) each, after a step or the beginning of episodes.

        Args:
            infos: Those of a vector environment.
            fresh: Loops that took a step or began, bool (N,); the others are as they were. None for all.
        """
        estimates, begun = infos["estimate"], infos["episode_steps"] == 0
        lags = self._lags[np.minimum(infos["measurement_age"] + self._delay, _OLDEST)]
        if self._before is None or len(estimates) != len(self._before[0]):
            self.disturbance = np.zeros(estimates.shape)
        else:
            before, lagged = self._before
            d = np.where(begun[:, None], 0.0, self.disturbance)
            last = before + np.einsum("kij,kj->ki", lagged, d)
            now = estimates + np.einsum("kij,kj->ki", lags, d)
            seen = now - last @ self._A.T - infos.get("input_committed", infos["input"]) @ self._B.T
            d = d + np.where(begun[:, None], 0.0, self._alpha * (seen - d))
            d = np.clip(d, -self.largest, self.largest)
            self.disturbance = d if fresh is None else np.where(fresh[:, None], d, self.disturbance)
        self._before = estimates.copy(), lags
        return estimates + np.einsum("kij,kj->ki", lags, self.disturbance), self.disturbance
