"""Drives of `localisation`: scans of a recorded log from a random one on, and the true poses.

Three kinds. **own map**: the map is that of the whole log, and the truth its smoothed poses; after
15 m the robot is carried to another random scan. **second half**: the map is that of the first half
of the log; the drives are those of the second half of whose first 5 m at least half is in the map
by the reference. A scan is in the map where a keyframe of it had about the same view, within 1.5 m
and 0.7 rad. The map may be distorted as a whole, which is no error of localisation; so the truth is
the pose of the nearest keyframe in the map, and from there the motion by the reference.
**outside**: the other drives of the second half, which may come into the map later; here only what
is sure and wrong is counted.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.log_folder import Log
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import compose, relative
from jaxslam.core.time_series import match_times
from jaxslam.localisation import LocaliseSpec, PlaceMap, map_of_scans
from jaxslam.matching import scan_matching
from jaxslam.pipeline import log_input, odometry_notes
from jaxslam.pipeline.log_input import LogInput

OWN, HALF, OUTSIDE = "own map", "second half", "outside"
KINDS = (OWN, HALF, OUTSIDE)
DRIVE = 30.0  # [m] of a drive, about
CARRIED_AFTER = 15.0  # [m] of driving in the own map
FOUND_WITHIN = 5.0  # [m] of driving
SAME_VIEW = (1.5, 0.7)  # [m], [rad] between two scans
HEADING_COST = 0.3  # [m] for each [rad], of the nearest keyframe
SPEC = LocaliseSpec()


class MappedLog(NamedTuple):
    """A log of N scans, and a map to localise them in.

    Attributes:
        lidar: The scanner.
        scans: [N].
        odometry: (N, 3) [m, m, rad] by scan matching, since the scan before.
        place_map: The map.
        truth: (N, 3) [m, m, rad] in its frame; NaN where unknown.
        inside: (N,) bool, whether the map shows where the scan was taken.
        in_map: (N,) bool, whether the map was made of it.
    """

    lidar: Lidar
    scans: Scan
    odometry: np.ndarray
    place_map: PlaceMap
    truth: np.ndarray
    inside: np.ndarray
    in_map: np.ndarray


class Drives(NamedTuple):
    """B drives of T scans.

    Attributes:
        numbers: (B, T) int of the scans in the log.
        exists: (B, T) bool.
        odometry: (B, T, 3) [m, m, rad] since the scan before; zero where a drive begins.
        carried_at: (B,) int first scan after the robot was carried; T if it was not.
    """

    numbers: np.ndarray
    exists: np.ndarray
    odometry: np.ndarray
    carried_at: np.ndarray


def in_own_map(log: Log) -> MappedLog:
    """A log in the map of all of it."""
    given = log_input.from_laser_log(log.laser_log)
    poses, place_map = _map_of(given)
    everywhere = np.isfinite(poses[:, 0])
    return _mapped(given, place_map, poses, everywhere, everywhere)


def in_first_half(log: Log) -> MappedLog:
    """A log in the map of its first half."""
    assert log.reference is not None
    given = log_input.from_laser_log(log.laser_log)
    count = len(given.increments) // 2
    poses, place_map = _map_of(
        given._replace(
            odom_poses=given.odom_poses[:count],
            increments=given.increments[:count],
            guessed=None if given.guessed is None else given.guessed[:count],
            after_pause=given.after_pause[:count],
            new_drive=given.new_drive[:count],
            scans=jax.tree.map(lambda x: np.asarray(x)[:count], given.scans),
        )
    )
    pairs = match_times(log.laser_log.times, log.reference[0])
    reference = np.full((len(given.increments), 3), np.nan)
    reference[pairs[:, 0]] = log.reference[1][pairs[:, 1]]
    truth, inside = truth_by_nearest(reference, poses)
    in_map = np.arange(len(reference)) < count
    return _mapped(given, place_map, truth, inside, in_map)


def _mapped(
    given: LogInput,
    place_map: PlaceMap,
    truth: np.ndarray,
    inside: np.ndarray,
    in_map: np.ndarray,
) -> MappedLog:
    """The record of a log in a map; the last three are those of `MappedLog`."""
    scans, lidar = jax.tree.map(np.asarray, given.scans), given.config.frontend.lidar
    return MappedLog(lidar, scans, _matched(given), place_map, truth, inside, in_map)


def with_own_truth(log: Log) -> Log:
    """The log with its own smoothed trajectory as reference."""
    found = log_input.run(log_input.from_laser_log(log.laser_log))
    return log._replace(reference=(np.asarray(log.laser_log.times), np.asarray(found.poses)))


def truth_by_nearest(reference: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """True poses (N, 3) in the frame of a map, and whether it shows what is seen there (N,).

    Args:
        reference: (N, 3) [m, m, rad] of all scans by the reference; NaN where unknown.
        poses: (K, 3) [m, m, rad] in the map of the first K; NaN for those that are not in it.
    """
    mapped = np.flatnonzero(np.isfinite(poses[:, 0]) & np.isfinite(reference[: len(poses), 0]))
    off = relative(reference[None, mapped], reference[:, None])
    distance, turn = np.hypot(off[..., 0], off[..., 1]), np.abs(off[..., 2])
    inside = ((distance < SAME_VIEW[0]) & (turn < SAME_VIEW[1])).any(axis=1)
    cost = np.nan_to_num(distance + HEADING_COST * turn, nan=np.inf)
    nearest = cost.argmin(axis=1)
    return compose(poses[mapped][nearest], off[np.arange(len(off)), nearest]), inside


def make_drives(
    mapped: MappedLog, kind: str, count: int, rng: np.random.Generator
) -> Drives | None:
    """Drives of a kind from random scans; None where no scan of the log can be their first."""
    steps = np.hypot(*mapped.odometry[:, :2].T)
    length = max(int(np.ceil(DRIVE / max(steps.mean(), 0.05))), 2)
    driven = np.cumsum(steps)
    ahead = driven[-1] - driven  # [m]
    candidates = np.isfinite(mapped.truth[:, 0]) & (ahead > CARRIED_AFTER)
    if kind != OWN:
        enough = np.array([_overlap(mapped, driven, k) >= 0.5 for k in range(len(driven))])
        candidates &= ~mapped.in_map & (enough if kind == HALF else ~enough)
    starts = np.flatnonzero(candidates)
    if not len(starts):
        return None
    numbers = rng.choice(starts, count)[:, None] + np.arange(length)[None]
    exists = numbers < len(steps)
    numbers = np.minimum(numbers, len(steps) - 1)
    begins = np.zeros(numbers.shape, bool)
    begins[:, 0] = True
    carried_at = np.full(count, length)
    if kind == OWN:
        far = driven[numbers] - driven[numbers[:, :1]] >= CARRIED_AFTER
        carried_at = np.where(far.any(axis=1), far.argmax(axis=1), length)
        carried_at = np.minimum(carried_at, 2 * length // 3)
        after = np.arange(length)[None] - carried_at[:, None]
        there = rng.choice(starts, count)[:, None] + after
        exists = np.where(after >= 0, there < len(steps), exists)
        numbers = np.where(after >= 0, np.minimum(there, len(steps) - 1), numbers)
        begins |= after == 0
    odometry = np.where(begins[..., None], 0.0, mapped.odometry[numbers])
    return Drives(numbers, exists, odometry, carried_at)


def scans_of(mapped: MappedLog, drives: Drives, some: slice) -> tuple[Any, np.ndarray]:
    """Scans [B, T] and odometry (B, T, 3) of some drives, as the methods are given them."""
    scans = jax.tree.map(lambda x: x[drives.numbers[some]], mapped.scans)
    return scans, drives.odometry[some].astype(mapped.scans.ranges.dtype)


def _overlap(mapped: MappedLog, driven: np.ndarray, start: int) -> float:
    """Share of the scans of the first 5 m from one on that are in the map."""
    within = (driven >= driven[start]) & (driven <= driven[start] + FOUND_WITHIN)
    within[:start] = False
    return float(mapped.inside[within].mean())


def _map_of(given: LogInput) -> tuple[np.ndarray, PlaceMap]:
    """Poses (N, 3) of a log, and its map."""
    result = log_input.run(given)
    poses = np.asarray(result.poses, float)
    keyframes = result.keyframes[np.isfinite(poses[result.keyframes, 0])]
    scans = jax.tree.map(lambda x: np.asarray(x)[keyframes], given.scans)
    return poses, map_of_scans(SPEC, given.config.frontend.lidar, poses[keyframes], scans)


def _matched(given: LogInput) -> np.ndarray:
    """Increments (N, 3) of a log by scan matching."""
    spec, lidar = given.config.scan_matching, given.config.frontend.lidar
    odometry, is_share, _ = odometry_notes.share_out(
        given.increments, jax.tree.map(np.asarray, given.scans), given.after_pause
    )
    guessed = is_share if given.guessed is None else given.guessed | is_share
    submap = scan_matching.empty_submap(spec, lidar)
    matches = scan_matching.match_scans(
        spec, lidar, submap, given.scans, odometry, guessed=guessed
    )[1]
    return np.asarray(matches.increment, float)
