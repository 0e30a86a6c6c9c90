"""Statistics of Monte-Carlo trials: shares, quantiles and differences, each with its interval."""

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
    found = stats.quantile_test(ordered, p=probability, q=float(np.median(ordered)))
    low, high = found.confidence_interval(confidence)
    low, high = (-np.inf if np.isnan(low) else low), (np.inf if np.isnan(high) else high)
    return Interval(float(np.quantile(ordered, probability)), float(low), float(high))


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
