import numpy as np
import pytest
from scipy.stats import binom

from experiments.analysis.statistics import (
    bootstrap_interval,
    clopper_pearson,
    interquartile_mean,
    mean_interval,
)


@pytest.mark.parametrize(("events", "trials"), [(0, 600), (1, 10), (5, 10), (10, 10), (589, 600)])
def test_exact_interval_inverts_the_binomial_test(events, trials):
    low, high = clopper_pearson(events, trials)
    if events > 0:
        assert binom.sf(events - 1, trials, low) == pytest.approx(0.025)
    if events < trials:
        assert binom.cdf(events, trials, high) == pytest.approx(0.025)
    assert low <= events / trials <= high


@pytest.mark.parametrize(("events", "trials"), [(-1, 5), (6, 5), (0, 0)])
def test_impossible_counts_are_refused(events, trials):
    with pytest.raises(ValueError, match="events must be"):
        clopper_pearson(events, trials)


@pytest.mark.slow
def test_bootstrap_interval_covers_near_its_level_and_never_leaves_the_values():
    rng = np.random.default_rng(0)
    draws = [rng.exponential(size=40) for _ in range(400)]
    intervals = [bootstrap_interval(values) for values in draws]
    assert np.mean([low <= 1.0 <= high for low, high in intervals]) == pytest.approx(0.93, abs=0.04)
    assert all(min(v) <= low < high <= max(v) for v, (low, high) in zip(draws, intervals, strict=True))


def test_intervals_need_two_values_and_the_bootstraps_is_repeatable():
    assert bootstrap_interval([1.0, 5.0, 2.0]) == bootstrap_interval([1.0, 5.0, 2.0])
    assert bootstrap_interval([1.0]) is mean_interval([1.0]) is None


def test_interquartile_mean_is_that_of_the_middle_half():
    assert interquartile_mean([100.0, 1.0, 2.0, -50.0]) == 1.5
    assert interquartile_mean([1.0, 2.0, 3.0]) == 2.0
    np.testing.assert_array_equal(interquartile_mean([[0.0, 1.0, 3.0, 9.0], [1.0] * 4], axis=1), [2.0, 1.0])
