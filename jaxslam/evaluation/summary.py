"""Errors of many trials summed up, with the keys of `metrics.json`."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.evaluation.consistency import nees, pose_error
from jaxslam.pipeline.episodes import TrialResult


def evaluate(results: TrialResult) -> dict:
    """Errors over all scans with ground truth, with the keys of `metrics.json`.

    `nees` is NEES per degree of freedom (divided by 3), 1 for a consistent filter. A trial has
    diverged when its position error at the last such scan exceeds 1 m or is not finite. Trials
    with values that are not finite count as diverged, are also counted separately, and are left
    out of the means. Both kinds are listed by number; `replay_trial` repeats a trial by its number.
    """
    results = jax.tree.map(np.asarray, results)
    good = results.finite & np.all(np.isfinite(results.estimate), axis=(1, 2))
    error = np.asarray(pose_error(jnp.asarray(results.estimate), jnp.asarray(results.truth)))
    drift = np.asarray(pose_error(jnp.asarray(results.dead_reckoning), jnp.asarray(results.truth)))
    diverged = np.flatnonzero(~good | _far(error, results.truth_mask))
    # Until the first motion the pose is certain, and NEES is not defined.
    ratio = np.asarray(nees(jnp.asarray(error), jnp.asarray(results.cov)))
    certain = np.trace(results.cov, axis1=-2, axis2=-1) < 1e-12
    evaluated = good[:, None] & results.truth_mask
    has_nees = evaluated & ~certain & np.isfinite(ratio)
    return {
        "runs": len(error),
        "scans": int(results.num_steps.sum()),
        **rmse_of(error[evaluated]),
        "nees": float(np.mean(ratio[has_nees]) / 3) if has_nees.any() else None,
        "diverged": len(diverged),
        "diverged_runs": diverged.tolist(),
        "nonfinite": int(np.sum(~good)),
        "nonfinite_runs": np.flatnonzero(~good).tolist(),
        "landmarks": float(np.mean(results.num_landmarks)),
        "matches": float(results.num_updates.sum() / results.num_steps.sum()),
        "dead_reckoning": rmse_of(drift[evaluated])
        | {"diverged": int(_far(drift, results.truth_mask).sum())},
    }


def _far(error: np.ndarray, evaluated: np.ndarray) -> np.ndarray:
    """Trials (B,) bool with a position error above 1 m, or none, at the last evaluated scan.

    Args:
        error: (B, T, 3) [m, m, rad] pose errors.
        evaluated: (B, T) bool scans with ground truth; trials without any are False.
    """
    last = evaluated.shape[1] - 1 - np.argmax(evaluated[:, ::-1], axis=1)
    distance = np.linalg.norm(error[np.arange(len(error)), last, :2], axis=-1)
    return evaluated.any(axis=1) & ~(distance <= 1.0)


def rmse_of(error: np.ndarray) -> dict:
    """RMSE of position [m] and heading [deg] over pose errors (..., 3); None if there are none."""
    if error.size == 0:
        return {"position_rmse_m": None, "heading_rmse_deg": None}
    return {
        "position_rmse_m": float(np.sqrt(np.mean(np.sum(error[..., :2] ** 2, axis=-1)))),
        "heading_rmse_deg": float(np.degrees(np.sqrt(np.mean(error[..., 2] ** 2)))),
    }
