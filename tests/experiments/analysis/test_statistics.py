import numpy as np
import pytest
from scipy.stats import binom, norm

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


def test_no_event_still_has_an_upper_bound():
    low, high = clopper_pearson(0, 600)
    assert low == 0.0
    assert high == pytest.approx(1.0 - 0.025 ** (1 / 600))


@pytest.mark.parametrize(("events", "trials"), [(-1, 5), (6, 5), (0, 0)])
def test_impossible_counts_are_refused(events, trials):
    with pytest.raises(ValueError, match="events must be"):
        clopper_pearson(events, trials)


@pytest.mark.slow
def test_mean_interval_covers_at_its_level():
    rng = np.random.default_rng(0)
    covered = [low <= 0.0 <= high for low, high in (mean_interval(rng.standard_normal(3)) for _ in range(4000))]
    assert np.mean(covered) == pytest.approx(0.95, abs=4 * norm.std() * 0.95 * 0.05 / 4000**0.5 * 5)


def test_mean_interval_needs_two_values():
    assert mean_interval([1.0]) is None


@pytest.mark.slow
def test_bootstrap_interval_covers_near_its_level_and_never_leaves_the_values():
    rng = np.random.default_rng(0)
    draws = [rng.exponential(size=40) for _ in range(400)]
    intervals = [bootstrap_interval(values) for values in draws]
    assert np.mean([low <= 1.0 <= high for low, high in intervals]) == pytest.approx(0.93, abs=0.04)
    assert all(min(v) <= low < high <= max(v) for v, (low, high) in zip(draws, intervals, strict=True))


def test_bootstrap_interval_is_repeatable_and_needs_two_values():
    assert bootstrap_interval([1.0, 5.0, 2.0]) == bootstrap_interval([1.0, 5.0, 2.0])
    assert bootstrap_interval([1.0]) is None


def test_interquartile_mean_is_that_of_the_middle_half():
    assert interquartile_mean([100.0, 1.0, 2.0, -50.0]) == 1.5
    assert interquartile_mean([1.0, 2.0, 3.0]) == 2.0
    np.testing.assert_array_equal(interquartile_mean([[0.0, 1.0, 3.0, 9.0], [1.0] * 4], axis=1), [2.0, 1.0])
