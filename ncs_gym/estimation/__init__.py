"""The delay-aware Kalman filter and the ellipsoids that its error never leaves (set-membership estimation)."""

from ncs_gym.estimation.error_bound import ErrorSet, ErrorSetError, UnstablePlantError, certified_error_set
from ncs_gym.estimation.estimator import Estimator, VectorEstimator

__all__ = [
    "ErrorSet",
    "ErrorSetError",
    "Estimator",
    "UnstablePlantError",
    "VectorEstimator",
    "certified_error_set",
]
