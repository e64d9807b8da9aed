"""How often the gain that the estimator takes is the Kalman gain, as the pages say."""

import pytest

from benchmarks.kalman_gain import KINDS, gains_taken


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
