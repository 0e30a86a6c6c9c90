"""The odometry at each scan: the poses that stand with the scans, or the stream, interpolated."""

from os import PathLike
from typing import NamedTuple

import numpy as np

from jaxslam.core.time_series import interpolate_poses
from jaxslam.io.clocks import JoinedOdometry
from jaxslam.io.errors import InputError
from jaxslam.io.odometry_checks import (
    MIN_OVERLAP,
    CheckedOdometry,
    check_odometry,
    missing_spans,
    poses_are_corrected,
)
from jaxslam.io.raw_log import RawLog, stamps_of


class Track(NamedTuple):
    """Odometry of T of the scans, and the whole of it.

    Attributes:
        inside: (number of scans,) bool, which scans have odometry: T of them.
        poses: (T, 3) [m, m, rad].
        is_stale: (T,) bool, whether the increment to a scan is not to be trusted.
        stream_times: (N,) [s].
        stream_poses: (N, 3) [m, m, rad].
        usable: Whether there is any odometry; if not, the poses stand still.
    """

    inside: np.ndarray
    poses: np.ndarray
    is_stale: np.ndarray
    stream_times: np.ndarray
    stream_poses: np.ndarray
    usable: bool = True


def track_scans(
    path: str | PathLike, raw: RawLog, times: np.ndarray, joined: JoinedOdometry | None
) -> tuple[Track, list[str]]:
    """Odometry at the scans of a log.

    Args:
        path: The log, for errors.
        raw: Its content.
        times: (number of scans,) [s].
        joined: Its stream of odometry; None if it has none.

    Returns:
        The odometry at those scans that have it, and notes on what has been changed.

    Raises:
        InputError: There is odometry, but at no scan.
    """
    if raw.scan_poses is not None:
        return _track_with_poses(raw, raw.scan_poses, times, joined)
    if joined is None:
        return _standing(times), ["no odometry: the log has none"]
    checked = check_odometry(joined.times, joined.poses)
    if not checked.usable:
        return _standing(times), list(checked.notes)
    return _track_of_stream(path, joined, checked)


def _track_of_stream(
    path: str | PathLike, joined: JoinedOdometry, checked: CheckedOdometry
) -> tuple[Track, list[str]]:
    """Interpolate a stream at the scans within its time."""
    scan_axis, axis = joined.scan_axis, joined.axis
    inside = (scan_axis >= axis[0]) & (scan_axis <= axis[-1])
    if not inside.any():
        problem = f"none of the {len(inside)} scans lies within the time of the odometry"
        raise InputError(problem, path=path, advice="name a log of scans with their odometry")
    notes = [*joined.notes, *checked.notes]
    if not inside.all():
        before, after = int(np.sum(scan_axis < axis[0])), int(np.sum(scan_axis > axis[-1]))
        parts = [f"{before} before it begins"] if before else []
        parts += [f"{after} after it ends"] if after else []
        notes.append(f"scans without odometry are left out: {', '.join(parts)}")
    missing = missing_spans(joined.times, checked.poses)
    if missing.any():
        longest = float(np.diff(joined.times)[missing].max())
        notes.append(
            f"odometry is missing ({int(missing.sum())} x, up to {longest:.1f} s): it is "
            "interpolated there"
        )
    is_stale = checked.is_stale.copy()
    is_stale[1:] |= missing
    poses = interpolate_poses(scan_axis[inside], axis, checked.poses)
    stale = _stale_scans(scan_axis[inside], axis, is_stale)
    return Track(inside, poses, stale, joined.times, checked.poses), notes


def _track_with_poses(
    raw: RawLog, scan_poses: np.ndarray, times: np.ndarray, joined: JoinedOdometry | None
) -> tuple[Track, list[str]]:
    """Odometry of scans that stand with poses.

    The stream replaces these where another program corrected them, or the odometry restarts.
    """
    inside = np.ones(len(times), bool)
    checked = check_odometry(times, scan_poses)
    notes = list(checked.notes)
    if joined is None:
        track = Track(inside, checked.poses, checked.is_stale, times, checked.poses, checked.usable)
        return track, notes
    stream = check_odometry(joined.times, joined.poses)
    corrected = raw.poses_may_be_corrected and _are_corrected(raw, scan_poses, joined)
    if stream.usable and (corrected or stream.restarts or not checked.usable):
        notes = [*joined.notes, *stream.notes]
        if corrected or not checked.usable:
            notes.append("poses of the scans are not odometry: ODOM lines are used instead")
        poses = interpolate_poses(joined.scan_axis, joined.axis, stream.poses)
        stale = _stale_scans(joined.scan_axis, joined.axis, stream.is_stale)
        return Track(inside, poses, stale, joined.times, stream.poses), notes
    stamps, stream_poses = raw.odometry.stamps, raw.odometry.poses
    stream_times = stamps.own
    if not np.array_equal(times, stamps_of(raw.scans).own):
        stream_times, stream_poses = joined.times, joined.poses
    return (
        Track(inside, checked.poses, checked.is_stale, stream_times, stream_poses, checked.usable),
        notes,
    )


def _are_corrected(raw: RawLog, scan_poses: np.ndarray, joined: JoinedOdometry) -> bool:
    """Whether poses differ from the odometry by time and by order: their clocks may differ."""
    if not poses_are_corrected(joined.scan_axis, scan_poses, joined.axis, joined.poses):
        return False
    scan_order, order = stamps_of(raw.scans).order, raw.odometry.stamps.order
    inside = (scan_order >= order[0]) & (scan_order <= order[-1])
    if inside.mean() < MIN_OVERLAP:
        return True
    return poses_are_corrected(scan_order, scan_poses, order, raw.odometry.poses)


def _standing(times: np.ndarray) -> Track:
    """Track of scans without odometry."""
    still, every = np.zeros((len(times), 3)), np.ones(len(times), bool)
    return Track(every, still, every, times, still, usable=False)


def _stale_scans(scan_axis: np.ndarray, axis: np.ndarray, is_stale: np.ndarray) -> np.ndarray:
    """Whether the increment to each scan overlaps a stale increment of the stream."""
    count = np.concatenate([[0], np.cumsum(is_stale)])
    low, high = np.minimum(scan_axis[:-1], scan_axis[1:]), np.maximum(scan_axis[:-1], scan_axis[1:])
    first = np.searchsorted(axis, low, side="right")
    last = np.searchsorted(axis, high, side="left").clip(0, len(axis) - 1)
    overlaps = count[last + 1] > count[np.minimum(first, last)]
    return np.concatenate([[False], overlaps])
