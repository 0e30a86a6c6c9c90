"""From what a reader found in a file to a log: time, odometry, mount and beams, in this order."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from os import PathLike
from typing import NamedTuple

import numpy as np

from jaxslam.core.logs import DEFAULT_RANGE_MAX, LaserLog, mark_no_return
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import compose
from jaxslam.io import clocks
from jaxslam.io.beam_grid import are_usual, to_grid
from jaxslam.io.errors import InputError, check_range_max
from jaxslam.io.mounts import Mount, find_mount, frame_name, odometry_of_transforms
from jaxslam.io.raw_log import RawLog, RawScan, stamps_of
from jaxslam.io.scan_odometry import track_scans
from jaxslam.io.scan_rotation import compare_rotations

MAX_NAMED = 5  # other scanners that a note names


class LogOptions(NamedTuple):
    """What a user says of a log, where the log does not or is wrong.

    Attributes:
        range_max: Range [m] from which on a reading counts as no return, unless the scanner's own
            range_max is smaller.
        mount: Pose (x, y, yaw) [m, m, rad] of the scanner on the robot; replaces the transforms.
        upside_down: Whether the scanner is mounted upside down; replaces the transforms.
        scan_frame: Frame of the scans to read.
        base_frame: Frame of the robot, which the odometry moves.
        odom_frame: Frame of the odometry.
        angle_increment: Step [rad] between beams; replaces that of the scans.
    """

    range_max: float = DEFAULT_RANGE_MAX
    mount: Sequence[float] | None = None
    upside_down: bool = False
    scan_frame: str | None = None
    base_frame: str | None = None
    odom_frame: str | None = None
    angle_increment: float | None = None


def check_options(options: LogOptions) -> None:
    """Raise InputError, naming the option, unless all values are possible."""
    check_range_max(options.range_max, infinite=True)
    if options.mount is not None:
        mount = np.asarray(options.mount)
        if mount.shape != (3,) or mount.dtype.kind not in "fiu" or not np.isfinite(mount).all():
            advice = "give x y [m] and yaw [rad] of the scanner on the robot"
            raise InputError(f"{options.mount!r} is no pose", field="mount", advice=advice)
        if abs(mount[2]) > 2 * math.pi:
            advice = "give the yaw in radians"
            raise InputError(f"a yaw of {mount[2]:g} is no angle", field="mount", advice=advice)
    step = options.angle_increment
    if step is not None and not 1e-4 < step < math.pi:
        advice = "give the angle between two beams"
        raise InputError(f"{step!r} rad is no step", field="angle_increment", advice=advice)


def assemble(path: str | PathLike, raw: RawLog, options: LogOptions) -> LaserLog:
    """The log of a file, with notes on all that is not as the file has it.

    Args:
        path: The file, for errors.
        raw: What a reader found in it.
        options: What the user says of it, as `check_options` accepts it.

    Raises:
        InputError: There is no scan, or none with odometry where the log has some; a frame is not
            found; or transforms do not join the scanner with the robot.
    """
    raw, notes = _one_scanner(path, raw, options.scan_frame)
    usual = are_usual(raw.scans)
    if not usual.all():
        raw = _select(raw, usual)
        notes.append(f"scans with another step between beams are left out: {int((~usual).sum())}")
    frame = raw.scans[0].frame
    raw, more = _with_odometry(path, raw, frame, options)
    notes += more
    mount, more = _mount(path, raw, frame, options)
    raw = _on_scanner(raw, mount.pose)
    notes += more
    times, more = clocks.scan_times(stamps_of(raw.scans), raw.scan_poses)
    notes += more
    ranges, grid, more = to_grid(
        raw.scans, upside_down=mount.upside_down, angle_increment=options.angle_increment
    )
    notes += more
    joined = None
    if len(raw.odometry.poses):
        joined = clocks.join(stamps_of(raw.scans), times, raw.odometry)
        if raw.scan_poses is None:
            joined = _on_one_clock(joined, ranges, grid.angle_increment)
            times = joined.scan_times
    track, more = track_scans(path, raw, times, joined)
    notes += more
    if not track.inside.all():
        raw, ranges = _select(raw, track.inside), ranges[track.inside]
    range_max = _range_max(path, raw.scans, options.range_max)
    lidar = Lidar(*grid, range_max, raw.range_std)
    ranges = mark_no_return(ranges, range_max)
    notes += _emptiness(ranges, range_max)
    return LaserLog(
        times=times[track.inside],
        odom_poses=track.poses,
        ranges=ranges,
        lidar=lidar,
        num_skipped=raw.num_skipped,
        odom_stream_times=track.stream_times,
        odom_stream_poses=track.stream_poses,
        source=raw.source,
        notes=tuple(notes),
        has_odometry=track.usable,
        odometry_guessed=track.is_stale,
        mount=mount.pose if raw.mount is None or mount.pose.any() else raw.mount,
        frames=(raw.base_frame, frame) if raw.names_frames else ("", ""),
    )


def read_assembled(
    path: str | PathLike, read_raw: Callable[[str | PathLike], RawLog], *, range_max: float
) -> LaserLog:
    """Read the log of a file, of which the user says nothing but this.

    Args:
        path: The file.
        read_raw: The reader of its format.
        range_max: As of `LogOptions`.

    Raises:
        InputError: `range_max` is not positive, or as `read_raw` and `assemble`.
    """
    options = LogOptions(range_max=range_max)
    check_options(options)
    return assemble(path, read_raw(path), options)


def _one_scanner(
    path: str | PathLike, raw: RawLog, scan_frame: str | None
) -> tuple[RawLog, list[str]]:
    """The scans of one frame: the one named, or the one with most scans."""
    counts = Counter(scan.frame for scan in raw.scans)
    if not counts:
        raise InputError("has no scans", path=path, advice="name a log that holds laser scans")
    chosen = max(sorted(counts), key=counts.__getitem__)
    if scan_frame is not None:
        chosen = frame_name(scan_frame)
        if chosen not in counts:
            problem = f"there are no scans of the frame {chosen!r}"
            advice = f"frames of the scans: {', '.join(map(repr, sorted(counts)))}"
            raise InputError(problem, path=path, field="scan_frame", advice=advice)
    if len(counts) == 1:
        return raw, list(raw.notes)
    keep = np.array([scan.frame == chosen for scan in raw.scans])
    others = ", ".join(
        f"{name!r} ({count})" for name, count in counts.most_common(MAX_NAMED + 1) if name != chosen
    )
    note = f"scans of {chosen!r} are used, not those of {others}; --scan-frame chooses"
    one = _select(raw, keep)._replace(num_skipped=raw.num_skipped)
    return one, [*raw.notes, note]


def _select(raw: RawLog, keep: np.ndarray) -> RawLog:
    """The log with some of its scans; the others count as skipped."""
    scans = [scan for scan, use in zip(raw.scans, keep, strict=True) if use]
    poses = None if raw.scan_poses is None else raw.scan_poses[keep]
    skipped = raw.num_skipped + len(raw.scans) - len(scans)
    return raw._replace(scans=scans, scan_poses=poses, num_skipped=skipped)


def _with_odometry(
    path: str | PathLike, raw: RawLog, frame: str, options: LogOptions
) -> tuple[RawLog, list[str]]:
    """The log with its odometry, which may be in its transforms, and the frame that this moves."""
    notes: list[str] = []
    wanted = options.odom_frame
    if raw.transforms and (not len(raw.odometry.poses) or wanted is not None):
        found, base_frame, notes = odometry_of_transforms(path, raw.transforms, frame, wanted)
        if found is not None:
            raw = raw._replace(odometry=found, base_frame=base_frame)
    if options.base_frame is not None:
        raw = raw._replace(base_frame=frame_name(options.base_frame))
    return raw, notes


def _mount(
    path: str | PathLike, raw: RawLog, frame: str, options: LogOptions
) -> tuple[Mount, list[str]]:
    """Mount of the scanner: as the user says, or by the transforms, or none."""
    if options.mount is not None:
        pose = np.asarray(options.mount, np.float64)
        notes = ["mount of the scanner is as given, not by transforms"] if raw.transforms else []
        return Mount(pose, options.upside_down), notes
    if not raw.transforms and not raw.names_frames:
        return Mount(np.zeros(3), options.upside_down), []
    if raw.transforms or len(raw.odometry.poses):
        mount, notes = find_mount(path, raw.transforms, frame, raw.base_frame, options.odom_frame)
    else:
        mount, notes = Mount(np.zeros(3), False), []
    return (mount._replace(upside_down=True) if options.upside_down else mount), notes


def _on_one_clock(
    joined: clocks.JoinedOdometry, ranges: np.ndarray, step: float
) -> clocks.JoinedOdometry:
    """The scans, moved in time to the odometry if the turns of both say so."""
    if not joined.is_time:
        return joined
    behind, notes = compare_rotations(
        joined.scan_axis, ranges, step, joined.axis, joined.poses[:, 2]
    )
    return joined._replace(
        scan_times=joined.scan_times + behind,
        scan_axis=joined.scan_axis + behind,
        notes=(*joined.notes, *notes),
    )


def _on_scanner(raw: RawLog, mount: np.ndarray) -> RawLog:
    """The log with the poses of a scanner that is mounted on what the odometry moves."""
    if not mount.any():
        return raw
    odometry = raw.odometry._replace(poses=compose(raw.odometry.poses, mount))
    scan_poses = None if raw.scan_poses is None else compose(raw.scan_poses, mount)
    return raw._replace(odometry=odometry, scan_poses=scan_poses)


def _range_max(path: str | PathLike, scans: list[RawScan], limit: float) -> float:
    """The limit, or the largest range that the scanner states, if that is smaller."""
    stated = [scan.range_max for scan in scans if math.isfinite(scan.range_max)]
    range_max = min(limit, max(stated, default=math.inf))
    if math.isinf(range_max):
        problem = f"range_max {limit!r} is not a length [m], and the log states none"
        raise InputError(problem, path=path, advice="give a positive number of metres")
    return float(range_max)


def _emptiness(ranges: np.ndarray, range_max: float) -> list[str]:
    """A note if there is nothing to work with."""
    if not np.isfinite(ranges).any():
        return [f"no scan has a return below {range_max:g} m: the map will be empty"]
    return ["there is one scan only"] if len(ranges) == 1 else []
