"""What the statistics of a filter's innovations and errors say, in words.

The size of the innovations says whether their covariance S is right; the sign of their correlation
says whether the gain is. A gain that is too low corrects a part of each error, and leaves the rest
to the next innovation: neighbours have the same sign. One that is too high corrects too much, and
neighbours have opposite signs. Q too small, or R too large, makes the gain too low. So

    innovations are       white             same sign         opposite signs
    too large             Q and R small     Q small           R small
    as stated             right             Q small for R     Q large for R
    too small             Q and R large     R large           Q large

Correlated noise looks like a gain that is too low, and a bias makes innovations large, too.

References:
    Mehra (1970), "On the identification of variances and adaptive Kalman filtering", sections III,
    IV: correlation of the innovations of a filter that is not optimal.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxslam.evaluation.chi_square_fit import LEVEL, NORMAL_QUANTILE, ChiSquareFit
from jaxslam.evaluation.whiteness import Whiteness

SIGNIFICANT = 3.0  # standard errors from what is expected, from which on it is a finding
P_VALUE = 0.0027  # the same as a probability
NEIGHBOURS = 5  # lags that show a wrong gain together, where it shows in none alone
SLIGHT = 0.1  # correlations, and deviations of NIS and NEES per dof from 1, that are small

CAUSES: Mapping[tuple[int, int], str] = {
    (1, 0): "Q and R too small, by a common factor of {factor:.2g}",
    (1, 1): "Q too small, or noise that is itself correlated",
    (1, -1): "R too small",
    (0, 1): "Q too small for R, or noise that is itself correlated",
    (0, -1): "Q too large for R",
    (-1, 0): "Q and R too large, by a common factor of {inverse:.2g}",
    (-1, 1): "R too large, or noise that is itself correlated",
    (-1, -1): "Q too large",
}
"""Likely cause by size of the innovations and sign of their correlation."""


class _Correlation(NamedTuple):
    """Mean correlation of a series over lags 1 to `last`, and its score in standard deviations."""

    series: int
    last: int
    mean: float
    score: float


def verdicts_of(
    nis: ChiSquareFit,
    nees: ChiSquareFit | None,
    white: Whiteness | None,
    nis_white: Whiteness,
) -> tuple[tuple[str, ...], bool]:
    """Findings in words, and whether the filter is consistent, that is, whether there are none."""
    biased = np.zeros(0, int) if white is None else np.flatnonzero(_bias_scores(white))
    size = _size_of(nis, white, biased)
    sign = 0 if white is None else _sign(white)
    found = [
        *_nis_lines(nis, white, biased, size, sign),
        *_bias_lines(white, biased),
        *_correlation_lines(white, biased, size, sign),
        *_shape_lines(nis, "NIS"),
        *_time_lines(white, nis_white),
    ]
    found += [] if nees is None else _nees_lines(nees, hidden=not found and white is not None)
    if found:
        return tuple(found), False
    parts = [_mean_text("NIS", nis), *([] if nees is None else [_mean_text("NEES", nees)])]
    if white is not None:
        tested = np.isfinite(white.ljung_box_p)
        parts += [f"innovations are {'white, ' if tested else ''}without bias"]
        parts += [] if tested else ["too few to say whether they are white"]
    return (f"consistent: {'; '.join(parts)}",), True


def _mean_text(name: str, fit: ChiSquareFit) -> str:
    """Mean per degree of freedom, with half of its 95 % interval and as many digits as that has."""
    half = NORMAL_QUANTILE * fit.std_error
    if not np.isfinite(half):
        return f"{name} per dof {fit.per_dof:.2f} (1 expected, of a single step)"
    digits = int(np.clip(-np.floor(np.log10(half)), 2, 4)) if half > 0.0 else 2
    return f"{name} per dof {fit.per_dof:.{digits}f} (1 expected, +- {half:.{digits}f})"


def _bias_scores(white: Whiteness) -> np.ndarray:
    """Whether the mean of each series (m,) is significant; False where it is not known."""
    # Numbers that are all the same have no scatter; white ones would have that of 1 / sqrt(N).
    least = 1.0 / np.sqrt(np.maximum(white.num_values, 1))
    return np.abs(white.mean) > SIGNIFICANT * np.where(
        white.mean_std_error > 0.0, white.mean_std_error, least
    )


def _bias_part(nis: ChiSquareFit, white: Whiteness | None, biased: np.ndarray) -> float:
    """Share of NIS per degree of freedom that is the square of a mean."""
    if white is None or not biased.size:
        return 0.0
    return float(np.sum((white.num_values * white.mean**2)[biased]) / nis.dof.sum())


def _size_of(nis: ChiSquareFit, white: Whiteness | None, biased: np.ndarray) -> int:
    """Whether innovations without their bias are too large (1), as stated (0) or too small (-1)."""
    if abs(nis.score) < SIGNIFICANT:
        return 0
    without = nis.score * (nis.per_dof - _bias_part(nis, white, biased) - 1.0) / (nis.per_dof - 1.0)
    return int(np.sign(without)) if abs(without) >= SIGNIFICANT else 0


def _correlation(white: Whiteness) -> _Correlation:
    """The correlation of neighbours that is most significant, of the series and spans of lags."""
    found = [_Correlation(0, 1, 0.0, 0.0)]
    for k, (r, pairs) in enumerate(zip(white.autocorrelation, white.num_pairs, strict=True)):
        for last in (1, NEIGHBOURS):
            values, counts = r[1 : last + 1], pairs[1 : last + 1]
            if len(values) == last and np.isfinite(values).all():
                score = np.sum(np.sqrt(counts) * values) / np.sqrt(last)
                found.append(_Correlation(k, last, float(np.mean(values)), float(score)))
    return max(found, key=lambda each: abs(each.score))


def _sign(white: Whiteness) -> int:
    """Sign of the correlation of neighbours, 0 if it is not significant."""
    most = _correlation(white).score
    return int(np.sign(most)) if abs(most) > SIGNIFICANT else 0


def _correlation_text(white: Whiteness) -> tuple[str, str]:
    """A word on the size of the correlation of neighbours, and its lags with the number."""
    k, last, mean, score = _correlation(white)
    band = abs(2.0 * mean / score)
    lags = "lag 1" if last == 1 else f"lags 1 to {last}, mean"
    slightly = "slightly " if abs(mean) < SLIGHT else ""
    name = f" {white.names[k]}" if len(white.names) > 1 else ""
    return slightly, f"at {lags}:{name} {mean:+.2f} (0 expected, +- {band:.2f})"


def _cause(white: Whiteness, size: int, sign: int, per_dof: float) -> str:
    """Likely cause; a slight correlation does not say how much both Q and R are off."""
    text = CAUSES[size, sign].format(factor=per_dof, inverse=1.0 / max(per_dof, 1e-12))
    if size and sign and abs(_correlation(white).mean) < SLIGHT:
        return f"{text}, perhaps {'Q' if text.startswith('R') else 'R'}, too"
    return text


def _nis_lines(
    nis: ChiSquareFit, white: Whiteness | None, biased: np.ndarray, size: int, sign: int
) -> list[str]:
    """NIS per degree of freedom, where it is not 1."""
    if abs(nis.score) < SIGNIFICANT:
        return []
    text, part = _mean_text("NIS", nis), _bias_part(nis, white, biased)
    if nis.per_dof > 1.0 and size <= 0 and part > 0.5 * (nis.per_dof - 1.0):
        return [f"innovations too large by their bias: {text}, {part:.2f} of it the bias"]
    slightly = "slightly " if abs(nis.per_dof - 1.0) < SLIGHT else ""
    which = "large" if nis.per_dof > 1.0 else "small"
    if white is None:
        cause = "Q or R too small" if nis.per_dof > 1.0 else "Q or R too large"
    else:
        cause = _cause(white, size, sign, nis.per_dof - part)
    return [f"{cause}: innovations are {slightly}too {which}, {text}"]


def _correlation_lines(
    white: Whiteness | None, biased: np.ndarray, size: int, sign: int
) -> list[str]:
    """Correlation of the innovations, where there is any."""
    if white is None:
        return []
    if sign:
        slightly, where = _correlation_text(white)
        cause = "" if size else f"; {'the bias, or ' if biased.size else ''}{CAUSES[0, sign]}"
        return [f"innovations are {slightly}correlated {where}{cause}"]
    if white.ljung_box_p < P_VALUE:
        scores = np.nan_to_num(white.autocorrelation * np.sqrt(white.num_pairs))[:, 1:]
        k, lag = np.unravel_index(np.argmax(np.abs(scores)), scores.shape)
        r = white.autocorrelation[k, lag + 1]
        return [
            f"innovations are correlated, most at lag {lag + 1}, {white.names[k]} {r:+.2f} "
            f"(Ljung-Box p {white.ljung_box_p:.1g}): noise or motion that the model lacks"
        ]
    return []


def _bias_lines(white: Whiteness | None, biased: np.ndarray) -> list[str]:
    """Means of the innovations that are not 0."""
    if white is None or not biased.size:
        return []
    means = (
        f"{white.names[k]} {white.mean[k]:+.2f} +- {NORMAL_QUANTILE * white.mean_std_error[k]:.2f}"
        for k in biased.tolist()
    )
    listed = ", ".join(means)
    return [f"a bias: innovations have the mean {listed} standard deviations (0 expected)"]


def _shape_lines(fit: ChiSquareFit, name: str) -> list[str]:
    """A distribution that is not chi-square, where the mean alone does not show it."""
    if abs(fit.score) >= SIGNIFICANT:
        return []
    if fit.ks_p >= P_VALUE:
        return _outlier_lines(fit, name)
    known = fit.pit[fit.dof > 0]
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.mean(known < tail), np.mean(known > 1.0 - tail)
    if low > tail and high > tail:
        cause = "both tails are heavy: outliers, or noise that varies"
    elif low < tail and high < tail:
        cause = "both tails are light: a gate cuts them, or dependent measurements"
    else:
        cause = f"{low:.1%} below and {high:.1%} above the {LEVEL:.0%} interval"
    return [f"{name} is not chi-square distributed (distance {fit.ks:.2f}): {cause}"]


def _outlier_lines(fit: ChiSquareFit, name: str) -> list[str]:
    """Single values that chi-square does not have: they also hide in the scatter of the mean."""
    from scipy.stats import chi2  # imported here, because it is slow to import

    above = np.where(fit.dof > 0, chi2.sf(fit.values, np.maximum(fit.dof, 1)), 1.0)
    wrong = above < P_VALUE / fit.num_values  # of so many, one is beyond with this probability
    if not wrong.any():
        return []
    worst = np.unravel_index(np.nanargmax(np.where(wrong, fit.values, np.nan)), wrong.shape)
    where = worst[1:] if len(fit.values) == 1 else worst
    at = ", ".join(str(int(k)) for k in where)
    return [
        f"{wrong.sum()} of {fit.num_values} steps are outliers: {name} is {fit.values[worst]:.3g} "
        f"at step [{at}], of {fit.dof[worst]} dof; wrong measurements, or angles that are not "
        "wrapped"
    ]


def _time_lines(white: Whiteness | None, nis_white: Whiteness) -> list[str]:
    """Noise whose size varies in time: large innovations follow large ones.

    Innovations with the correlation r have squares with r^2, which is no finding of its own.
    """
    if nis_white.ljung_box_p >= P_VALUE or _sign(nis_white) <= 0:
        return []
    if white is not None and (_sign(white) or white.ljung_box_p < P_VALUE):
        excess = nis_white.autocorrelation[0, 1] - np.nanmax(white.autocorrelation[:, 1] ** 2)
        if not excess > max(SLIGHT, SIGNIFICANT / np.sqrt(nis_white.num_pairs[0, 1])):
            return []
    slightly, where = _correlation_text(nis_white)
    cause = "noise that varies in time, or correlated innovations"
    return [f"NIS is {slightly}correlated {where}; {cause}"]


def _nees_lines(nees: ChiSquareFit, *, hidden: bool) -> list[str]:
    """NEES per degree of freedom, where it is not 1; `hidden`: the innovations are as stated."""
    if abs(nees.score) < SIGNIFICANT:
        return _shape_lines(nees, "NEES")
    slightly = "slightly " if abs(nees.per_dof - 1.0) < SLIGHT else ""
    text = _mean_text("NEES", nees)
    if nees.per_dof < 1.0:
        return [f"{slightly}too cautious: errors are below their covariance, {text}"]
    cause = "; no innovation shows it: a bias that the state absorbs, or a wrong start"
    end = cause if hidden else ""
    return [f"{slightly}over-confident: errors exceed their covariance, {text}{end}"]
