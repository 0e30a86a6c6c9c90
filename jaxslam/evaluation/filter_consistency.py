"""Is a Kalman filter right? NIS, NEES, whiteness and bias of its innovations, and what to change.

For any filter: all that is needed is what it computes anyway. If the model of a filter is right its
innovations v are white, with mean 0 and the covariance S that it states; so

    w = L^-1 v,   S = L L^T        is standard normal and independent of all other w
    NIS = w^T w                    is chi-square distributed with the dimension of v
    NEES = e^T P^-1 e              likewise, of the estimation error e, where the truth is known

and each deviation has a cause of its own (`consistency_verdicts`).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxslam.core.types import Metrics, as_float64
from jaxslam.evaluation.chi_square_fit import ChiSquareFit, chi_square_fit
from jaxslam.evaluation.consistency_verdicts import verdicts_of
from jaxslam.evaluation.normalised import check_squares, normalise, steps_of
from jaxslam.evaluation.whiteness import Whiteness, whiteness

MAX_SCORE = 8.0  # of a normal score, where a probability rounds to 0 or 1


class ConsistencyReport(NamedTuple):
    """How well a filter's own covariances describe its innovations and errors.

    Attributes:
        nis: NIS of each step, against its chi-square distribution.
        nees: Likewise NEES; None without errors.
        whiteness: Mean and autocorrelation of the whitened innovations; None if only NIS is known.
        nis_whiteness: Likewise of the normal scores of NIS, whose correlation shows noise that
            changes in time.
        verdicts: Findings in words, one each; a single one that says so if the filter is
            consistent.
        consistent: True if no statistic is more than three standard errors from what is expected.
    """

    nis: ChiSquareFit
    nees: ChiSquareFit | None
    whiteness: Whiteness | None
    nis_whiteness: Whiteness
    verdicts: tuple[str, ...]
    consistent: bool

    def __str__(self) -> str:
        """The findings, a line each."""
        return "\n".join(self.verdicts)


def consistency_report(
    innovations: Any,
    covariances: Any,
    *,
    mask: Any = None,
    errors: Any = None,
    error_covariances: Any = None,
    error_mask: Any = None,
    names: Sequence[str] | None = None,
    num_lags: int | None = None,
) -> ConsistencyReport:
    """Report on the innovations of any Kalman filter, and on its errors where truth is known.

    Args:
        innovations: (T, m) or (B, T, m) measurement minus prediction, angles wrapped, of B
            independent trials; or columns (..., m, 1), with a covariance for each.
        covariances: (..., m, m) their covariances S as the filter states them; or one (m, m).
        mask: (..., m) bool, numbers that were measured, or (...), steps; by default all. What is
            left out may be NaN. A series is tested for whiteness over those that are left.
        errors: (T, n) or (B, T, n) estimate minus truth, angles wrapped.
        error_covariances: (..., n, n) their covariances P as the filter states them; or one (n, n).
        error_mask: (..., n) or (...), errors that are known; likewise.
        names: (m,) what each number of an innovation is; by default "component 0", ...
        num_lags: Lags of the autocorrelation; by default a quarter of the longest trial, no more
            than 20.

    Raises:
        ValueError: An argument has another shape or kind; a number that is not left out is not
            finite; a covariance is not symmetric or not positive definite; nothing is left.

    References:
        Mehra (1970), "On the identification of variances and adaptive Kalman filtering".
        Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications, section 5.4.
    """
    squares, dof, whitened = normalise(
        ("innovations", "covariances", "mask"), innovations, covariances, mask
    )
    if (errors is None) != (error_covariances is None):
        missing = "errors" if errors is None else "error_covariances"
        raise ValueError(f"{missing} is missing: errors and error_covariances go together")
    if errors is None and error_mask is not None:
        raise ValueError("errors is missing: error_mask is of them")
    nees = nees_dof = None
    if errors is not None:
        nees, nees_dof, _ = normalise(
            ("errors", "error_covariances", "error_mask"), errors, error_covariances, error_mask
        )
    return consistency_of_nis(
        squares,
        dof,
        whitened=whitened,
        names=names,
        nees=nees,
        nees_dof=nees_dof,
        num_lags=num_lags,
    )


def consistency_of_nis(
    nis: Any,
    dof: Any,
    *,
    whitened: Any = None,
    names: Sequence[str] | None = None,
    nees: Any = None,
    nees_dof: Any = None,
    num_lags: int | None = None,
) -> ConsistencyReport:
    """`consistency_report` of a filter that states NIS, and perhaps NEES, but no innovations.

    Args:
        nis: (T,) or (B, T) NIS of each step.
        dof: (T,) or (B, T) integers, its degrees of freedom; 0 where nothing was measured; or one
            for all steps.
        whitened: (..., m) numbers that are white with unit variance if the filter is right, such as
            whitened innovations or state corrections; NaN where there is none.
        names: (m,) what each of them is.
        nees: (...) NEES of each step.
        nees_dof: (...) its degrees of freedom, 0 where the truth is unknown.
        num_lags: As of `consistency_report`.

    Raises:
        ValueError: An argument has another shape or kind, a number is negative or not finite, or
            nothing is left.
    """
    squares, degrees = check_squares("nis", "dof", nis, dof)
    fit = chi_square_fit(squares, degrees)
    if (nees is None) != (nees_dof is None):
        missing = "nees" if nees is None else "nees_dof"
        raise ValueError(f"{missing} is missing: nees and nees_dof go together")
    errors = (
        None if nees is None else chi_square_fit(*check_squares("nees", "nees_dof", nees, nees_dof))
    )
    white = None
    if whitened is not None:
        numbers = steps_of(as_float64("whitened", whitened, (*np.shape(nis), "m")), 1)
        if np.isinf(numbers).any():
            raise ValueError("whitened holds infinite numbers; NaN is none")
        white = whiteness(
            numbers, np.isfinite(numbers), check_names(names, numbers.shape[-1]), num_lags
        )
    scores = normal_scores(fit)[..., None]
    magnitude = whiteness(scores, np.isfinite(scores), ("NIS",), num_lags)
    verdicts, consistent = verdicts_of(fit, errors, white, magnitude)
    return ConsistencyReport(fit, errors, white, magnitude, verdicts, consistent)


def check_names(names: Sequence[str] | None, count: int) -> tuple[str, ...]:
    """Names (m,) of numbers, "component 0" and so on by default."""
    if names is None:
        return tuple(f"component {k}" for k in range(count))
    if isinstance(names, str) or len(names) != count:
        raise ValueError(f"names is {names!r}, not a name for each of {count} components")
    texts = tuple(map(str, names))
    if len(set(texts)) < count:
        raise ValueError(f"names is {names!r}: two components have one name")
    return texts


def normal_scores(fit: ChiSquareFit) -> np.ndarray:
    """Standard normal numbers with the probabilities of the values: inverse normal of `pit`."""
    from scipy.stats import chi2, norm  # imported here, because it is slow to import

    has = fit.dof > 0
    scores = np.full(fit.values.shape, np.nan)
    above = chi2.sf(fit.values[has], fit.dof[has])
    upper = norm.isf(np.minimum(above, 0.5))  # 1 - pit keeps its digits in the upper tail
    scores[has] = np.where(above < 0.5, upper, norm.ppf(np.minimum(fit.pit[has], 0.5)))
    return np.clip(scores, -MAX_SCORE, MAX_SCORE)


def report_metrics(report: ConsistencyReport) -> Metrics:
    """The numbers of a report with the keys of `metrics.json`; None for what there is not."""
    numbers: Metrics = _fit_metrics("nis", report.nis)
    if report.nees is not None:
        numbers |= _fit_metrics("nees", report.nees)
    white = report.whiteness
    if white is not None:
        numbers |= {
            "autocorrelation": dict(zip(white.names, white.autocorrelation.tolist(), strict=True)),
            "ljung_box_p": white.ljung_box_p,
            "bias": dict(zip(white.names, white.mean.tolist(), strict=True)),
            "bias_std_error": dict(zip(white.names, white.mean_std_error.tolist(), strict=True)),
        }
    return numbers | {
        "nis_autocorrelation": report.nis_whiteness.autocorrelation[0].tolist(),
        "nis_ljung_box_p": report.nis_whiteness.ljung_box_p,
        "verdicts": list(report.verdicts),
        "consistent": report.consistent,
    }


def _fit_metrics(name: str, fit: ChiSquareFit) -> Metrics:
    return {
        f"{name}_per_dof": fit.per_dof,
        f"{name}_per_dof_interval": list(fit.interval),
        f"{name}_inside_95": fit.inside,
        f"{name}_ks": fit.ks,
        f"{name}_ks_p": fit.ks_p,
        f"{name}_count": fit.num_values,
    }
