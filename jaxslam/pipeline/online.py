"""SLAM on a log as its scans come in: scan matching, filter, topological map.

    state = init(config, start)
    for odometry, ranges in portions:       # of 1 to `CHUNK` scans
        state, result = update(config, params, state, odometry, ranges)
    topological_map(config, state, poses)                  # of single scans, merged
    state, found = whole_map(config, state, poses, scans)  # of all scans in one grid

Pose and map are available after each portion. `offline.run_slam` does the same for a whole log.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core import trace_cache
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.measurement import ScanMatch
from jaxslam.core.scan import Lidar
from jaxslam.core.types import Array, as_float64
from jaxslam.filtering import config as filter_config
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.mapping import arc_table
from jaxslam.mapping.arc_table import ArcTable
from jaxslam.mapping.global_map import RESOLUTION, GlobalMap, build_global_map, moved_with_poses
from jaxslam.mapping.occupancy import occupancy_map
from jaxslam.mapping.topological_map import build_map
from jaxslam.matching import scan_matching
from jaxslam.matching.icp import ScanMatchSpec, Submap
from jaxslam.pipeline import arguments, chunks
from jaxslam.pipeline.chunks import Chunk, FilterState
from jaxslam.pipeline.chunks import ChunkResult as ChunkResult
from jaxslam.pipeline.config import Config


class SlamState(NamedTuple):
    """State of incremental SLAM: the estimate after some scans, and what the next ones need.

    Attributes:
        belief: Of the filter.
        arcs: Of the topological map.
        submap: Of the scan matcher; None where scans are not matched.
    """

    belief: Belief
    arcs: ArcTable
    submap: Submap | None


def init(config: Config, start: Any = None, *, match_scans: bool = True) -> SlamState:
    """State before the first scan: a known pose and an empty map.

    Args:
        config: Of the filter; `config.filter.max_landmarks` is the largest size of the map.
        start: (3,) [m, m, rad] first pose, map frame; zero by default.
        match_scans: Whether scans are matched, and the increments fused with the odometry.

    Raises:
        ValueError: The stages of the configuration do not fit each other, or `start` is no pose.
    """
    arguments.check_config(config)
    capacity = min(chunks.SLOT_BLOCK, config.filter.max_landmarks)
    return _init(
        config.filter._replace(max_landmarks=capacity),
        config.frontend.lidar,
        config.scan_matching if match_scans else None,
        arguments.as_start(start),
    )


@partial(
    trace_cache.jit, static_argnames=("config", "lidar", "spec"), compile_quickly="unoptimised"
)
def _init(
    config: FilterConfig, lidar: Lidar, spec: ScanMatchSpec | None, start: Array
) -> SlamState:
    """State with as many slots as the filter's configuration says, and two arcs for each."""
    return SlamState(
        filter_config.init(config, start),
        arc_table.empty_arcs(capacity=2 * config.max_landmarks),
        None if spec is None else scan_matching.empty_submap(spec, lidar),
    )


def update(
    config: Config, params: NoiseParams, state: SlamState, odometry: Any, ranges: Any
) -> tuple[SlamState, ChunkResult]:
    """Update the state by the next scans.

    Args:
        config: The same as at the beginning.
        params: Q and R of the filter.
        state: State after the scans before.
        odometry: (N, 3) [m, m, rad] increments since the scan before, 1 <= N <= `CHUNK`.
        ranges: (N, R) raw ranges [m], or a `Scan` [N].

    Raises:
        ValueError: There is no scan, or there are too many; an argument has another shape, or does
            not fit the others.
    """
    arguments.check_config(config)
    params = arguments.as_params(params, match_scans=state.submap is not None)
    increments = arguments.as_odometry(odometry)
    if len(increments) > chunks.CHUNK:
        raise ValueError(f"odometry has {len(increments)} rows; a chunk has {chunks.CHUNK} at most")
    scans = arguments.as_scans(config.frontend.lidar, ranges, len(increments))
    chunk = chunks.extract_chunk(config, state.submap, increments, scans)
    return advance(config, params, state, chunk)


def advance(
    config: Config, params: NoiseParams, state: SlamState, chunk: Chunk
) -> tuple[SlamState, ChunkResult]:
    """Update the state by a chunk that has passed the front end; waits for the results."""
    (belief, arcs), result = chunks.filter_chunk(
        config, params, FilterState(state.belief, state.arcs), chunk
    )
    return SlamState(belief, arcs, chunk.submap), result


def topological_map(config: Config, state: SlamState, poses: Any) -> TopologicalMap:
    """Topological map of a state.

    Args:
        config: Of the filter.
        state: The state.
        poses: (T, 3) [m, m, rad] trajectory up to it, map frame.

    Raises:
        ValueError: The poses have another shape.
    """
    return build_map(
        state.belief,
        state.arcs,
        as_float64("poses", poses, ("T", 3)),
        confirm_count=config.filter.confirm_count,
        min_separation=config.filter.association.min_separation,
        max_log_clearance_ratio=config.filter.association.max_log_clearance_ratio,
    )


def whole_map(
    config: Config,
    state: SlamState,
    poses: Any,
    scans: Any,
    *,
    previous: TopologicalMap | None = None,
    previous_poses: Any = None,
) -> tuple[SlamState, GlobalMap]:
    """Topological map of all scans so far, drawn into one grid, as `run_slam` makes at the end.

    It is made anew from the poses as they are estimated now; nodes and open ends of `previous`
    that are still there, after they have moved with the poses, keep their ids.

    Args:
        config: Of the filter; `config.mapping.robot_radius` is the least clearance of arcs.
        state: The state after the last scan.
        poses: (T, 3) [m, m, rad] trajectory up to it, map frame.
        scans: (T, R) raw ranges [m], or a `Scan` [T], from there.
        previous: The graph of an earlier call.
        previous_poses: (K, 3) [m, m, rad] poses of that call, K <= T.

    Returns:
        The state, in which no later landmark will have an id of a node, and the map.

    Raises:
        ValueError: Poses, scans or previous poses do not fit each other.
    """
    arguments.check_config(config)
    poses = as_float64("poses", poses, ("T", 3))
    lidar = config.frontend.lidar
    scans = arguments.as_scans(lidar, scans, len(poses))
    if previous is not None:
        before = as_float64("previous_poses", previous_poses, ("K", 3))
        if not 0 < len(before) <= len(poses):
            raise ValueError(f"previous_poses has {len(before)} rows, poses {len(poses)}")
        previous = moved_with_poses(previous, before, poses[: len(before)])
    found = build_global_map(
        occupancy_map(lidar, poses, scans, resolution=RESOLUTION),
        poses,
        topological_map(config, state, poses),
        int(state.belief.next_id),
        previous=previous,
        robot_radius=config.mapping.robot_radius,
    )
    next_id = jnp.asarray(found.next_id, state.belief.next_id.dtype)
    return state._replace(belief=state.belief._replace(next_id=next_id)), found


def match_log(
    config: Config, odometry: Any, ranges: Any, *, odometry_guessed: Any = None
) -> ScanMatch:
    """Increments [T] by scan matching alone, without a filter; NumPy.

    Args:
        config: Of the scan matcher, and the scanner.
        odometry: (T, 3) [m, m, rad] increments since the scan before, the first guess.
        ranges: (T, R) raw ranges [m], or a `Scan` [T].
        odometry_guessed: (T,) bool, as of `run_slam`.

    Raises:
        ValueError: An argument has another shape, or the odometry looks like poses.
    """
    increments = arguments.as_log_odometry(odometry)
    lidar, spec = config.frontend.lidar, config.scan_matching
    scans = arguments.as_scans(lidar, ranges, len(increments))
    guessed = arguments.as_flags("odometry_guessed", odometry_guessed, len(increments))
    submap, parts = scan_matching.empty_submap(spec, lidar), []
    for first in range(0, len(increments), chunks.CHUNK):
        some = chunks.chunk_at(first, increments, scans)
        some_guessed = guessed[first : first + chunks.CHUNK]
        submap, part = chunks.match_chunk(config, submap, *some, some_guessed)
        parts.append(part)
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)
