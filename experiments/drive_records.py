"""What a robot writes down on a drive, and CARMEN logs of it."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments import damaged_drives
from jaxslam.core.logs import DEFAULT_RANGE_MAX, LaserLog, mark_no_return
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import increments
from jaxslam.io.carmen import half_circle_lidar

NO_RETURN = 81.91  # [m] which FLASER lines hold where nothing returns
SPEED, MIN_STEP = 0.5, 0.1  # [m/s], [s] of simulated robots
START = 1.2e9  # [s] of their clock


class DriveRecord(NamedTuple):
    """What a robot wrote down: T scans and N odometry messages.

    Attributes:
        number: (T,) int numbers of the scans in the log without fault.
        stamps: (T,) float64 [s] of the scans.
        odom_poses: (T, 3) [m, m, rad] poses of the scanner by odometry.
        ranges: (T, R) [m], whole millimetres; infinite where nothing returns.
        lidar: The scanner.
        stream_stamps: (N,) float64 [s] of the odometry messages between the scans; N may be 0.
        stream_poses: (N, 3) [m, m, rad] of these.
        order: (N + T,) int order in the file of first the messages, then the scans.
    """

    number: np.ndarray
    stamps: np.ndarray
    odom_poses: np.ndarray
    ranges: np.ndarray
    lidar: Lidar
    stream_stamps: np.ndarray
    stream_poses: np.ndarray
    order: np.ndarray

    @classmethod
    def of_log(cls, log: LaserLog) -> "DriveRecord":
        """The recording of a log that is as it should be."""
        scans = _of_scans(
            np.arange(len(log.times)), log.times, log.odom_poses, log.ranges, log.lidar
        )
        if np.array_equal(log.odom_stream_times, log.times):
            return scans
        both = [np.maximum.accumulate(x) for x in (log.odom_stream_times, log.times)]
        return scans._replace(
            stream_stamps=log.odom_stream_times,
            stream_poses=log.odom_stream_poses,
            order=np.argsort(np.concatenate(both), kind="stable"),
        )

    @classmethod
    def of_drive(cls, rng: np.random.Generator, drive: damaged_drives.Drive) -> "DriveRecord":
        """The recording of a simulated drive, with the odometry of wheels that drift."""
        wheels = damaged_drives.wheels(rng, drive.poses).poses
        moved = np.hypot(*increments(drive.poses)[:, :2].T)
        stamps = START + np.cumsum(np.maximum(MIN_STEP, moved / SPEED))
        range_max = min(drive.lidar.range_max, DEFAULT_RANGE_MAX)
        ranges = np.where(drive.scans.hit, drive.scans.ranges, np.inf)
        lidar = drive.lidar._replace(range_max=range_max)
        return _of_scans(np.arange(len(wheels)), stamps, wheels, ranges, lidar)


def _of_scans(
    number: np.ndarray, stamps: np.ndarray, poses: np.ndarray, ranges: np.ndarray, lidar: Lidar
) -> DriveRecord:
    ranges = mark_no_return(np.round(ranges.astype(np.float64), 3), lidar.range_max)
    none = np.zeros((0, 3))
    return DriveRecord(
        number, stamps, poses, ranges, lidar, none[:, 0], none, np.arange(len(number))
    )


def write(path: Path, recording: DriveRecord) -> None:
    """Write a CARMEN log, of FLASER lines where these can describe the scanner."""
    usual = half_circle_lidar(recording.lidar.num_beams, DEFAULT_RANGE_MAX)
    own = recording.lidar
    known = np.allclose(own[1:4], usual[1:4], atol=1e-6)
    num_messages = len(recording.stream_stamps)
    with path.open("w", encoding="ascii") as file:
        for line in recording.order.tolist():
            if line < num_messages:
                pose, stamp = recording.stream_poses[line], recording.stream_stamps[line]
                file.write(f"ODOM {_text(pose)} 0 0 0 {_tail(stamp)}\n")
                continue
            scan = line - num_messages
            pose, stamp = _text(recording.odom_poses[scan]), _tail(recording.stamps[scan])
            ranges = recording.ranges[scan]
            no_return = NO_RETURN if known else own.range_max
            numbers = " ".join(f"{x:.3f}" for x in np.where(np.isfinite(ranges), ranges, no_return))
            count = len(ranges)
            if known:
                file.write(f"FLASER {count} {numbers} {pose} {pose} {stamp}\n")
            else:
                field = own.angle_increment * (count - 1)
                form = f"{own.angle_min:.9f} {field:.9f} {own.angle_increment:.12f}"
                form += f" {own.range_max:.3f} 0.01 0 {count}"
                file.write(f"ROBOTLASER1 0 {form} {numbers} 0 {pose} {pose} 0 0 0 0 0 {stamp}\n")


def _text(pose: np.ndarray) -> str:
    return " ".join(f"{x:.6f}" for x in pose)


def _tail(stamp: float) -> str:
    """Time, host and time of logging."""
    return f"{stamp:.6f} robot {stamp:.6f}"


def numbers_of(recording: DriveRecord, log: LaserLog) -> np.ndarray:
    """Numbers (K,) of the K scans of a log that a reader made of the recording.

    A reader may leave out scans, but not change their order: they are known by their ranges.

    Raises:
        ValueError: The log has a scan that is not in the recording.
    """
    if len(log.times) == len(recording.number):
        return recording.number
    written = mark_no_return(recording.ranges, log.lidar.range_max)
    numbers, scan = [], 0
    for ranges in log.ranges:
        while scan < len(written) and not np.allclose(written[scan], ranges, atol=1e-3):
            scan += 1
        if scan == len(written):
            raise ValueError(f"scan {len(numbers)} of the log is not in the recording")
        numbers.append(recording.number[scan])
        scan += 1
    return np.array(numbers, int)
