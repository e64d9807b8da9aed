"""The shield's decision: a pure function of estimate, error ellipsoid and proposed input."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ncs_gym import LinearPlant
from ncs_gym.ellipsoid import outer_sum
from ncs_gym.frozen import FrozenArrays, read_only
from shields.certificate import Certificate
from shields.projection import closest_admissible
from shields.verification import ACTION_ROUNDING, require_valid

MODES = ("project", "switch")
# The test must be passed by this much, in units of the safe set: far more than the rounding of its computation.
MARGIN = 1e-9


class Decision(NamedTuple):
    """What the shield decided.

    Attributes:
        input: Input to apply, shape (m,), within the limits; exactly u_max times a float32 action if intervened.
        intervened: Whether it differs from the proposed one.
        passed: Whether it meets the one-step test, so that x+ is in S even if x is not.
        fallback: Whether it is K x_hat, so that x+ is in S if x is and Sigma_k lies inside the certificate's Sigma.
        margin: 1 - h - |A x_hat + B u|_M at the input to apply; positive if the test is met with room.
        reason: "safe" (passed as proposed), "projected", "fallback" (u = K x_hat), or "invalid" (a proposed input
            or estimate that is not finite or wrongly shaped: u = K x_hat, or zero without a usable estimate).
    """

    input: np.ndarray
    intervened: bool
    passed: bool
    fallback: bool
    margin: float
    reason: str


@dataclass(frozen=True, eq=False)
class SafetyFilter(FrozenArrays):
    """A certificate made ready to judge inputs (theory.md section 4).

    The test: with |z|_M = sqrt(z'Mz), E(Sigma_pred) around A E(Sigma_k) + E(D) and
    h = sqrt(lambda_max(M^1/2 Sigma_pred M^1/2)), the inequality |A x_hat + B u|_M <= 1 - h implies x+ in S, because
    x+ = (A x_hat + B u) + (d - A e). K x_hat needs no test: its safety follows from x in S by (I) and (U).

    Args:
        certificate: Verified exactly here; what does not verify is refused.
        plant: The plant it was made for.
        mode: "project" (the closest input that meets the test) or "switch" (K x_hat) when an input fails it.

    Raises:
        CertificateError: If the certificate does not verify for the plant.
        ValueError: If the mode is unknown.
    """

    certificate: Certificate
    plant: LinearPlant
    mode: str = "project"

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ValueError(f"mode must be one of {list(MODES)}, got {self.mode!r}")
        require_valid(self.certificate, self.plant)

    @cached_property
    def _root(self) -> np.ndarray:
        """G with |z|_M = |G z|, shape (n, n)."""
        return read_only(np.linalg.cholesky(self.certificate.M).T)

    @cached_property
    def _moved(self) -> np.ndarray:
        return read_only(self._root @ self.plant.A)

    @cached_property
    def _effect(self) -> np.ndarray:
        return read_only(self._root @ self.plant.B)

    @cached_property
    def _D(self) -> np.ndarray:
        return read_only(self._root @ self.plant.disturbance.shape @ self._root.T)

    @cached_property
    def _identity(self) -> np.ndarray:
        return read_only(np.eye(self.plant.n))

    @cached_property
    def _rounding(self) -> float:
        """How far rounding an action to float32 can move the next state, in the norm of the test."""
        return float(np.linalg.norm(self._effect, axis=0) @ self.plant.u_max) * float(ACTION_ROUNDING)

    def decide(self, estimate: np.ndarray, error_shape: np.ndarray, input_proposed: np.ndarray) -> Decision:
        """Returns the input to apply.

        Args:
            estimate: x_hat, shape (n,), float64.
            error_shape: Sigma_k, shape (n, n): x_hat - x lies in E(Sigma_k).
            input_proposed: Shape (m,) [physical units]; the very float64 value that would be applied.
        """
        if not self._is_usable(estimate, error_shape):
            return Decision(np.zeros(self.plant.m), True, False, False, float("nan"), "invalid")
        offset = self._moved @ estimate
        radius = 1.0 - self.spread(error_shape)
        u = np.asarray(input_proposed, dtype=np.float64)
        if u.shape != (self.plant.m,) or not (np.abs(u) <= self.plant.u_max).all():
            return self._fallback(estimate, offset, radius, "invalid")
        margin = radius - self._norm(offset, u)
        if margin >= MARGIN:
            return Decision(u, False, True, False, margin, "safe")
        if self.mode == "project":
            closest = self._project(offset, radius, u)
            if closest is not None:
                margin = radius - self._norm(offset, closest)
                if margin >= MARGIN:
                    return Decision(closest, True, True, False, margin, "projected")
        return self._fallback(estimate, offset, radius, "fallback")

    def margin(self, estimate: np.ndarray, error_shape: np.ndarray, u: np.ndarray) -> float:
        """Returns 1 - h - |A x_hat + B u|_M for an input u, shape (m,)."""
        return 1.0 - self.spread(error_shape) - self._norm(self._moved @ estimate, u)

    def spread(self, error_shape: np.ndarray) -> float:
        """Returns h for an error shape Sigma_k, shape (n, n)."""
        moved = self._moved @ error_shape @ self._moved.T
        predicted = outer_sum(moved, self._D, self._identity)
        return float(np.sqrt(np.linalg.eigvalsh(predicted)[-1]))

    def knows_inside(self, estimate: np.ndarray, error_shape: np.ndarray) -> bool:
        """Returns whether |x_hat|_M + sqrt(lambda_max(M Sigma_k)) <= 1, which proves that x is in S."""
        if not self._is_usable(estimate, error_shape):
            return False
        shape = self._root @ error_shape @ self._root.T
        radius = np.sqrt(max(float(np.linalg.eigvalsh(shape)[-1]), 0.0))
        return float(np.linalg.norm(self._root @ estimate)) + radius <= 1.0 - MARGIN

    def fallback_input(self, estimate: np.ndarray) -> np.ndarray:
        """Returns K x_hat, shape (m,), clipped to the limits and rounded to what a float32 action can express."""
        return self._expressible(self.certificate.K @ estimate)

    def _fallback(self, estimate: np.ndarray, offset: np.ndarray, radius: float, reason: str) -> Decision:
        u = self.fallback_input(estimate)
        margin = radius - self._norm(offset, u)
        return Decision(u, True, margin >= MARGIN, True, margin, reason)

    def _project(self, offset: np.ndarray, radius: float, u: np.ndarray) -> np.ndarray | None:
        """Returns the closest input whose float32 neighbor still meets the test; None if there is none."""
        target = radius - 2.0 * MARGIN - self._rounding
        if target < 0.0:
            return None
        if self.plant.m > 1:
            closest = closest_admissible(u, offset, self._effect, target, self.plant.u_max)
            return None if closest is None else self._expressible(closest)
        effect = self._effect[:, 0]
        a, b = float(effect @ effect), float(effect @ offset)
        room = b * b - a * (float(offset @ offset) - target * target)
        if a == 0.0 or room < 0.0:
            return None
        half = room**0.5
        low, high = (-b - half) / a, (-b + half) / a
        limit = self.plant.u_max.item()
        if low > limit or high < -limit:
            return None
        return self._expressible(np.array([min(max(u.item(), low, -limit), high, limit)]))

    def _expressible(self, u: np.ndarray) -> np.ndarray:
        """Returns the nearest u_max * float32 action."""
        limit = self.plant.u_max
        return limit * np.clip(u / limit, -1.0, 1.0).astype(np.float32).astype(np.float64)

    def _norm(self, offset: np.ndarray, u: np.ndarray) -> float:
        moved = offset + self._effect @ u
        return float(np.sqrt(moved @ moved))

    def _is_usable(self, estimate: np.ndarray, error_shape: np.ndarray) -> bool:
        n = self.plant.n
        fits = np.shape(estimate) == (n,) and np.shape(error_shape) == (n, n)
        return fits and bool(np.isfinite(estimate).all()) and bool(np.isfinite(error_shape).all())
