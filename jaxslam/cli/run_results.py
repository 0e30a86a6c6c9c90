"""What `jaxslam run` writes of a map: the numbers, the files and the figures."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.cli import report
from jaxslam.core.logs import LaserLog, Relations
from jaxslam.core.measurement import Measurement
from jaxslam.core.se2_np import compose, relative, trajectories_as_one
from jaxslam.evaluation import log_errors, map_consistency
from jaxslam.evaluation.log_errors import Trajectory
from jaxslam.evaluation.summary import Metrics
from jaxslam.filtering.config import confirmed
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import tum
from jaxslam.io.annotated_map import AnnotatedMap
from jaxslam.mapping.saved_map import SavedMap
from jaxslam.pipeline.log_input import LogInput
from jaxslam.pipeline.results import SlamResult

ROUNDING = 1e-3  # [s] of written times


class RecordedDrive(NamedTuple):
    """One of the logs of a run.

    Attributes:
        path: Its file.
        log: What it holds.
        reference: Reference trajectory, if there is one.
        relations: Verified relative poses, if there are any.
        dead_reckoning: Errors of its odometry.
    """

    path: Path
    log: LaserLog
    reference: Trajectory | None
    relations: Relations | None
    dead_reckoning: Metrics


class RunContext(NamedTuple):
    """What all maps of a run have in common.

    Attributes:
        drives: The logs, in the order of their scans in `given`.
        given: All of them as input of SLAM.
        params: Q and R of the filter.
        smooth: Whether trajectories are smoothed.
        of_base: Whether trajectory.tum holds poses of the robot, not of the scanner.
        gif: Whether an animation is written.
        saved_map: The map that the run goes on in, if any.
        annotated_map: Its map.geojson, with what a user added.
    """

    drives: tuple[RecordedDrive, ...]
    given: LogInput
    params: NoiseParams
    smooth: bool
    of_base: bool
    gif: bool
    saved_map: SavedMap | None = None
    annotated_map: AnnotatedMap | None = None


def without_errors(drive: RecordedDrive) -> RecordedDrive:
    """The same log, without anything to evaluate it with."""
    return drive._replace(reference=None, relations=None, dead_reckoning={})


class _DriveInMap(NamedTuple):
    """The scans of a log that are in a map.

    Attributes:
        rows: (N,) int their numbers among all scans of the run.
        log: The log of these scans alone.
        result: The result of these scans alone; of keyframes, only numbers and covariances.
        odometry: (N, 3) [m, m, rad] poses by the wheels, from the first pose in the map on.
    """

    rows: np.ndarray
    log: LaserLog
    result: SlamResult
    odometry: np.ndarray


def write(
    context: RunContext, result: SlamResult, out_dir: Path, extra: Metrics
) -> tuple[Metrics, int]:
    """Write all files of a map.

    Args:
        context: Of the run.
        result: The map, of all scans or of a part of them.
        out_dir: Folder to write to.
        extra: Numbers in addition.

    Returns:
        The numbers of metrics.json, and how many parts of the run contradict the map.
    """
    given = context.given
    config, scans = given.config, given.scans
    consistency = map_consistency.check_map(
        config.frontend.lidar, result.poses, scans, piece=result.piece
    )
    own = np.flatnonzero(np.isfinite(result.poses).all(axis=1))
    numbers: Metrics = extra | {
        "scans": len(own),
        "keyframes": len(result.keyframes),
        "landmarks": int(np.sum(confirmed(config.filter, result.belief))),
        "matches": float(np.mean(np.sum(np.asarray(result.info.used), axis=1))),
        "closures": len(result.loop_closures.first) if result.loop_closures else 0,
        "map_consistency": consistency.metrics(),
    }
    several, path_length, first_row = len(context.drives) > 1, 0.0, 0
    lines: dict[str, list[np.ndarray]] = {"odometry": [], "reference": []}
    errors = np.full((len(result.keyframes), 3), np.nan)
    for number, drive in enumerate(context.drives):
        here = _drive_in_map(given, result, drive, first_row)
        first_row += len(drive.log.times)
        if not len(here.rows):
            continue
        path = here.result.poses if given.match_scans else here.odometry
        length = sum(log_errors.path_length(x) for x in np.split(path, _breaks(here.result)))
        path_length += length
        at_start = number == 0 and result.saved_poses is None
        about, error = _errors(context, drive, here, at_start=at_start)
        if error is not None:
            errors[np.isin(result.keyframes, here.rows)] = error
        if several:
            numbers.setdefault("drives", []).append(
                {"log": str(drive.path), "scans": len(here.rows), "path_length_m": length} | about
            )
        else:
            numbers |= about
        suffix = f".{number + 1}" if several else ""
        poses = here.result.poses
        if context.of_base:
            base = relative(drive.log.mount, np.zeros(3))  # the robot in the scanner's frame
            poses = compose(poses, base)
        tum.write(out_dir / f"trajectory{suffix}.tum", here.log.times, poses)
        lines["odometry"].append(here.odometry)
        if drive.reference is not None:
            lines["reference"].append(
                log_errors.reference_in_map(here.log.times, here.result.poses, drive.reference)
            )
    numbers["path_length_m"] = path_length
    saved, old = context.saved_map, context.annotated_map
    if result.saved_poses is None:  # a map of its own
        saved, old = None, None
    next_id = int(result.belief.next_id)
    report.write_results(out_dir, numbers, result.topological_map, old, next_id)
    measurements = Measurement(
        jnp.asarray(result.odometry, float), result.features, scan_match=result.scan_matches
    )
    config = config._replace(  # the map has grown to its size, which the files are made for
        filter=config.filter._replace(max_landmarks=result.belief.num_seen.size)
    )
    of_keyframes = jax.tree.map(lambda x: x[result.keyframes], scans)
    times = np.concatenate([drive.log.times for drive in context.drives])[result.keyframes]
    report.write_maps(
        out_dir, config, context.params, result, measurements, times, of_keyframes, saved
    )
    bounds = [(warning.first_scan, warning.last_scan) for warning in consistency.warnings]
    report.draw(
        out_dir,
        config,
        result,
        {what: trajectories_as_one(line) for what, line in lines.items() if line},
        errors if np.isfinite(errors).any() else None,
        scans=of_keyframes,
        saved_scans=None if saved is None else saved.scans,
        wrong=bounds,
    )
    if context.gif:
        from jaxslam.viz import animation  # imported here, because matplotlib is slow to import

        at = np.searchsorted(own, result.keyframes)
        animation.animate_run(
            out_dir / "run.gif",
            config,
            context.params,
            measurements,
            of_keyframes,
            result.poses[result.keyframes],
            np.concatenate(lines["odometry"])[at],
        )
    return numbers, len(consistency.warnings)


def _drive_in_map(
    given: LogInput, result: SlamResult, drive: RecordedDrive, first_row: int
) -> _DriveInMap:
    """The scans of a log that are in a map.

    Args:
        given: All logs of the run.
        result: The map.
        drive: The log.
        first_row: Number of its first scan among those of all logs.
    """
    log = drive.log
    of_log = slice(first_row, first_row + len(log.times))
    own = np.flatnonzero(np.isfinite(result.poses[of_log]).all(axis=1))
    rows = first_row + own
    if len(own) < len(log.times):
        log = log._replace(
            times=log.times[own], odom_poses=log.odom_poses[own], ranges=log.ranges[own]
        )
    of_keyframes = np.isin(result.keyframes, rows)
    of_drive = result._replace(
        poses=result.poses[rows],
        online_poses=result.online_poses[rows],
        keyframes=np.searchsorted(rows, result.keyframes[of_keyframes]),
        info=jax.tree.map(lambda x: np.asarray(x)[of_keyframes], result.info),
        piece=result.piece[rows],
    )
    odometry = given.odom_poses[rows]
    if len(rows):
        odometry = compose(result.poses[rows[0]], relative(odometry[0], odometry))
    return _DriveInMap(rows, log, of_drive, odometry)


def _errors(
    context: RunContext, drive: RecordedDrive, here: _DriveInMap, *, at_start: bool
) -> tuple[Metrics, np.ndarray | None]:
    """Errors of a log's trajectory, and of the filter if it was smoothed; and of its keyframes.

    Args:
        context: Of the run.
        drive: The log.
        here: Its scans in the map.
        at_start: Whether the map begins with this log, so that covariances are since its start.
    """
    numbers: Metrics = {}
    log, result, error = here.log, here.result, None
    reference, relations = drive.reference, drive.relations
    if relations is not None:
        relations = _known_times(log, result, relations)
    if reference is not None and log_errors.has_heading(reference) and at_start:
        error = log_errors.errors_since_start(log.times, result.online_poses, reference)
        error = error[result.keyframes]
        numbers["nees"] = log_errors.mean_nees_per_dof(error, np.asarray(result.info.pose_cov))
    if reference is not None or relations is not None:
        numbers |= log_errors.errors_against(log, result.poses, reference, relations)
        if context.smooth:
            numbers["filter"] = log_errors.errors_against(
                log, result.online_poses, reference, relations
            )
    if drive.dead_reckoning:
        numbers["dead_reckoning"] = drive.dead_reckoning
    return numbers, error


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
