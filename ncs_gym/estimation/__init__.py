"""The delay-aware Kalman filter and the ellipsoids that its error never leaves (set-membership estimation).

`error_sets` says what certified error sets are, `error_bound` and `error_bounds_by_age` find them offline;
`kalman_filter` and `set_membership` move covariance and running ellipsoid through predictions and updates;
`arrival_histories` looks up whatever depends only on when packets arrive, in an `error_table`; `estimator` and
`vector_estimator` carry the means, and `innovation` raises an alarm where a measurement contradicts the assumed bounds.
"""

from ncs_gym.estimation.error_bound import ErrorSetError, UnstablePlantError, certified_error_set
from ncs_gym.estimation.error_sets import ErrorSet
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.estimation.vector_estimator import VectorEstimator

__all__ = [
    "ErrorSet",
    "ErrorSetError",
    "Estimator",
    "UnstablePlantError",
    "VectorEstimator",
    "certified_error_set",
]
