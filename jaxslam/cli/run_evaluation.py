"""How well the logs of a run are mapped: each log's scans in a map, and their errors."""

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxslam.core.logs import LaserLog, Relations
from jaxslam.core.se2_np import compose, relative
from jaxslam.core.time_series import match_times
from jaxslam.core.types import Metrics
from jaxslam.evaluation import log_errors
from jaxslam.evaluation.log_errors import Trajectory
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


def without_errors(drive: RecordedDrive) -> RecordedDrive:
    """The same log, without anything to evaluate it with."""
    return drive._replace(reference=None, relations=None, dead_reckoning={})


class DriveInMap(NamedTuple):
    """The scans of a log that are in a map.

    Attributes:
        rows: (N,) int their numbers among all scans of the run.
        log: The log of these scans alone.
        until: [s] time after which the map has no pose of the log; infinite if it has the last one.
        result: The result of these scans alone; of keyframes, only numbers and covariances.
        odometry: (N, 3) [m, m, rad] poses by the wheels, from the first pose in the map on.
    """

    rows: np.ndarray
    log: LaserLog
    until: float
    result: SlamResult
    odometry: np.ndarray


def drive_in_map(
    given: LogInput, result: SlamResult, drive: RecordedDrive, first_row: int
) -> DriveInMap:
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
    whole = len(own) > 0 and own[-1] + 1 == len(drive.log.times)
    until = np.inf if whole or not len(own) else float(log.times[-1])
    return DriveInMap(rows, log, until, of_drive, odometry)


def not_used(drive: RecordedDrive, here: DriveInMap) -> list[str]:
    """A note if there are references to scans of a log that are not in the map."""
    evaluated = drive.reference is not None or drive.relations is not None
    if not evaluated or len(here.rows) == len(drive.log.times):
        return []
    return [
        f"{drive.path}: {len(here.rows)} of its {len(drive.log.times)} scans are in this map, and "
        "only they are evaluated"
    ]


def errors_of(
    drive: RecordedDrive, here: DriveInMap, *, smooth: bool, at_start: bool
) -> tuple[Metrics, np.ndarray | None, list[str]]:
    """Errors of a log's trajectory, and of the filter if it was smoothed; those of its keyframes.

    Args:
        drive: The log.
        here: Its scans in the map.
        smooth: Whether trajectories are smoothed.
        at_start: Whether the map begins with this log, so that covariances are since its start.

    Returns:
        The errors; those of the keyframes (K, 3), if there is a reference with headings; and notes
        on what could not be evaluated, as nothing of it is in the map.
    """
    numbers: Metrics = {}
    log, result, error = here.log, here.result, None
    reference, relations, notes = drive.reference, drive.relations, []
    if relations is not None:
        relations = _known_times(here, relations)
        if not len(relations.t1):
            relations = None
            notes.append(f"{drive.path}: no relation lies in this map")
    if reference is not None and len(match_times(log.times, reference[0])) < 2:
        reference = None
        notes.append(f"{drive.path}: the reference has no two poses in this map")
    if reference is not None and log_errors.has_heading(reference) and at_start:
        error = log_errors.errors_since_start(log.times, result.online_poses, reference)
        error = error[result.keyframes]
        numbers["nees"] = log_errors.mean_nees_per_dof(error, np.asarray(result.info.pose_cov))
    if reference is not None or relations is not None:
        numbers |= log_errors.errors_against(log, result.poses, reference, relations)
        if smooth:
            numbers["filter"] = log_errors.errors_against(
                log, result.online_poses, reference, relations
            )
        dead_reckoning = drive.dead_reckoning
        if len(here.rows) < len(drive.log.times):
            dead_reckoning = log_errors.errors_against(log, here.odometry, reference, relations)
        numbers["dead_reckoning"] = dead_reckoning
    return numbers, error, notes


def _known_times(here: DriveInMap, relations: Relations) -> Relations:
    """The relations between times that have a pose: while a drive was broken there is none."""
    times, first = here.log.times, breaks_of(here.result)
    start, end = times[first - 1] + ROUNDING, times[first] - ROUNDING

    def unknown(wanted: np.ndarray) -> np.ndarray:
        in_break = ((wanted[:, None] > start[None]) & (wanted[:, None] < end[None])).any(axis=1)
        outside = (wanted < times.min() - ROUNDING) | (wanted > here.until + ROUNDING)
        return in_break | outside

    kept = ~(unknown(relations.t1) | unknown(relations.t2))
    return Relations(*(x[kept] for x in relations))


def breaks_of(result: SlamResult) -> np.ndarray:
    """Indices of the first scans of pieces, without that of the first one."""
    return np.flatnonzero(np.diff(result.piece)) + 1
