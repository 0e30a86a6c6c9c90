"""Whether series are white noise: mean, autocorrelation, and the statistic of Ljung and Box.

A series is (B, T): B independent trials of T steps, of which a mask leaves some out. Those are
deleted, and the rest counts as consecutive: a lag is a number of values, not of time steps. That is
right for innovations, which are white over the updates, however far these are apart.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxslam.core.types import as_count

MAX_LAGS = 20  # that are taken by default, where the series are long enough
MIN_TRIALS = 8  # from which on the spread between trials gives the standard error of a mean
MAX_CORRELATION = 0.97  # of neighbours, in the standard error of a mean


class Whiteness(NamedTuple):
    """Statistics of m series, which are white noise with mean 0 if a filter is right.

    Attributes:
        names: (m,) names of the series.
        num_values: (m,) number of values.
        mean: (m,) their mean.
        mean_std_error: (m,) its standard error, which allows for autocorrelation.
        autocorrelation: (m, L + 1) at lags 0 to L, about the mean; NaN where there are no pairs.
        num_pairs: (m, L + 1) pairs of values at each lag.
        ljung_box: () statistic over lags 1 to L of all series.
        ljung_box_dof: () its degrees of freedom.
        ljung_box_p: () probability of a larger one, if the series are white.
    """

    names: tuple[str, ...]
    num_values: np.ndarray
    mean: np.ndarray
    mean_std_error: np.ndarray
    autocorrelation: np.ndarray
    num_pairs: np.ndarray
    ljung_box: float
    ljung_box_dof: int
    ljung_box_p: float

    @property
    def band(self) -> np.ndarray:
        """Half of the band (m, L + 1) that holds 95 % of the autocorrelations of white noise."""
        return 2.0 / np.sqrt(np.maximum(self.num_pairs, 1))


def whiteness(
    values: np.ndarray, mask: np.ndarray, names: Sequence[str], num_lags: int | None = None
) -> Whiteness:
    """Test m series for whiteness.

    Args:
        values: (B, T, m) the series.
        mask: (B, T, m) bool, values that exist; one at least.
        names: (m,) their names.
        num_lags: L; by default a quarter of the longest trial, and no more than `MAX_LAGS`.

    Raises:
        ValueError: `num_lags` is no number from 1 to the length of the longest trial less 1.
    """
    longest = int(mask.sum(axis=1).max())
    if num_lags is None:
        lags = max(1, min(MAX_LAGS, longest // 4))
    else:
        lags = as_count("num_lags", num_lags)
        if lags >= longest:
            raise ValueError(f"num_lags is {lags}, but the longest series has {longest} values")
    series = [deleted(values[..., k], mask[..., k]) for k in range(values.shape[-1])]
    moments = [_moments(x, has) for x, has in series]
    found = [autocorrelation(x, has, lags) for x, has in series]
    correlation = np.stack([r for r, _ in found])
    pairs = np.stack([n for _, n in found])
    statistic, dof, p = ljung_box(correlation, pairs)
    return Whiteness(
        names=tuple(names),
        num_values=mask.sum(axis=(0, 1)),
        mean=np.array([mean for mean, _ in moments]),
        mean_std_error=np.array([error for _, error in moments]),
        autocorrelation=correlation,
        num_pairs=pairs,
        ljung_box=statistic,
        ljung_box_dof=dof,
        ljung_box_p=p,
    )


def deleted(values: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move the values (B, T) that exist to the front of each trial, in their order.

    Returns:
        Values (B, N), zero after the last, and their mask (B, N), with the most of a trial as N.
    """
    order = np.argsort(~mask, axis=1, kind="stable")[:, : mask.sum(axis=1).max(initial=0)]
    has = np.take_along_axis(mask, order, axis=1)
    return np.where(has, np.take_along_axis(values, order, axis=1), 0.0), has


def autocorrelation(
    values: np.ndarray, mask: np.ndarray, num_lags: int
) -> tuple[np.ndarray, np.ndarray]:
    """Autocorrelation (L + 1,) of a series, about its mean over all trials.

        r_l = mean over pairs of x_t x_{t+l} / mean of x_t^2

    Args:
        values: (B, N) as of `deleted`.
        mask: (B, N) bool.
        num_lags: L.

    Returns:
        The autocorrelation, NaN where it is not defined, and the number of pairs (L + 1,).
    """
    count = mask.sum()
    centred = np.where(mask, values - values.sum() / max(count, 1), 0.0)
    products, pairs = np.zeros(num_lags + 1), np.zeros(num_lags + 1, int)
    for lag in range(min(num_lags, mask.shape[1] - 1) + 1):
        ahead = slice(lag, None), slice(None, mask.shape[1] - lag)
        products[lag] = np.sum(centred[:, ahead[0]] * centred[:, ahead[1]])
        pairs[lag] = np.sum(mask[:, ahead[0]] & mask[:, ahead[1]])
    defined = (pairs > 0) & (products[0] > 0.0)
    square = products[0] / max(count, 1)
    mean = products / np.maximum(pairs, 1)
    return np.where(defined, mean / np.where(defined, square, 1.0), np.nan), pairs


def ljung_box(correlation: np.ndarray, num_pairs: np.ndarray) -> tuple[float, int, float]:
    """Statistic of Ljung and Box, summed over m series.

        Q = (N + 2) / N sum_l n_l r_l^2,    l = 1 .. L

    with N values of a series and n_l pairs at lag l. For one trial of N values n_l = N - l, and
    this is the usual N (N + 2) sum_l r'_l^2 / (N - l) with r'_l = (N - l) / N r_l.

    Args:
        correlation: (m, L + 1) as of `autocorrelation`; NaN is left out.
        num_pairs: (m, L + 1) number of pairs.

    Returns:
        The statistic; its degrees of freedom, L for each series; and the probability of a larger
        one if the series are white, which is NaN where nothing is left.

    References:
        Ljung, Box (1978), "On a measure of lack of fit in time series models".
    """
    from scipy.stats import chi2  # imported here, because it is slow to import

    used = np.isfinite(correlation[:, 1:])
    terms = num_pairs[:, 1:] * np.where(used, correlation[:, 1:], 0.0) ** 2
    count = np.maximum(num_pairs[:, 0], 1)
    statistic = float(np.sum((count + 2) / count * terms.sum(axis=1)))
    dof = int(used.sum())
    return statistic, dof, float(chi2.sf(statistic, dof)) if dof else np.nan


def _moments(values: np.ndarray, mask: np.ndarray) -> tuple[float, float]:
    """Mean of a series, and its standard error; NaN where it is not defined."""
    count = mask.sum()
    if not count:
        return np.nan, np.nan
    mean = float(values.sum() / count)
    return mean, std_error(np.where(mask, values - mean, 0.0), mask)


def std_error(residuals: np.ndarray, mask: np.ndarray) -> float:
    """Standard error of the mean of a series, which allows for its autocorrelation.

    From `MIN_TRIALS` trials on it comes from the sums of the trials, which are independent,
    whatever the correlation within one:

        (sqrt(B / (B - 1) sum_b (sum_t e_bt)^2)) / N

    With fewer it is the prewhitened estimator of Newey and West: a first-order autoregression with
    the correlation r of neighbours is taken out, e_t = r e_{t-1} + u_t, so that with g_l the
    autocovariance of u at lag l, summed over M lags,

        sqrt((g_0 + 2 sum_{l<=M} (1 - l / (M + 1)) g_l) / N) / (1 - r)
        M = 1.1447 (a N / B)^(1/3),   a = 4 s^2 / (1 - s^2)^2

    with s the correlation of neighbours of u.

    Args:
        residuals: (B, N) deviations from the mean, as of `deleted`, 0 where there is no value.
        mask: (B, N) bool, True where there is one.

    Returns:
        The standard error; NaN with fewer than two values.

    References:
        Newey, West (1987), "A simple, positive semi-definite, heteroskedasticity and
        autocorrelation consistent covariance matrix". Andrews (1991), "Heteroskedasticity and
        autocorrelation consistent covariance matrix estimation", eqs. (6.2), (6.4). Andrews,
        Monahan (1992), "An improved heteroskedasticity and autocorrelation consistent covariance
        matrix estimator".
    """
    count, trials = int(mask.sum()), int(mask.any(axis=1).sum())
    if count < 2:
        return np.nan
    if trials >= MIN_TRIALS:
        sums = residuals.sum(axis=1)
        return float(np.sqrt(trials / (trials - 1) * np.sum(sums**2)) / count)
    neighbours = _neighbours(residuals)
    rest = np.where(mask[:, 1:], residuals[:, 1:] - neighbours * residuals[:, :-1], 0.0)
    number, length = int(mask[:, 1:].sum()), rest.shape[1]
    if number < 2:
        return float(np.sqrt(np.mean(residuals[mask] ** 2) / count))

    def covariance(lag: int) -> float:
        return float(np.sum(rest[:, lag:] * rest[:, : length - lag])) / number

    square = _neighbours(rest) ** 2
    strength = 4.0 * square / (1.0 - square) ** 2
    num_lags = min(int(1.1447 * (strength * number / trials) ** (1 / 3)), length - 1)
    weights = 1.0 - np.arange(1, num_lags + 1) / (num_lags + 1)
    total = covariance(0) + 2.0 * sum(w * covariance(k + 1) for k, w in enumerate(weights))
    return float(np.sqrt(max(total, 0.0) / count)) / (1.0 - neighbours)


def _neighbours(residuals: np.ndarray) -> float:
    """Correlation of neighbours of a series (B, N) of mean 0, limited to what a mean allows."""
    square = np.sum(residuals**2)
    product = np.sum(residuals[:, 1:] * residuals[:, :-1])
    ratio = product / square if square > 0.0 else 0.0
    return float(np.clip(ratio, -MAX_CORRELATION, MAX_CORRELATION))
