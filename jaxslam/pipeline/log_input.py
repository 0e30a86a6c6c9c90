"""From a recorded log to the arguments of `run_slam`, with the presets of `jaxslam run`."""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from jaxslam.core.batching import on_device
from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import increments, relative
from jaxslam.filtering.noise import NoiseParams
from jaxslam.mapping.saved_map import SavedMap
from jaxslam.pipeline import arguments, breaks, offline
from jaxslam.pipeline.chunks import ChunkResult
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.online import SlamState
from jaxslam.pipeline.results import SlamResult

OdometrySource = Literal["scan", "scans-only", "wheels"]
"""Scan matching fused with wheel odometry, scan matching alone, or wheel odometry alone."""


class LogInput(NamedTuple):
    """What `run_slam` needs of a log of T scans.

    Attributes:
        config: For the scanner of the log.
        odometry_source: Where the motion between scans comes from; "scans-only" if that was to be
            "scan" and the log has no odometry.
        odom_poses: (T, 3) [m, m, rad] poses by odometry since the first scan, the map frame.
        increments: (T, 3) [m, m, rad] odometry increments, zero at the first scan.
        guessed: (T,) bool, which of them are guesses of the reader; None for none.
        after_pause: (T,) bool, before which scans the robot may have been moved unseen.
        new_drive: (T,) bool, which scans begin another log than the one before.
        scans: [T].
        notes: What was wrong with the log, or had to be assumed.
    """

    config: Config
    odometry_source: OdometrySource
    odom_poses: np.ndarray
    increments: np.ndarray
    guessed: np.ndarray | None
    after_pause: np.ndarray
    new_drive: np.ndarray
    scans: Scan
    notes: tuple[str, ...]

    @property
    def match_scans(self) -> bool:
        """Whether scans are matched."""
        return self.odometry_source != "wheels"


def from_laser_log(laser_log: LaserLog, source: OdometrySource = "scan") -> LogInput:
    """The input of `run_slam` for a log, with the presets of `jaxslam run`.

    Args:
        laser_log: The log.
        source: Where the motion between scans comes from.

    Raises:
        ValueError: The scanner is impossible, or scans or odometry are not such as can be mapped.
    """
    notes = laser_log.notes
    if source == "scan" and not laser_log.has_odometry:
        source = "scans-only"
        notes += ("scans alone are matched, as by --odometry scans-only",)
    config = Config.for_laser_log(laser_log.lidar)
    if source == "scans-only":
        matching = config.scan_matching._replace(use_odometry=False)
        config = config._replace(scan_matching=matching)
    config.check()
    odom_poses = relative(laser_log.odom_poses[0], laser_log.odom_poses)
    odometry = arguments.as_log_odometry(increments(odom_poses))
    scans = arguments.scans_of_log(config.frontend.lidar, on_device(laser_log.ranges))
    arguments.as_scans(config.frontend.lidar, laser_log.ranges, len(odometry))
    guessed = laser_log.odometry_guessed
    return LogInput(
        config=config,
        odometry_source=source,
        odom_poses=odom_poses,
        increments=odometry,
        guessed=guessed,
        after_pause=breaks.pauses(laser_log.times),
        new_drive=np.zeros(len(odometry), bool),
        scans=scans,
        notes=notes,
    )


def combine(logs: Sequence[LogInput]) -> LogInput:
    """Several drives as one input, each at an unknown place to the others.

    Args:
        logs: One or more, of the same scanner and the same source of odometry.

    Raises:
        ValueError: There is none; a scanner or source differs from that of the first, or the wheels
            alone are used: drives are joined by their scans.
    """
    if not logs:
        raise ValueError("logs is empty: one log at least is expected")
    first = logs[0]
    if len(logs) == 1:
        return first
    for number, log in enumerate(logs[1:], 2):
        own, other = (x.config.frontend.lidar for x in (log, first))
        for field in own._fields:
            if getattr(own, field) != getattr(other, field):
                raise ValueError(
                    f"log {number} has a scanner with {field} {getattr(own, field):g}, log 1 one "
                    f"with {getattr(other, field):g}; drives are joined by scans of one scanner"
                )
        if log.odometry_source != first.odometry_source:
            raise ValueError(
                f"log {number} uses odometry {log.odometry_source!r}, log 1 "
                f"{first.odometry_source!r}; take scans-only for all"
            )
    if first.odometry_source == "wheels":
        raise ValueError("drives are joined by their scans: take another odometry than wheels")
    lengths = [len(log.increments) for log in logs]
    guessed = [
        np.zeros(n, bool) if log.guessed is None else log.guessed
        for log, n in zip(logs, lengths, strict=True)
    ]
    new_drive = np.zeros(sum(lengths), bool)
    new_drive[np.cumsum(lengths)[:-1]] = True
    return first._replace(
        odom_poses=np.concatenate([log.odom_poses for log in logs]),
        increments=np.concatenate([log.increments for log in logs]),
        guessed=np.concatenate(guessed),
        after_pause=np.concatenate([log.after_pause for log in logs]),
        new_drive=new_drive,
        scans=jax.tree.map(lambda *x: np.concatenate(x), *[log.scans for log in logs]),
        notes=tuple(f"log {k}: {note}" for k, log in enumerate(logs, 1) for note in log.notes),
    )


def run(
    log: LogInput,
    params: NoiseParams | None = None,
    *,
    saved_map: SavedMap | None = None,
    smooth: bool = True,
    callback: Callable[[SlamState, ChunkResult], Any] | None = None,
) -> SlamResult:
    """Run SLAM on the input of a log.

    Args:
        log: The input.
        params: Q and R of the filter; by default those for recorded logs.
        saved_map: As of `run_slam`.
        smooth: As of `run_slam`.
        callback: As of `run_slam`.
    """
    return offline.run_slam(
        log.config,
        NoiseParams.for_laser_log(match_scans=log.match_scans) if params is None else params,
        log.increments,
        log.scans,
        odometry_guessed=log.guessed,
        after_pause=log.after_pause,
        new_drive=log.new_drive,
        saved_map=saved_map,
        match_scans=log.match_scans,
        smooth=smooth,
        callback=callback,
    )
