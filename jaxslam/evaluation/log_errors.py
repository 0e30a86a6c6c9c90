"""Errors of the estimated poses of a log, with the keys of `metrics.json`."""

import jax
import numpy as np

from jaxslam.core import time_series
from jaxslam.core.batching import on_device
from jaxslam.core.logs import LaserLog, Relations
from jaxslam.core.se2_np import relative, wrap_angle
from jaxslam.core.types import Metrics
from jaxslam.evaluation import consistency, trajectory
from jaxslam.pipeline.episodes import TrialResult

NEED_HEADING = ("rpe_translation_rmse_m", "rpe_rotation_rmse_deg", "heading_rmse_deg")
"""Keys of errors that a reference without headings cannot give."""

Trajectory = tuple[np.ndarray, np.ndarray]
"""Times (N,) [s] and poses (N, 3) [m, m, rad]; headings are NaN if there are none."""


def pose_errors(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors (..., 3) [m, m, rad] of poses (..., 3), world frame; `pose_error` without JAX."""
    error = np.asarray(poses, np.float64) - np.asarray(truth, np.float64)
    error[..., 2] = wrap_angle(error[..., 2])
    return error


def has_heading(reference: Trajectory) -> bool:
    """Whether a reference has headings to compare with."""
    return bool(np.isfinite(reference[1][:, 2]).all())


def path_length(poses: np.ndarray) -> float:
    """Path length [m] of a trajectory (T, 3)."""
    return float(np.sum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))


def mean_ate(results: TrialResult) -> float | None:
    """ATE RMSE [m] over Monte-Carlo trials, each aligned on its own; None if none is finite."""
    stamps = np.arange(results.truth.shape[1])
    squares = [
        trajectory.ate(stamps, estimate, stamps, truth)["ate_rmse_m"] ** 2
        for estimate, truth in zip(results.estimate, results.truth, strict=True)
        if np.isfinite(estimate).all()
    ]
    return float(np.sqrt(np.mean(squares))) if squares else None


def against_reference(times: np.ndarray, poses: np.ndarray, reference: Trajectory) -> Metrics:
    """ATE, RPE and heading RMSE of poses (T, 3), after rigid alignment with a reference.

    RPE and heading are None for a reference without headings.
    """
    ref_times, ref_poses = reference
    ate = trajectory.ate(times, poses, ref_times, ref_poses)
    if not has_heading(reference):
        return ate | dict.fromkeys(NEED_HEADING)
    rpe = trajectory.rpe(times, poses, ref_times, ref_poses)
    i, j = time_series.match_times(times, ref_times).T
    frame = trajectory.align_trajectory(poses[i, :2], ref_poses[j, :2])
    turn = relative(relative(frame, ref_poses[j]), poses[i])[:, 2]
    return ate | rpe | {"heading_rmse_deg": float(np.degrees(np.sqrt(np.mean(turn**2))))}


_nees = jax.jit(consistency.nees)  # one program instead of thirty of one operation each


def mean_nees_per_dof(error: np.ndarray, cov: np.ndarray) -> float | None:
    """Mean NEES per degree of freedom (1 if consistent); None if there is no pose to evaluate.

    Args:
        error: (T, 3) [m, m, rad]; rows that are not finite are left out.
        cov: (T, 3, 3); a pose without uncertainty, such as the first, is left out.
    """
    uncertain = np.trace(cov, axis1=1, axis2=2) > consistency.CERTAIN_TRACE
    used = np.isfinite(error).all(axis=1) & uncertain
    values = _nees(*on_device((error[used], cov[used])))
    finite = np.asarray(values)[np.isfinite(values)]
    return float(consistency.nees_per_dof(float(finite.mean()))) if finite.size else None


def against_relations(laser_log: LaserLog, poses: np.ndarray, relations: Relations) -> Metrics:
    """Relation errors of poses (T, 3): deviations from verified relative poses."""
    errors = trajectory.relation_errors(
        laser_log.times, poses, laser_log.odom_stream_times, laser_log.odom_stream_poses, relations
    )
    return {"relations": errors}


def errors_against(
    laser_log: LaserLog,
    poses: np.ndarray,
    reference: Trajectory | None,
    relations: Relations | None,
) -> Metrics:
    """Evaluate poses (T, 3) with the reference and with the relations, where given."""
    numbers = {} if reference is None else against_reference(laser_log.times, poses, reference)
    return numbers | ({} if relations is None else against_relations(laser_log, poses, relations))


def reference_in_map(times: np.ndarray, poses: np.ndarray, reference: Trajectory) -> np.ndarray:
    """Reference poses (K, 3) in the map frame, after rigid alignment with poses (T, 3)."""
    ref_times, ref_poses = reference
    i, j = time_series.match_times(times, ref_times).T
    return relative(trajectory.align_trajectory(poses[i, :2], ref_poses[j, :2]), ref_poses[j])


def errors_since_start(times: np.ndarray, poses: np.ndarray, reference: Trajectory) -> np.ndarray:
    """Errors (T, 3) of poses after alignment at the first matched pose; NaN without reference."""
    ref_times, ref_poses = reference
    i, j = time_series.match_times(times, ref_times).T
    origin = np.zeros(3)
    frame = relative(relative(ref_poses[j[0]], origin), relative(poses[i[0]], origin))
    error = np.full(poses.shape, np.nan)
    error[i] = pose_errors(poses[i], relative(frame, ref_poses[j]))
    return error
