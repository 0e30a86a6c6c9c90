"""Logs with one fault that recorded logs have: in stamps, odometry, mount, scans or beams.

A fault is a pure function of a random generator and a `DriveRecord`. Scans keep their numbers, so
that they can be compared with a reference whatever their stamps are.
"""

import math
from collections.abc import Callable

import numpy as np

from experiments import damaged_drives
from experiments.drive_records import DriveRecord
from jaxslam.core.se2_np import compose, dead_reckoning, increments, relative, wrap_angle

UNHURT = "none"
CLOCK_SET_BACK = 600.0  # [s]
LATCHED = 0.06  # spans of latched odometry by scans
LATCHED_LENGTHS = (2, 3, 4)  # scans from a latched pose to the leap
LOST_TURNS, LOST_TURN = 4, 0.5  # turns that the wheels miss, and least size [rad] of each
LOST_APART = 30  # scans between two of these, at least
SLIP_LENGTH, SLIPPED = 4.0, 0.75  # [m] driven straight on, and share of it that the wheels miss
DISTANCE_SCALE, TURN_SCALE = 1.05, 0.96
MOUNT = (0.25, 0.0, math.radians(3.0))  # [m, m, rad] of the scanner on the robot
MISSING_BEAMS, BLOCK_OF_BEAMS = 0.3, (3, 12)
DROPPED_SCANS, BLOCK_OF_SCANS = 0.1, (1, 5)

Fault = Callable[[np.random.Generator, DriveRecord], DriveRecord]
StampFault = Callable[[np.random.Generator, np.ndarray], np.ndarray]
"""From stamps (L,) [s] of all lines in file order to those that are written."""


def zero(rng: np.random.Generator, stamps: np.ndarray) -> np.ndarray:
    """All stamps are zero."""
    return np.zeros_like(stamps)


def some_zero(rng: np.random.Generator, stamps: np.ndarray) -> np.ndarray:
    """A tenth of the stamps is zero."""
    return np.where(rng.random(len(stamps)) < 0.1, 0.0, stamps)


def constant(rng: np.random.Generator, stamps: np.ndarray) -> np.ndarray:
    """All stamps are equal, as if printed with six significant digits."""
    return np.full_like(stamps, float(f"{stamps[0]:.6g}"))


def coarse(rng: np.random.Generator, stamps: np.ndarray) -> np.ndarray:
    """Stamps are whole seconds."""
    return np.floor(stamps)


def back(rng: np.random.Generator, stamps: np.ndarray) -> np.ndarray:
    """Of the stamps, 3 % lie before those of earlier lines, by up to a second."""
    return stamps - np.where(rng.random(len(stamps)) < 0.03, rng.random(len(stamps)), 0.0)


def set_back(rng: np.random.Generator, stamps: np.ndarray) -> np.ndarray:
    """The clock is set back by ten minutes in mid-drive."""
    return stamps - np.where(np.arange(len(stamps)) < len(stamps) // 2, 0.0, CLOCK_SET_BACK)


def on_stamps(fault: StampFault) -> Fault:
    """The fault of a recording, scans and odometry, whose clock has a fault."""

    def hurt(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
        num_messages = len(recording.stream_stamps)
        stamps = np.concatenate([recording.stream_stamps, recording.stamps])
        stamps[recording.order] = fault(rng, stamps[recording.order])
        return recording._replace(stream_stamps=stamps[:num_messages], stamps=stamps[num_messages:])

    return hurt


def _with_poses(recording: DriveRecord, poses: np.ndarray) -> DriveRecord:
    """A recording with other odometry (T, 3), which stands with the scans alone."""
    none = np.zeros((0, 3))
    order = np.arange(len(poses))
    return recording._replace(
        odom_poses=poses, stream_stamps=none[:, 0], stream_poses=none, order=order
    )


def _with_increments(recording: DriveRecord, steps: np.ndarray) -> DriveRecord:
    return _with_poses(recording, dead_reckoning(recording.odom_poses[0], steps))


def _only(recording: DriveRecord, kept: np.ndarray) -> DriveRecord:
    """The recording with some of its scans, by index."""
    some = recording._replace(
        number=recording.number[kept],
        stamps=recording.stamps[kept],
        ranges=recording.ranges[kept],
    )
    return _with_poses(some, recording.odom_poses[kept])


def unsigned(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
    """The wheels give the speed without its sign: backwards is forwards."""
    steps = increments(recording.odom_poses)
    steps[:, 0] = np.abs(steps[:, 0])
    return _with_increments(recording, steps)


def draw_spans(
    rng: np.random.Generator, num_scans: int, count: int, lengths: tuple[int, ...]
) -> np.ndarray:
    """Spans (S, 2) of first and last scan; the next begins where one ends at the earliest.

    Args:
        rng: Decides on lengths and places.
        num_scans: Number of scans that they lie in.
        count: Number of spans, unless there is no place for all.
        lengths: Possible differences of last and first scan.
    """
    length = rng.choice(lengths, min(count, (num_scans - 1) // max(lengths)))
    free = num_scans - 1 - int(length.sum())
    start = np.sort(rng.integers(0, free + 1, len(length))) + np.cumsum(length) - length
    return np.stack([start, start + length], axis=1)


def latched(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
    """The odometry repeats an old pose for some scans, then leaps to the one that is right."""
    poses = recording.odom_poses.copy()
    count = max(1, round(LATCHED * len(poses)))
    for first, last in draw_spans(rng, len(poses), count, LATCHED_LENGTHS):
        poses[first:last] = poses[first]
    return _with_poses(recording, poses)


def lost(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
    """The wheels report nothing of some turns, each within three scans."""
    steps = increments(recording.odom_poses)
    turned = np.abs(wrap_angle(np.convolve(steps[:, 2], np.ones(3), "valid")))
    possible = rng.permutation(np.flatnonzero(turned >= min(LOST_TURN, turned.max())))
    chosen: list[int] = []
    for k in possible.tolist():
        if len(chosen) < LOST_TURNS and all(abs(k - other) > LOST_APART for other in chosen):
            chosen.append(k)
            steps[k : k + 3] = 0.0
    return _with_increments(recording, steps)


def still(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
    """The odometry stands still, but for a millimetre at the start."""
    steps = np.zeros_like(recording.odom_poses)
    steps[1:2, 0] = 1e-3
    return _with_increments(recording, steps)


def carried(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
    """The robot is carried: the scans of that time are missing, and the wheels stand still."""
    num_scans = len(recording.number)
    gone = min(damaged_drives.CARRIED_SCANS, num_scans // 5)
    at = int(rng.integers(num_scans // 4, 3 * num_scans // 4 - gone))
    kept = np.delete(np.arange(num_scans), slice(at, at + gone))
    steps = increments(recording.odom_poses)[kept]
    steps[at] = 0.0
    return _with_increments(_only(recording, kept), steps)


def slipped(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
    """The wheels miss most of some metres straight on, and the scans of these are missing."""
    steps = increments(recording.odom_poses)
    driven = np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))
    turned = np.cumsum(np.abs(steps[:, 2]))
    length = min(SLIP_LENGTH, driven[-1] / 8)
    first = np.flatnonzero((driven > driven[-1] / 8) & (driven < driven[-1] * 7 / 8 - length))
    last = np.searchsorted(driven, driven[first] + length)
    straight = np.argsort(turned[last] - turned[first], kind="stable")
    chosen = int(rng.choice(straight[: 1 + len(first) // 10]))
    start, end = int(first[chosen]), int(last[chosen])
    missed = relative(*recording.odom_poses[[start, end]])
    missed[:2] *= 1.0 - SLIPPED
    kept = np.delete(np.arange(len(steps)), slice(start + 1, end))
    steps[end] = missed
    return _with_increments(_only(recording, kept), steps[kept])


def scale(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
    """The wheels are out of calibration: distances come out too long, turns too small."""
    factors = np.array([DISTANCE_SCALE, DISTANCE_SCALE, TURN_SCALE])
    return _with_increments(recording, increments(recording.odom_poses) * factors)


def mount(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
    """The poses are those of the robot, on which the scanner sits ahead and turned."""
    robot_in_scanner = relative(np.array(MOUNT), np.zeros(3))
    return _with_poses(recording, compose(recording.odom_poses, robot_in_scanner))


def missing(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
    """Of each scan, 30 % of the beams or a few more return nothing, in blocks."""
    ranges = recording.ranges.copy()
    num_beams = ranges.shape[1]
    for scan in ranges:
        gone = np.zeros(num_beams, bool)
        while gone.mean() < MISSING_BEAMS:
            first = rng.integers(num_beams)
            gone[first : first + rng.integers(*BLOCK_OF_BEAMS)] = True
        scan[gone] = np.inf
    return _with_poses(recording._replace(ranges=ranges), recording.odom_poses)


def dropped(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
    """Of the scans, a tenth or a few more are missing, in blocks; the wheels go on."""
    num_scans = len(recording.number)
    gone = np.zeros(num_scans, bool)
    while gone.mean() < DROPPED_SCANS:
        first = rng.integers(1, num_scans)
        gone[first : first + rng.integers(*BLOCK_OF_SCANS)] = True
    return _only(recording, np.flatnonzero(~gone))


def people(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
    """Three people walk about near the robot, in all scans."""
    ranges = damaged_drives.with_people(rng, recording.lidar, recording.ranges)
    ranges = np.round(ranges.astype(np.float64), 3)
    return _with_poses(recording._replace(ranges=ranges), recording.odom_poses)


def unhurt(rng: np.random.Generator, recording: DriveRecord) -> DriveRecord:
    """The recording as it is."""
    return recording


FAULTS: dict[str, Fault] = {
    UNHURT: unhurt,
    "stamps-zero": on_stamps(zero),
    "stamps-some-zero": on_stamps(some_zero),
    "stamps-constant": on_stamps(constant),
    "stamps-coarse": on_stamps(coarse),
    "stamps-back": on_stamps(back),
    "stamps-set-back": on_stamps(set_back),
    **{f.__name__: f for f in (unsigned, latched, lost, still, carried, slipped)},
    **{f.__name__: f for f in (scale, mount, missing, dropped, people)},
}
RANDOM = {"stamps-some-zero", "stamps-back", "latched", "lost", "carried", "slipped"}
RANDOM |= {"missing", "dropped", "people"}
"""The faults that depend on the seed."""


def hurt(how: str, seed: int, recording: DriveRecord) -> DriveRecord:
    """A recording with a fault of `FAULTS`."""
    return FAULTS[how](np.random.default_rng([seed, *how.encode()]), recording)
