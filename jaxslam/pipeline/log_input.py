"""From a recorded log to the arguments of `run_slam`, with the presets of `jaxslam run`."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import increments, relative
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import lidar
from jaxslam.pipeline import arguments, breaks, offline
from jaxslam.pipeline.chunks import ChunkResult
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.offline import SlamResult
from jaxslam.pipeline.online import SlamState

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
        scans: [T].
        notes: What was wrong with the log, or had to be assumed.
    """

    config: Config
    odometry_source: OdometrySource
    odom_poses: np.ndarray
    increments: np.ndarray
    guessed: np.ndarray | None
    after_pause: np.ndarray
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
    scans = lidar.to_scan(config.frontend.lidar, jnp.asarray(laser_log.ranges, float))
    arguments.as_scans(config.frontend.lidar, laser_log.ranges, len(odometry))
    guessed = laser_log.odometry_guessed
    after_pause = breaks.pauses(laser_log.times)
    return LogInput(config, source, odom_poses, odometry, guessed, after_pause, scans, notes)


def run(
    log: LogInput,
    params: NoiseParams | None = None,
    *,
    smooth: bool = True,
    callback: Callable[[SlamState, ChunkResult], Any] | None = None,
) -> SlamResult:
    """Run SLAM on the input of a log.

    Args:
        log: The input.
        params: Q and R of the filter; by default those for recorded logs.
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
        match_scans=log.match_scans,
        smooth=smooth,
        callback=callback,
    )
