"""What a reader takes from a file, unchecked: scans, odometry and transforms, with their stamps.

Readers fill a `RawLog`; `assemble` makes a `LaserLog` of it, in the same manner for all formats.
"""

from typing import NamedTuple

import numpy as np

from jaxslam.core.logs import DEFAULT_RANGE_STD


class Stamps(NamedTuple):
    """When N messages were made and recorded.

    Attributes:
        own: (N,) float64 [s] stamps in the messages, by the clock of who made them.
        received: (N,) float64 [s] when they were recorded; NaN where the file does not say.
        order: (N,) places of the messages in the file.
    """

    own: np.ndarray
    received: np.ndarray
    order: np.ndarray


class RawScan(NamedTuple):
    """One scan as its sensor gave it.

    Attributes:
        time: [s] its own stamp.
        received: [s] when it was recorded; NaN if unknown.
        order: Place in the file.
        frame: Name of the scanner or of its frame.
        angle_min: [rad] direction of the first beam, frame of the scanner.
        angle_increment: [rad] from one beam to the next; below 0 if clockwise.
        range_max: [m] above 0; infinite if unknown.
        ranges: (R,) float64 [m], infinite where there is no return.
    """

    time: float
    received: float
    order: int
    frame: str
    angle_min: float
    angle_increment: float
    range_max: float
    ranges: np.ndarray


class RawOdometry(NamedTuple):
    """A stream of N poses.

    Attributes:
        stamps: When they were made.
        poses: (N, 3) float64 [m, m, rad], odometry frame.
    """

    stamps: Stamps
    poses: np.ndarray


class RawTransform(NamedTuple):
    """The pose of a frame in its parent frame, N times.

    Attributes:
        parent: Name of the parent frame.
        child: Name of the frame.
        stamps: (own, received, order) of each.
        values: Translation x y z [m] and quaternion x y z w of each.
    """

    parent: str
    child: str
    stamps: list[tuple[float, float, int]]
    values: list[tuple[float, ...]]


class RawLog(NamedTuple):
    """The content of a log.

    Attributes:
        scans: Scans in file order.
        odometry: Poses of `base_frame`; empty if the log has none, or in its transforms alone.
        base_frame: Frame that the odometry moves; "" if unknown.
        scan_poses: (len(scans), 3) [m, m, rad] poses by odometry that stand with the scans; None
            where there are none. They, too, are poses of `base_frame`.
        transforms: By (parent, child).
        names_frames: Whether the format has frames and transforms, so that a note is made of a
            missing one.
        source: Topics that were read, for messages.
        num_skipped: Number of broken lines or messages.
        notes: Remarks of the reader.
        range_std: [m] standard deviation of a range.
        mount: (3,) [m, m, rad] pose of the scanner on the robot, if the odometry is the scanner's.
        poses_may_be_corrected: Whether programs are known to write other poses than those of the
            odometry with the scans of this format.
    """

    scans: list[RawScan]
    odometry: RawOdometry
    base_frame: str = ""
    scan_poses: np.ndarray | None = None
    transforms: dict[tuple[str, str], RawTransform] = {}
    names_frames: bool = False
    source: str = ""
    num_skipped: int = 0
    notes: tuple[str, ...] = ()
    range_std: float = DEFAULT_RANGE_STD
    mount: np.ndarray | None = None
    poses_may_be_corrected: bool = False


def as_stamps(rows: list[tuple[float, float, int]]) -> Stamps:
    """Stamps of (own, received, order) rows."""
    own, received, order = np.array(rows, np.float64).reshape(-1, 3).T
    return Stamps(own.copy(), received.copy(), order.copy())


def as_odometry(rows: list[tuple[float, float, int, float, float, float]]) -> RawOdometry:
    """A stream of (own, received, order, x, y, heading) rows."""
    table = np.array(rows, np.float64).reshape(-1, 6)
    stamps = Stamps(table[:, 0].copy(), table[:, 1].copy(), table[:, 2].copy())
    return RawOdometry(stamps, table[:, 3:].copy())


def stamps_of(scans: list[RawScan]) -> Stamps:
    """Stamps of scans."""
    return as_stamps([(scan.time, scan.received, scan.order) for scan in scans])
