"""The last stage: the maps that a result is handed out with, checked against all its scans."""

from typing import Any

import jax
import numpy as np

from jaxslam.core.maps import without_arcs
from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import trajectories_as_one
from jaxslam.mapping.blocked_arcs import blocked_arcs
from jaxslam.mapping.global_map import RESOLUTION, build_global_map, moved_with_poses
from jaxslam.mapping.occupancy import occupancy_map
from jaxslam.mapping.saved_map import SavedMap
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.results import SlamResult


def with_maps(
    config: Config, scans: Scan, result: SlamResult, saved: SavedMap | None
) -> SlamResult:
    """A result with its occupancy map, and its topological map as `config.mapping` says.

    A map of several drives loses arcs on which the last scans see obstacles, with a note.

    Args:
        config: Of the run.
        scans: [T] of the log.
        result: With the map that was merged from single scans.
        saved: The map that the log was to go on in, if any.
    """
    lidar, graph = config.frontend.lidar, result.topological_map
    poses = result.poses[result.keyframes]
    own: Any = jax.tree.map(lambda x: np.asarray(x)[result.keyframes], scans)
    steps = result.poses[np.isfinite(result.poses).all(axis=1)]
    piece = result.piece[np.isfinite(result.poses).all(axis=1)]
    drives = np.split(steps, np.flatnonzero(np.diff(piece)) + 1)
    previous = None
    if result.saved_poses is not None and saved is not None:
        previous = moved_with_poses(saved.topological_map, saved.poses, result.saved_poses)
        poses = np.concatenate([result.saved_poses, poses])
        own = jax.tree.map(lambda a, b: np.concatenate([a, b.astype(a.dtype)]), saved.scans, own)
        drives.insert(0, result.saved_poses)
    occupancy = occupancy_map(lidar, poses, own, resolution=RESOLUTION)
    notes, next_id = result.notes, int(result.belief.next_id)
    if config.mapping.topology == "grid":
        found = build_global_map(
            occupancy,
            trajectories_as_one(drives),
            graph,
            next_id,
            previous=previous,
            robot_radius=config.mapping.robot_radius,
        )
        graph, occupancy, next_id = found
    if len(drives) > 1:
        blocked = blocked_arcs(lidar, poses, own, graph.arc_lines, graph.arc_clearance)
        if blocked.any():
            graph, count = without_arcs(graph, blocked), int(blocked.sum())
            what, on = ("1 arc is", "it") if count == 1 else (f"{count} arcs are", "them")
            notes += (f"{what} gone: the last scans see obstacles on {on}",)
    return result._replace(topological_map=graph, occupancy=occupancy, next_id=next_id, notes=notes)
