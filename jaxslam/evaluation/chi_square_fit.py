"""Normalised squares (NIS, NEES) against the chi-square distribution that they should have."""

from typing import NamedTuple

import numpy as np

from jaxslam.evaluation.whiteness import deleted, std_error

LEVEL = 0.95  # probability of intervals
NORMAL_QUANTILE = 1.959964  # of that probability, two-sided
NUM_BINS = 40  # of a histogram, by default


class ChiSquareFit(NamedTuple):
    """Normalised squares of N steps, with their degrees of freedom, and how they fit.

    Attributes:
        values: (...) normalised squares; NaN where there are none.
        dof: (...) int64 their degrees of freedom; 0 where there are none.
        pit: (...) probability integral transform F(value), which is uniform on 0..1 for any mix of
            degrees of freedom if the filter is right; NaN where there is no value.
        num_values: () N.
        per_dof: () sum of the values / sum of their degrees of freedom: 1 expected.
        std_error: () its standard error, which allows for autocorrelation.
        inflation: () factor by which the autocorrelation raises the variance of the mean; 1 at
            least.
        inside: () fraction of the values within their two-sided 95 % interval.
        inside_std_error: () its standard error.
        ks: () Kolmogorov-Smirnov distance of `pit` from the uniform distribution.
        ks_p: () probability of a larger one if the filter is right, with N reduced by what the
            autocorrelation of `pit` takes from it.
    """

    values: np.ndarray
    dof: np.ndarray
    pit: np.ndarray
    num_values: int
    per_dof: float
    std_error: float
    inflation: float
    inside: float
    inside_std_error: float
    ks: float
    ks_p: float

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % confidence interval of the mean per degree of freedom."""
        half = NORMAL_QUANTILE * self.std_error
        return self.per_dof - half, self.per_dof + half

    @property
    def score(self) -> float:
        """Standard errors by which the mean per degree of freedom is above 1.

        The standard error is no smaller than that of as many chi-square values with the same
        autocorrelation, sqrt(2 inflation / sum of dof), which does not depend on their size.
        """
        least = np.sqrt(2.0 * self.inflation / max(self.dof.sum(), 1))
        return float((self.per_dof - 1.0) / np.fmax(self.std_error, least))


def chi_square_fit(values: np.ndarray, dof: np.ndarray) -> ChiSquareFit:
    """Compare normalised squares with the chi-square distribution.

    Args:
        values: (B, T) normalised squares of B trials of T steps.
        dof: (B, T) their degrees of freedom; 0 where there is no value. One at least is above 0.

    References:
        Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications, section 5.4. Probability
        integral transform: Diebold, Gunther, Tay (1998), "Evaluating density forecasts".
    """
    from scipy.stats import chi2, kstwo  # imported here, because it is slow to import

    has = dof > 0
    values = np.where(has, values, np.nan)
    dof = np.where(has, dof, 0).astype(np.int64)
    known, degrees = values[has], dof[has]
    total = degrees.sum()
    per_dof = float(known.sum() / total)
    pit = np.full(values.shape, np.nan)
    pit[has] = chi2.cdf(known, degrees)

    residuals = np.where(has, values - per_dof * dof, 0.0)
    error = _std_error(residuals, has)
    inflation = _inflation(error, residuals[has])
    is_inside = np.where(has, np.abs(pit - 0.5) <= LEVEL / 2, False)
    inside = float(is_inside.sum() / known.size)
    distance = _ks_distance(pit[has])
    scatter = np.where(has, pit - np.mean(pit[has]), 0.0)
    effective = max(1, round(known.size / _inflation(_std_error(scatter, has), scatter[has])))
    return ChiSquareFit(
        values=values,
        dof=dof,
        pit=pit,
        num_values=known.size,
        per_dof=per_dof,
        std_error=error * known.size / total,
        inflation=inflation,
        inside=inside,
        inside_std_error=_std_error(np.where(has, is_inside - inside, 0.0), has),
        ks=distance,
        ks_p=float(kstwo.sf(distance, effective)),
    )


def _inflation(error: float, residuals: np.ndarray) -> float:
    """Square of a standard error, relative to that of N independent residuals (N,); 1 at least."""
    independent = np.mean(residuals**2) / residuals.size
    return float(max(1.0, error**2 / independent)) if independent > 0.0 and error > 0.0 else 1.0


def _std_error(residuals: np.ndarray, mask: np.ndarray) -> float:
    """Standard error of the mean of what exists of a series (B, T)."""
    return std_error(*deleted(residuals, mask))


def _ks_distance(uniform: np.ndarray) -> float:
    """Kolmogorov-Smirnov distance of numbers (N,) from the uniform distribution."""
    ordered, count = np.sort(uniform), uniform.size
    steps = np.arange(count + 1) / count
    return float(max(np.max(steps[1:] - ordered), np.max(ordered - steps[:-1])))


def histogram(
    fit: ChiSquareFit, dof: int | None = None, edges: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Histogram of the values, and what the chi-square distribution lets expect.

    Args:
        fit: The values.
        dof: Those with these degrees of freedom alone; by default all, against the mixture of
            chi-square distributions with their degrees of freedom.
        edges: (E + 1,) of the bins, rising; by default `NUM_BINS` up to the 99.9 % quantile of the
            largest degrees of freedom, the last bin without an end.

    Returns:
        The edges, the number (E,) of values in each bin, and that expected.

    Raises:
        ValueError: No value has these degrees of freedom.
    """
    from scipy.stats import chi2

    used = fit.dof > 0 if dof is None else fit.dof == dof
    if not used.any():
        known = np.unique(fit.dof[fit.dof > 0]).tolist()
        raise ValueError(f"dof is {dof}, but the values have {known}")
    degrees, counts = np.unique(fit.dof[used], return_counts=True)
    if edges is None:
        most = chi2.ppf(0.999, degrees[np.cumsum(counts) >= 0.99 * counts.sum()][0])
        edges = np.append(np.linspace(0.0, most, NUM_BINS), np.inf)
    below = chi2.cdf(edges[:, None], degrees) @ counts
    return edges, np.histogram(fit.values[used], edges)[0], np.diff(below)
