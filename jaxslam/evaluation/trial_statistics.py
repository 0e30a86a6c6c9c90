"""Statistics of Monte-Carlo trials: shares, quantiles and differences, each with its interval."""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from jaxslam.core.types import as_float64

CONFIDENCE = 0.95


class Interval(NamedTuple):
    """An estimate and its confidence interval; NaN where there is none."""

    value: float
    low: float
    high: float


class Difference(NamedTuple):
    """Mean difference of two variants over trials.

    Attributes:
        mean: Of the second less the first.
        standard_error: Of `mean`, of trials that are paired.
        unpaired_standard_error: The same if the trials of the two had nothing in common.
        pairs: Number of trials in which both are finite.
    """

    mean: float
    standard_error: float
    unpaired_standard_error: float
    pairs: int


class ShareDifference(NamedTuple):
    """Difference of two shares of the same trials.

    Attributes:
        value: The second less the first.
        low: Of its interval.
        high: Likewise.
        only_first: Trials that succeed in the first variant alone.
        only_second: In the second alone.
        p_value: Of the hypothesis that there is no difference.
    """

    value: float
    low: float
    high: float
    only_first: int
    only_second: int
    p_value: float


def proportion(successes: int, trials: int, confidence: float = CONFIDENCE) -> Interval:
    """Share of successes, with the score interval of Wilson (1927).

    Raises:
        ValueError: More successes than trials, or a number below 0.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"successes is {successes} of {trials} trials")
    if not trials:
        return Interval(np.nan, 0.0, 1.0)
    found = stats.binomtest(int(successes), int(trials)).proportion_ci(confidence, "wilson")
    return Interval(successes / trials, float(found.low), float(found.high))


def quantile(values: Any, probability: float, confidence: float = CONFIDENCE) -> Interval:
    """Quantile of independent values (N,), with an interval for any distribution.

    The number of values below the true quantile is binomial: the limits are two of the values. A
    limit that no value reaches with this confidence is infinite.

    Raises:
        ValueError: The values are not (N,) numbers, or the probability is not between 0 and 1.
    """
    ordered = np.sort(_finite("values", values))
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability is {probability}, not between 0 and 1")
    if not len(ordered):
        return Interval(np.nan, np.nan, np.nan)
    first, last = _ranks(len(ordered), probability, confidence)
    low = -np.inf if np.isnan(first) else ordered[int(first)]
    high = np.inf if np.isnan(last) else ordered[int(last)]
    return Interval(float(np.quantile(ordered, probability)), float(low), float(high))


@lru_cache(maxsize=256)
def _ranks(count: int, probability: float, confidence: float) -> tuple[float, float]:
    """Which of the ordered values are the limits of a quantile's interval; NaN: none is."""
    found = stats.quantile_test(np.arange(count), p=probability, q=(count - 1) / 2)
    low, high = found.confidence_interval(confidence)
    return float(low), float(high)


def paired_difference(first: Any, second: Any) -> Difference:
    """Mean of `second` less `first` over trials (N,) that have their random numbers in common.

    Raises:
        ValueError: They are not (N,) numbers of the same trials.
    """
    a, b = as_float64("first", first, ("N",)), as_float64("second", second, ("N",))
    if len(a) != len(b):
        raise ValueError(f"first has {len(a)} trials, second {len(b)}")
    good = np.isfinite(a) & np.isfinite(b)
    count = int(good.sum())
    if count < 2:
        return Difference(np.nan, np.nan, np.nan, count)
    gap = (b - a)[good]
    unpaired = np.sqrt((np.var(a[good], ddof=1) + np.var(b[good], ddof=1)) / count)
    paired = np.std(gap, ddof=1) / np.sqrt(count)
    return Difference(float(gap.mean()), float(paired), float(unpaired), count)


def share_difference(first: Any, second: Any) -> ShareDifference:
    """Difference of the shares of successes of two variants over the same trials.

    With b trials that succeed in the first alone and c in the second alone, of N,

        (c - b) / (N + 2) +- z sqrt(b + c + 1 - (c - b)^2 / (N + 2)) / (N + 2)

    and the p-value is that of b of b + c fair coins: the exact test of McNemar.

    Args:
        first: (N,) bool, which trials of the first variant succeed.
        second: (N,) bool, of the second.

    Raises:
        ValueError: They are not bool, or not of the same trials, or there are none.

    References:
        Agresti, Min (2005), Simple improved confidence intervals for comparing matched
        proportions, Statistics in Medicine 24; their adjusted Wald interval.
    """
    a, b = np.asarray(first), np.asarray(second)
    if a.dtype != bool or b.dtype != bool or a.shape != b.shape or a.ndim != 1 or not len(a):
        raise ValueError(f"first is {a.dtype} {a.shape} and second {b.dtype} {b.shape}, not bool")
    lost, won, count = int((a & ~b).sum()), int((~a & b).sum()), len(a) + 2
    middle = (won - lost) / count
    half = stats.norm.ppf((1 + CONFIDENCE) / 2)
    half *= np.sqrt(won + lost + 1 - (won - lost) ** 2 / count) / count
    p_value = stats.binomtest(won, won + lost).pvalue if won + lost else 1.0
    low, high = max(-1.0, middle - half), min(1.0, middle + half)
    return ShareDifference(
        (won - lost) / len(a), float(low), float(high), lost, won, float(p_value)
    )


def mean_interval(mean: float, standard_error: float, count: int) -> tuple[float, float]:
    """Interval of a mean of N values by Student's t; not a number for fewer than two."""
    if count < 2:
        return np.nan, np.nan
    half = stats.t.ppf((1 + CONFIDENCE) / 2, count - 1) * standard_error
    return float(mean - half), float(mean + half)


def p_value_of_mean(mean: float, standard_error: float, count: int) -> float:
    """Of the hypothesis that the mean of N values is 0, by Student's t; 1 where none can be had."""
    if count < 2 or not np.isfinite(mean) or (mean == 0.0 and standard_error == 0.0):
        return 1.0
    if standard_error == 0.0:
        return 0.0
    return float(2.0 * stats.t.sf(abs(mean) / standard_error, count - 1))


def holm(p_values: Any) -> np.ndarray:
    """P-values (K,) of K tests, adjusted so that all of them together err as one does.

    References:
        Holm (1979), A simple sequentially rejective multiple test procedure.
    """
    given = as_float64("p_values", p_values, ("K",))
    order = np.argsort(given, kind="stable")
    steps = given[order] * np.arange(len(given), 0, -1)
    adjusted = np.empty_like(given)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted


def survival(times: Any, failed: Any) -> tuple[np.ndarray, np.ndarray]:
    """Share of trials that have not failed yet, by the estimator of Kaplan and Meier (1958).

    Args:
        times: (N,) when each failed, or ended without failure.
        failed: (N,) bool, whether it failed.

    Returns:
        Times (K,) of failures, and the share (K,) that goes on after each.

    Raises:
        ValueError: The arrays do not fit each other.
    """
    times = as_float64("times", times, ("N",))
    failed = np.asarray(failed)
    if failed.shape != times.shape or failed.dtype != bool:
        raise ValueError(f"failed is {failed.dtype} {failed.shape}, not bool {times.shape}")
    if not failed.any():
        return np.zeros(0), np.zeros(0)
    data = stats.CensoredData.right_censored(times, ~failed)
    found = stats.ecdf(data).sf
    at = np.isin(found.quantiles, times[failed])
    return found.quantiles[at], found.probabilities[at]


def _finite(name: str, values: Any) -> np.ndarray:
    numbers = as_float64(name, values, ("N",))
    return numbers[np.isfinite(numbers)]
