"""How often the gain that the estimator takes is the Kalman gain, as the pages say."""

import numpy as np
import pytest

from benchmarks.kalman_gain import KINDS, gains_taken, kalman_gain
from ncs_gym import Channel, Estimator, truck_trailer
from ncs_gym.estimation.kalman_filter import ErrorRecursion


def test_kalman_gain_of_the_count_is_filterpys():
    plant, q = truck_trailer(), 0.05
    recursion = ErrorRecursion(plant, q, Estimator(plant, Channel()).error_set)
    covariance = np.array([[2e-3, 1e-4], [1e-4, 1e-3]])
    sensor = plant.kalman_covariances[1] + q**2 / 12.0 * np.eye(2)
    np.testing.assert_allclose(
        kalman_gain(plant, covariance, sensor), recursion._kalman_update(covariance)[0], rtol=1e-12
    )


@pytest.mark.parametrize(
    ("name", "kind", "least"),
    [
        ("TruckTrailer", "Kalman", 1.0),
        ("TruckTrailerCruise", "Kalman", 1.0),
        ("CartPole", "set-membership", 0.99),
        ("BatchReactor", "certified", 0.95),
    ],
)
def test_gain_taken_is_the_kalman_gain_on_the_trucks_and_almost_never_on_the_unstable_plants(name, kind, least):
    counts = gains_taken(f"ncs_gym/{name}-v0", episodes=1)
    assert set(counts) <= set(KINDS)
    assert sum(counts.values()) > 50
    assert counts[kind] >= least * sum(counts.values())
