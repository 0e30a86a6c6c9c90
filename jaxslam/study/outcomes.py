"""Outcome of each trial of a study, and what many of them say together."""

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxslam.core.types import Metrics
from jaxslam.evaluation import consistency
from jaxslam.evaluation.consistency import CERTAIN_TRACE
from jaxslam.evaluation.trial_statistics import (
    Difference,
    Interval,
    mean_interval,
    p_value_of_mean,
    paired_difference,
    proportion,
    quantile,
    share_difference,
    survival,
)
from jaxslam.pipeline.episodes import TrialResult

QUANTILES = 0.5, 0.9, 0.99  # of the trials' errors


class Outcomes(NamedTuple):
    """What is kept of N trials of T scans; NumPy arrays.

    Attributes:
        error: (N, T) [m] distance between estimate and truth, infinite from where it is not finite.
        place: (N, T, 2) [m] true position.
        heading_rmse: (N,) [rad].
        nees: (N,) mean NEES of the pose per degree of freedom, over scans with a covariance.
        finite: (N,) bool.
        matches: (N,) updates by landmarks in a scan.
        landmarks: (N,) confirmed ones at the end.
    """

    error: np.ndarray
    place: np.ndarray
    heading_rmse: np.ndarray
    nees: np.ndarray
    finite: np.ndarray
    matches: np.ndarray
    landmarks: np.ndarray


# One program each instead of forty of one operation.
_pose_error, _nees = jax.jit(consistency.pose_error), jax.jit(consistency.nees)


def outcomes_of(result: TrialResult) -> Outcomes:
    """Outcomes of some trials, whose scans are all there and whose truth is known."""
    truth, cov = np.asarray(result.truth), np.asarray(result.cov)
    with np.errstate(invalid="ignore"):
        gap = np.asarray(_pose_error(result.estimate, result.truth), np.float64)
    error = np.hypot(gap[..., 0], gap[..., 1])
    error = np.where(np.isfinite(error), error, np.inf)
    turn = np.where(np.isfinite(gap[..., 2]), gap[..., 2], np.pi)
    value = np.asarray(_nees(gap, cov), np.float64)
    usable = np.isfinite(value) & (np.trace(cov, axis1=-2, axis2=-1) >= CERTAIN_TRACE)
    count = usable.sum(axis=1)
    total = consistency.nees_per_dof(np.where(usable, value, 0.0).sum(axis=1))
    nees = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return Outcomes(
        error.astype(np.float32),
        truth[..., :2].astype(np.float32),
        np.sqrt(np.mean(turn**2, axis=1)),
        nees,
        np.asarray(result.finite) & np.isfinite(error).all(axis=1),
        np.asarray(result.num_updates).mean(axis=1),
        np.asarray(result.num_landmarks),
    )


def failed_at(outcomes: Outcomes, success_distance: float) -> np.ndarray:
    """First scan (N,) of each trial that is further off than `success_distance` [m]; T for none."""
    far = ~(outcomes.error <= success_distance)
    return np.where(far.any(axis=1), far.argmax(axis=1), far.shape[1])


def succeeded(outcomes: Outcomes, success_distance: float) -> np.ndarray:
    """Which trials (N,) are never further off than `success_distance` [m]."""
    return np.asarray((outcomes.error <= success_distance).all(axis=1))


def position_rmse(outcomes: Outcomes) -> np.ndarray:
    """Position RMSE (N,) [m] of each trial, infinite where an estimate is not finite."""
    return np.sqrt(np.mean(outcomes.error.astype(np.float64) ** 2, axis=1))


def summarise(outcomes: Outcomes, *, success_distance: float, scan_period: float) -> Metrics:
    """What N trials of a variant say, each number with its interval of 95 %.

    Args:
        outcomes: Of the trials.
        success_distance: [m] a trial succeeds if its position is never further off.
        scan_period: [s] from a scan to the next.
    """
    trials, scans = outcomes.error.shape
    first = failed_at(outcomes, success_distance)
    failed, rmse = first < scans, position_rmse(outcomes)
    times, going_on = survival(first * scan_period, failed)
    numbers: Metrics = {
        "trials": trials,
        "scans": scans,
        "success": _plain(proportion(int(trials - failed.sum()), trials)),
        "position_rmse_m": {f"p{100 * q:g}": _plain(quantile(rmse, q)) for q in QUANTILES},
        "largest_m": _plain(quantile(outcomes.error.max(axis=1), 0.5)),
        "heading_rmse_deg": float(np.degrees(np.sqrt(np.mean(outcomes.heading_rmse**2)))),
        "nees": _mean(outcomes.nees),
        "nonfinite": int(np.sum(~outcomes.finite)),
        "failed_trials": np.flatnonzero(failed).tolist(),
        "time_to_failure_s": {"times": times.tolist(), "share_without_failure": going_on.tolist()},
        "matches": float(outcomes.matches.mean()),
        "landmarks": float(outcomes.landmarks.mean()),
    }
    return numbers


def compare(first: Outcomes, second: Outcomes, *, success_distance: float) -> Metrics:
    """Differences of the second variant from the first, over trials with the same numbers.

    The RMSE is compared by the mean of its logarithm: `position_rmse_ratio` is that of typical
    errors, over trials in which both are finite.
    """
    ok = [succeeded(x, success_distance) for x in (first, second)]
    success = paired_difference(*(x.astype(float) for x in ok))
    share = share_difference(*ok)
    with np.errstate(divide="ignore"):
        rmse = paired_difference(*(np.log(position_rmse(x)) for x in (first, second)))
    return {
        "success": success._asdict() | share._asdict(),
        "log_position_rmse": rmse._asdict(),
        **ratio_of(rmse),
    }


def ratio_of(log_rmse: Difference) -> Metrics:
    """Ratio of typical errors, with its interval and p-value, of the difference of logarithms."""
    given = log_rmse.mean, log_rmse.standard_error, log_rmse.pairs
    low, high = mean_interval(*given)
    return {
        "position_rmse_ratio": float(np.exp(log_rmse.mean)),
        "position_rmse_ratio_interval": [float(np.exp(low)), float(np.exp(high))],
        "position_rmse_p_value": p_value_of_mean(*given),
    }


def failures_by_place(outcomes: Outcomes, *, success_distance: float, cell: float) -> Metrics:
    """Where on the map trials fail, in squares of the side `cell` [m].

    Returns:
        `origin_m` of the first square, and by square (x, y): `visits` (scans of trials that have
        not failed before), `failures` (trials that fail there), and `rmse_m` over the visits.
    """
    scans = outcomes.error.shape[1]
    first = failed_at(outcomes, success_distance)
    is_on = np.arange(scans)[None] <= first[:, None]
    place = outcomes.place.reshape(-1, 2)
    origin = np.floor(place.min(axis=0) / cell) * cell
    index = np.floor((outcomes.place - origin.astype(np.float32)) / cell).astype(int)
    shape = tuple(index.reshape(-1, 2).max(axis=0) + 1)
    visits, failures, squares = np.zeros(shape, int), np.zeros(shape, int), np.zeros(shape)
    before = is_on & (outcomes.error <= success_distance)
    np.add.at(visits, tuple(index[is_on].T), 1)
    np.add.at(squares, tuple(index[before].T), outcomes.error[before].astype(float) ** 2)
    counted = np.zeros(shape, int)
    np.add.at(counted, tuple(index[before].T), 1)
    own = np.flatnonzero(first < scans)
    np.add.at(failures, tuple(index[own, first[own]].T), 1)
    with np.errstate(invalid="ignore"):
        rmse = np.sqrt(squares / counted)
    return {
        "origin_m": origin.tolist(),
        "cell_m": cell,
        "visits": visits.tolist(),
        "failures": failures.tolist(),
        "rmse_m": [[None if np.isnan(x) else float(x) for x in row] for row in rmse],
    }


def _mean(values: np.ndarray) -> Any:
    """Mean of the values that are finite, with its standard error; None without any."""
    good = values[np.isfinite(values)]
    if not len(good):
        return None
    error = float(good.std(ddof=1) / np.sqrt(len(good))) if len(good) > 1 else None
    return {"mean": float(good.mean()), "standard_error": error}


def _plain(interval: Interval) -> Metrics:
    """An interval for JSON, which has no infinity: None."""
    return {k: float(x) if np.isfinite(x) else None for k, x in interval._asdict().items()}
