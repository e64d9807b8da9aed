"""The numbers printed in Section 5 of Liu et al.: inputs of the audit, used nowhere else."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ncs_gym import BoxDisturbance, LinearPlant, truck_trailer
from ncs_gym.registration import CASE_STUDY_BOX


@dataclass(frozen=True, eq=False)
class PaperExample:
    """The numerical example as printed.

    Attributes:
        A: State matrix of the discretized plant, shape (2, 2).
        B: Input matrix of the discretized plant, shape (2, 1).
        M: Matrix of the safe set {x : x'Mx <= 1}, shape (2, 2).
        K: Feedback gain (printed as a column), shape (1, 2).
        kappa: Contraction factor of the closed loop.
        epsilon: Bound on e'e.
        largest_error: "The maximum system state error" of the simulation.
        disturbance: The box [-0.02, 0.02] x [-0.01, 0.01] of the disturbance.
    """

    A: np.ndarray = field(default_factory=lambda: np.array([[0.7247, 0.1636], [-0.7361, -0.0278]]))
    B: np.ndarray = field(default_factory=lambda: np.array([[0.0612], [0.1636]]))
    M: np.ndarray = field(default_factory=lambda: np.array([[0.2500, 9.8426e-4], [9.8426e-4, 0.2500]]))
    K: np.ndarray = field(default_factory=lambda: np.array([[2.0927, 0.3514]]))
    kappa: float = 0.9029
    epsilon: float = 0.0094
    largest_error: float = 0.0017
    disturbance: BoxDisturbance = CASE_STUDY_BOX

    @property
    def plant(self) -> LinearPlant:
        """The plant with the bounds printed beside it."""
        return truck_trailer()

    @property
    def disturbance_half_widths(self) -> np.ndarray:
        """Half-widths of the box of the disturbance, shape (2,)."""
        return np.asarray(self.disturbance.half_widths, dtype=np.float64)

    @property
    def L(self) -> np.ndarray:
        """Shape of the safe set, M^-1, shape (2, 2)."""
        inverse = np.linalg.inv(self.M)
        return 0.5 * (inverse + inverse.T)

    @property
    def closed_loop(self) -> np.ndarray:
        """State matrix of the closed loop, A + B K, shape (2, 2)."""
        return self.A + self.B @ self.K
