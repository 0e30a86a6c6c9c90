"""Intervals of trials' results, against their definitions and their coverage."""

import numpy as np
import pytest
from scipy import stats

from jaxslam.evaluation.trial_statistics import (
    mean_interval,
    p_value_of_mean,
    paired_difference,
    proportion,
    quantile,
    share_difference,
    survival,
)


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (3, 10), (999, 1000), (10, 10)])
def test_the_limits_of_wilson_solve_their_equation(successes, trials):
    """|share - p| = z sqrt(p (1 - p) / n) at both limits."""
    found = proportion(successes, trials)
    z = stats.norm.ppf(0.975)
    for limit in found[1:]:
        gap = abs(successes / trials - limit)
        assert np.isclose(gap, z * np.sqrt(limit * (1.0 - limit) / trials), atol=1e-9)
    assert found.low <= found.value <= found.high
    assert proportion(0, 0)[1:] == (0.0, 1.0)


@pytest.mark.parametrize("probability", [0.5, 0.9])
def test_the_interval_of_a_quantile_covers_it(probability):
    rng = np.random.default_rng(0)
    true = stats.expon.ppf(probability)
    found = [quantile(rng.exponential(size=80), probability) for _ in range(1000)]
    covered = np.mean([one.low <= true <= one.high for one in found])
    assert covered > 0.95 - 4.5 * np.sqrt(0.05 * 0.95 / 1000)
    assert np.mean([one.low > -np.inf and one.high < np.inf for one in found]) > 0.9
    values = rng.exponential(size=80)
    reference = stats.quantile_test(values, p=probability).confidence_interval(0.9)
    assert quantile(values, probability, 0.9)[1:] == tuple(reference)
    assert quantile([1.0, 2.0, np.nan], 0.9).high == np.inf
    assert np.isnan(quantile([np.nan], 0.5).value)


def test_pairs_leave_out_what_both_have_in_common():
    rng = np.random.default_rng(1)
    common = rng.normal(size=400)
    first, second = common + 0.1 * rng.normal(size=400), common + 0.3 + 0.1 * rng.normal(size=400)
    second[5] = np.nan
    found = paired_difference(first, second)
    assert found.pairs == 399 and abs(found.mean - 0.3) < 4.5 * found.standard_error
    np.testing.assert_allclose(found.standard_error, 0.1 * np.sqrt(2 / 399), rtol=0.15)
    np.testing.assert_allclose(found.unpaired_standard_error, np.sqrt(2.02 / 399), rtol=0.15)
    assert np.isnan(paired_difference([1.0], [2.0]).mean)


def test_the_interval_of_paired_shares_covers_their_difference():
    rng = np.random.default_rng(2)
    found = []
    for _ in range(1000):  # 80 % and 88 % succeed, most in the same trials
        u = rng.uniform(size=60)
        found.append(share_difference(u < 0.8, (u < 0.76) | (u > 0.88)))
    covered = np.mean([one.low <= 0.08 <= one.high for one in found])
    assert covered > 0.95 - 4.5 * np.sqrt(0.05 * 0.95 / 1000)
    assert np.mean([one.high - one.low for one in found]) < 0.28
    one = share_difference(np.array([True] * 3 + [False] * 9), np.array([False] * 3 + [True] * 9))
    assert (one.only_first, one.only_second, one.value) == (3, 9, 0.5)
    assert np.isclose(one.p_value, 2 * stats.binom.cdf(3, 12, 0.5))  # of 12 coins
    same = share_difference(np.ones(5, bool), np.ones(5, bool))
    assert same.p_value == 1.0 and same.low < 0.0 < same.high


def test_a_mean_is_tested_by_students_t():
    values = np.random.default_rng(3).normal(0.4, 1.0, 30)
    mean, error = values.mean(), values.std(ddof=1) / np.sqrt(30)
    reference = stats.ttest_1samp(values, 0.0)
    np.testing.assert_allclose(p_value_of_mean(mean, error, 30), reference.pvalue)
    own = reference.confidence_interval(0.95)
    np.testing.assert_allclose(mean_interval(mean, error, 30), [own.low, own.high])
    assert p_value_of_mean(np.nan, 1.0, 9) == p_value_of_mean(0.0, 0.0, 9) == 1.0
    assert p_value_of_mean(0.1, 0.0, 9) == 0.0 and np.isnan(mean_interval(1.0, 1.0, 1)[0])


def test_survival_is_the_product_over_the_failures():
    """By hand: 5 at risk at 1, 3 at risk at 3 (one ended at 2), 1 at risk at 5."""
    times, failed = survival([1.0, 2.0, 3.0, 4.0, 5.0], np.array([True, False, True, False, True]))
    np.testing.assert_array_equal(times, [1.0, 3.0, 5.0])
    np.testing.assert_allclose(failed, [4 / 5, 4 / 5 * 2 / 3, 0.0])
    assert survival([1.0, 2.0], np.array([False, False]))[0].size == 0


def test_what_does_not_fit_is_named():
    with pytest.raises(ValueError, match="successes is 3 of 2 trials"):
        proportion(3, 2)
    with pytest.raises(ValueError, match="probability is 1.0, not between 0 and 1"):
        quantile([1.0], 1.0)
    with pytest.raises(ValueError, match=r"first is int64 \(2,\) and second bool \(2,\), not bool"):
        share_difference([1, 0], [True, False])
    with pytest.raises(ValueError, match="first has 1 trials, second 2"):
        paired_difference([1.0], [1.0, 2.0])
    with pytest.raises(ValueError, match="failed is int64"):
        survival([1.0], np.array([1]))
