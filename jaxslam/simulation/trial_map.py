"""The map of a trial, from what the trials have computed: nothing is compiled for it."""

from typing import NamedTuple

import numpy as np

from jaxslam.core.features import Features
from jaxslam.core.scan import Scan
from jaxslam.core.types import Array
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.frontend.arc_tracing import POLYLINE_POINTS
from jaxslam.mapping.arc_table import ArcTable
from jaxslam.mapping.topological_map import build_map
from jaxslam.pipeline import mapping_stage, self_check
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.results import SlamResult


class FilteredDrive(NamedTuple):
    """A simulated drive of T scans that was filtered.

    Attributes:
        belief: Of the filter after the last scan.
        info: [T] diagnostics of the filter.
        features: [T] features.
        odometry: (T, 3) [m, m, rad] increments.
        scans: [T].
    """

    belief: Belief
    info: StepInfo
    features: Features
    odometry: Array
    scans: Scan


def slam_result(config: Config, drive: FilteredDrive) -> SlamResult:
    """The result that `offline.run_slam` has of a drive, without the arcs of single scans.

    The Voronoi diagram of all scans has no use for these: its nodes are the filter's landmarks.

    Args:
        config: Of the trials, with `mapping.topology` "grid".
        drive: Of a trial that `run_trials_and_map` has run; NumPy arrays.

    Raises:
        ValueError: The map is to be merged from the arcs of single scans.
    """
    if config.mapping.topology != "grid":
        raise ValueError(
            f"config.mapping.topology is {config.mapping.topology!r}, not 'grid'; "
            "replay_trial makes a map of the arcs of single scans"
        )
    poses = np.asarray(drive.info.pose, np.float64)
    count, lidar = len(poses), config.frontend.lidar
    association = config.filter.association
    landmarks = build_map(
        drive.belief,
        _no_arcs(),
        poses,
        confirm_count=config.filter.confirm_count,
        min_separation=association.min_separation,
        max_log_clearance_ratio=association.max_log_clearance_ratio,
    )
    piece = np.zeros(count, int)
    consistency = self_check.check_poses(lidar, poses, drive.scans, piece, None)
    result = SlamResult(
        poses,
        poses,
        np.arange(count),
        drive.belief,
        drive.info,
        drive.features,
        landmarks,
        consistency,
        odometry=np.asarray(drive.odometry, np.float64),
        piece=piece,
    )
    return mapping_stage.with_maps(config, drive.scans, result, None)


def _no_arcs() -> ArcTable:
    """A table whose only slot is free, NumPy."""
    line = np.zeros((1, POLYLINE_POINTS, 2), np.float32)
    number = np.zeros(1, np.float32)
    none = np.full((1, 2), -1, np.int32), line, number, number, np.zeros(1, np.int32)
    arcs: ArcTable = ArcTable(*none)  # type: ignore[arg-type]
    return arcs
