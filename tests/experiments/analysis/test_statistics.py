import numpy as np
import pytest
from scipy.stats import binom, norm, ttest_1samp

from experiments.analysis.statistics import (
    all_pairs,
    bootstrap_interval,
    clopper_pearson,
    holm,
    interquartile_mean,
    mean_interval,
    paired_difference,
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


def test_mean_interval_covers_at_its_level():
    rng = np.random.default_rng(0)
    covered = [low <= 0.0 <= high for low, high in (mean_interval(rng.standard_normal(3)) for _ in range(4000))]
    assert np.mean(covered) == pytest.approx(0.95, abs=4 * norm.std() * 0.95 * 0.05 / 4000**0.5 * 5)


def test_mean_interval_needs_two_values():
    assert mean_interval([1.0]) is None


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


def test_stratified_interval_keeps_the_share_of_every_stratum():
    # Resampled together, the mean would vary with how often each stratum is drawn.
    strata = [[0.0, 0.0, 0.0], [100.0, 100.0, 100.0]]
    assert bootstrap_interval(*strata) == [50.0, 50.0]
    low, high = bootstrap_interval(np.concatenate(strata))
    assert high - low > 50.0


def test_stratified_interval_needs_two_runs_in_every_stratum():
    assert bootstrap_interval([1.0, 2.0], [1.0]) is None
    assert bootstrap_interval() is None


def test_paired_difference_is_the_one_sample_test_of_the_differences():
    rng = np.random.default_rng(1)
    first, second = rng.normal(1.0, 1.0, 8), rng.normal(0.0, 2.0, 8)
    found, test = paired_difference(first, second), ttest_1samp(first - second, 0.0)
    assert found["p"] == pytest.approx(test.pvalue)
    assert found["ci95"] == pytest.approx(list(test.confidence_interval(0.95)))
    assert found["mean"] == pytest.approx((first - second).mean())


def test_pairing_finds_what_independent_samples_would_hide():
    noise = np.random.default_rng(0).normal(0.0, 100.0, 10)
    shift = 1.0 + 0.01 * np.arange(10)
    assert paired_difference(noise + shift, noise)["p"] < 1e-6
    assert paired_difference(noise + shift, noise[::-1])["p"] > 0.5


@pytest.mark.parametrize(("difference", "runs", "p"), [(0.0, 5, 1.0), (0.25, 5, 1 / 16), (-1.0, 3, 1 / 4)])
def test_equal_differences_are_no_proof_beyond_the_sign_flip_test(difference, runs, p):
    assert paired_difference([difference] * runs, [0.0] * runs)["p"] == p


def test_a_single_run_has_neither_interval_nor_p_value():
    assert paired_difference([2.0], [1.0]) == {"mean": 1.0, "ci95": None, "p": None}
    assert all_pairs({"one": [2.0], "other": [1.0]})[0]["p_holm"] is None


@pytest.mark.parametrize("second", [[], [1.0, 2.0]])
def test_runs_that_are_not_paired_are_refused(second):
    with pytest.raises(ValueError, match="equally many"):
        paired_difference([1.0] if second else [], second)


def test_holm_adjusts_as_in_the_textbook():
    # alpha 0.05, p = 0.01, 0.04, 0.03, 0.005: the two smallest are rejected (Wikipedia, "Holm-Bonferroni method").
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []
    assert holm([0.7, 0.9]) == [1.0, 1.0]


def test_holm_keeps_the_family_wise_error_where_single_tests_do_not():
    p_values = np.random.default_rng(0).uniform(size=(2000, 20))
    assert np.mean(p_values.min(axis=1) < 0.05) > 0.5
    assert np.mean([min(holm(row.tolist())) < 0.05 for row in p_values]) == pytest.approx(0.05, abs=0.015)


def test_all_pairs_are_there_once_and_adjusted_together():
    rng = np.random.default_rng(0)
    values = {name: rng.normal(mean, 0.1, 6).tolist() for name, mean in (("a", 0.0), ("b", 0.0), ("c", 9.0))}
    pairs = all_pairs(values)
    assert [(pair["first"], pair["second"]) for pair in pairs] == [("a", "b"), ("a", "c"), ("b", "c")]
    assert [pair["p_holm"] for pair in pairs] == holm([pair["p"] for pair in pairs])
    assert pairs[1]["mean"] == pytest.approx(-9.0, abs=0.3)
    assert pairs[0]["p_holm"] > 0.05 > pairs[1]["p_holm"]
