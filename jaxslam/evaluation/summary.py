"""Errors of many trials summed up, with the keys of `metrics.json`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.types import Array, Metrics, check_array
from jaxslam.evaluation.consistency import CERTAIN_TRACE, nees, nees_per_dof, pose_error
from jaxslam.pipeline.episodes import TrialResult

DIVERGED_DISTANCE = 1.0
"""Position error [m] at the end of a trial beyond which it has diverged."""


def evaluate(results: TrialResult) -> Metrics:
    """Errors over all scans with ground truth, with the keys of `metrics.json`.

    The key `nees` is NEES per degree of freedom (`nees_per_dof`), 1 for a consistent filter. A
    trial has diverged when its position error at the last such scan exceeds `DIVERGED_DISTANCE` or
    is not finite. Trials with values that are not finite count as diverged, are also counted
    separately, and are left out of the means. Both kinds are listed by number; `replay_trial`
    repeats a trial by its number.

    Args:
        results: [B] trials of T scans, NumPy or JAX.

    Raises:
        ValueError: There is no trial or no scan, or arrays do not fit each other.
    """
    arrays = _checked(results)
    good = arrays.finite & np.all(np.isfinite(arrays.estimate), axis=(1, 2))
    poses = arrays.estimate, arrays.dead_reckoning, arrays.truth, arrays.cov
    error, drift, values = (np.asarray(x) for x in _errors(*poses))
    diverged = np.flatnonzero(~good | _far(error, arrays.truth_mask))
    # Until the first motion the pose is certain, and NEES is not defined.
    certain = np.trace(arrays.cov, axis1=-2, axis2=-1) < CERTAIN_TRACE
    evaluated = good[:, None] & arrays.truth_mask
    has_nees = evaluated & ~certain & np.isfinite(values)
    mean_nees = float(nees_per_dof(np.mean(values[has_nees]))) if has_nees.any() else None
    return {
        "runs": len(error),
        "scans": int(arrays.num_steps.sum()),
        **rmse_of(error[evaluated]),
        "nees": mean_nees,
        "diverged": len(diverged),
        "diverged_runs": diverged.tolist(),
        "nonfinite": int(np.sum(~good)),
        "nonfinite_runs": np.flatnonzero(~good).tolist(),
        "landmarks": float(np.mean(arrays.num_landmarks)),
        "matches": float(arrays.num_updates.sum() / arrays.num_steps.sum()),
        "dead_reckoning": rmse_of(drift[evaluated])
        | {"diverged": int(_far(drift, arrays.truth_mask).sum())},
    }


@jax.jit  # one program instead of fifty of one operation each
def _errors(
    estimate: Array, dead_reckoning: Array, truth: Array, cov: Array
) -> tuple[Array, Array, Array]:
    """Errors (B, T, 3) of the estimate and of dead reckoning, and NEES (B, T)."""
    error = pose_error(estimate, truth)
    return error, pose_error(dead_reckoning, truth), nees(error, cov)


def _checked(results: TrialResult) -> Any:
    """The results as NumPy arrays; ValueError if they are none, empty, or differ in shape."""
    if not isinstance(results, TrialResult):
        raise ValueError(f"results is of type {type(results).__name__}, not TrialResult")
    arrays = TrialResult._make(map(np.asarray, results))
    check_array("results.truth", arrays.truth, ("B", "T", 3), jnp.floating)
    trials, scans = arrays.truth.shape[:2]
    if arrays.truth.size == 0:
        raise ValueError(f"results.truth is empty: {trials} trials of {scans} scans")
    for name, shape, kind in (
        ("estimate", (trials, scans, 3), jnp.floating),
        ("cov", (trials, scans, 3, 3), jnp.floating),
        ("dead_reckoning", (trials, scans, 3), jnp.floating),
        ("num_updates", (trials, scans), jnp.integer),
        ("num_landmarks", (trials,), jnp.integer),
        ("finite", (trials,), jnp.bool_),
        ("truth_mask", (trials, scans), jnp.bool_),
        ("num_steps", (trials,), jnp.integer),
    ):
        check_array(f"results.{name}", getattr(arrays, name), shape, kind)
    return arrays


def _far(error: np.ndarray, evaluated: np.ndarray) -> np.ndarray:
    """Trials (B,) bool whose position error at the last evaluated scan is too large, or NaN.

    Args:
        error: (B, T, 3) [m, m, rad] pose errors.
        evaluated: (B, T) bool scans with ground truth; trials without any are False.
    """
    last = evaluated.shape[1] - 1 - np.argmax(evaluated[:, ::-1], axis=1)
    distance = np.linalg.norm(error[np.arange(len(error)), last, :2], axis=-1)
    return evaluated.any(axis=1) & ~(distance <= DIVERGED_DISTANCE)


def rmse_of(error: np.ndarray) -> Metrics:
    """RMSE of position [m] and heading [deg] over pose errors (..., 3); None if there are none."""
    if error.size == 0:
        return {"position_rmse_m": None, "heading_rmse_deg": None}
    return {
        "position_rmse_m": float(np.sqrt(np.mean(np.sum(error[..., :2] ** 2, axis=-1)))),
        "heading_rmse_deg": float(np.degrees(np.sqrt(np.mean(error[..., 2] ** 2)))),
    }
