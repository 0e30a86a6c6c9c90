"""What `jaxslam run` writes of a map: the numbers, the files and the figures."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.cli import report
from jaxslam.core.logs import LaserLog, Relations
from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import compose, relative
from jaxslam.evaluation import log_errors, map_consistency
from jaxslam.evaluation.log_errors import Trajectory
from jaxslam.evaluation.summary import Metrics
from jaxslam.filtering.config import confirmed
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.log_input import LogInput
from jaxslam.pipeline.offline import SlamResult

ROUNDING = 1e-3  # [s] of written times


class RunContext(NamedTuple):
    """What all maps of a run have in common.

    Attributes:
        laser_log: The log.
        given: The same as input of SLAM.
        params: Q and R of the filter.
        reference: Reference trajectory, if there is one.
        relations: Verified relative poses, if there are any.
        dead_reckoning: Errors of the odometry of the whole log.
        smooth: Whether trajectories are smoothed.
        of_base: Whether trajectory.tum holds poses of the robot, not of the scanner.
        gif: Whether an animation is written.
    """

    laser_log: LaserLog
    given: LogInput
    params: NoiseParams
    reference: Trajectory | None
    relations: Relations | None
    dead_reckoning: Metrics
    smooth: bool
    of_base: bool
    gif: bool


def write(
    context: RunContext, result: SlamResult, out_dir: Path, extra: Metrics
) -> tuple[Metrics, int]:
    """Write all files of a map.

    Args:
        context: Of the run.
        result: The map, of all scans or of a part of them.
        out_dir: Folder to write to.
        extra: Numbers in addition, the first of metrics.json.

    Returns:
        The numbers of metrics.json, and how many parts of the run contradict the map.
    """
    lidar = context.given.config.frontend.lidar
    consistency = map_consistency.check_map(
        lidar, result.poses, context.given.scans, piece=result.piece
    )
    own = np.flatnonzero(np.isfinite(result.poses).all(axis=1))
    context, result = _only(context, result, own)
    laser_log, given = context.laser_log, context.given
    config, odom_poses, scans = given.config, given.odom_poses, given.scans
    path = result.poses if given.match_scans else odom_poses
    path_length = sum(log_errors.path_length(x) for x in np.split(path, _breaks(result)))
    numbers: Metrics = extra | {
        "scans": len(result.poses),
        "keyframes": len(result.keyframes),
        "path_length_m": path_length,
        "landmarks": int(np.sum(confirmed(config.filter, result.belief))),
        "matches": float(np.mean(np.sum(np.asarray(result.info.used), axis=1))),
        "closures": len(result.loop_closures.first) if result.loop_closures else 0,
    }
    numbers |= _errors(context, result)
    numbers["map_consistency"] = consistency.metrics()
    if context.dead_reckoning:
        numbers["dead_reckoning"] = context.dead_reckoning
    poses = result.poses
    if context.of_base:
        base = relative(laser_log.mount, np.zeros(3))  # the robot in the frame of the scanner
        poses = compose(np.asarray(result.poses, np.float64), base)
    report.write_results(out_dir, numbers, laser_log.times, poses, result.topological_map)
    measurements = Measurement(
        jnp.asarray(result.odometry, float), result.features, scan_match=result.scan_matches
    )
    config = config._replace(  # the map has grown to its size, which the files are made for
        filter=config.filter._replace(max_landmarks=result.belief.num_seen.size)
    )
    of_keyframes = _take(scans, result.keyframes)
    times = laser_log.times[result.keyframes]
    report.write_maps(out_dir, config, context.params, result, measurements, times, of_keyframes)
    trajectories, error = {"odometry": odom_poses}, None
    if context.reference is not None:
        trajectories["reference"] = log_errors.reference_in_map(
            laser_log.times, result.poses, context.reference
        )
        if log_errors.has_heading(context.reference):
            error = _online_errors(context, result, context.reference)
    bounds = [(warning.first_scan, warning.last_scan) for warning in consistency.warnings]
    wrong = [(int(a), int(b)) for a, b in np.searchsorted(own, bounds).reshape(-1, 2)]
    report.draw(out_dir, config, result, trajectories, error, scans=of_keyframes, wrong=wrong)
    if context.gif:
        from jaxslam.viz import animation  # imported here, because matplotlib is slow to import

        animation.animate_run(
            out_dir / "run.gif",
            config,
            context.params,
            measurements,
            of_keyframes,
            result.poses[result.keyframes],
            odom_poses[result.keyframes],
        )
    return numbers, len(consistency.warnings)


def _only(
    context: RunContext, result: SlamResult, own: np.ndarray
) -> tuple[RunContext, SlamResult]:
    """Log and result of some scans (N,) alone, which are numbered anew."""
    if len(own) == len(result.poses):
        return context, result
    given, log = context.given, context.laser_log
    first = given.odom_poses[own[0]]
    given = given._replace(
        odom_poses=compose(result.poses[own[0]], relative(first, given.odom_poses[own])),
        scans=_take(given.scans, own),
    )
    log = log._replace(times=log.times[own], odom_poses=log.odom_poses[own], ranges=log.ranges[own])
    result = result._replace(
        poses=result.poses[own],
        online_poses=result.online_poses[own],
        keyframes=np.searchsorted(own, result.keyframes),
        piece=result.piece[own],
    )
    return context._replace(laser_log=log, given=given), result


def _known_times(log: LaserLog, result: SlamResult, relations: Relations) -> Relations:
    """The relations between times that have a pose: while a drive was broken there is none."""
    first = _breaks(result)
    start, end = log.times[first - 1] + ROUNDING, log.times[first] - ROUNDING

    def unknown(times: np.ndarray) -> np.ndarray:
        return ((times[:, None] > start[None]) & (times[:, None] < end[None])).any(axis=1)

    kept = ~(unknown(relations.t1) | unknown(relations.t2))
    return Relations(*(x[kept] for x in relations))


def _breaks(result: SlamResult) -> np.ndarray:
    """Indices of the first scans of pieces, without that of the first one."""
    return np.flatnonzero(np.diff(result.piece)) + 1


def _take(scans: Scan, index: np.ndarray) -> Scan:
    """Scans [...] at indices (...)."""
    return jax.tree.map(lambda x: x[index], scans)


def _errors(context: RunContext, result: SlamResult) -> Metrics:
    """Errors of the trajectory, and of the filter if it was smoothed; none without a reference."""
    numbers: Metrics = {}
    log, reference, relations = context.laser_log, context.reference, context.relations
    if relations is not None:
        relations = _known_times(log, result, relations)
    if reference is not None and log_errors.has_heading(reference):
        error = _online_errors(context, result, reference)
        cov = np.asarray(result.info.pose_cov)
        numbers["nees"] = log_errors.mean_nees_per_dof(error, cov)
    if reference is not None or relations is not None:
        numbers |= log_errors.errors_against(log, result.poses, reference, relations)
        if context.smooth:
            numbers["filter"] = log_errors.errors_against(
                log, result.online_poses, reference, relations
            )
    return numbers


def _online_errors(context: RunContext, result: SlamResult, reference: Trajectory) -> np.ndarray:
    """Errors (K, 3) [m, m, rad] of the online estimates of keyframes since the first scan."""
    times, poses = context.laser_log.times, result.online_poses
    errors = log_errors.errors_since_start(times, poses, reference)
    return errors[result.keyframes]
