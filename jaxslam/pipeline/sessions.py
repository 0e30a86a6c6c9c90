"""Going on in a saved map: its landmarks, arcs and ids, and its keyframes as scans to be found.

The saved map is one more piece of the drive, before all others (`pieces`). Where places of the new
log are found in it, the filter goes on from the saved state, with the saved ids. For the smoother
the old keyframes are a chain of poses that hardly bends, and loops are closed with their scans.
"""

import jax
import numpy as np

from jaxslam.core.batching import on_device
from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import increments
from jaxslam.core.types import check_type
from jaxslam.filtering.belief import grow_belief
from jaxslam.filtering.config import with_options
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.mapping import arc_table
from jaxslam.mapping.saved_map import SavedMap
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.matching.map_places import ScanMap
from jaxslam.pipeline import chunks
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.online import SlamState

SAVED_STD = (0.01, 0.01, 0.002)
"""[m], [m], [rad] std of the motion from one saved keyframe to the next."""


def check_saved_map(saved: SavedMap, lidar: Lidar) -> None:
    """Raise unless a log of this scanner can go on in a saved map.

    Raises:
        ValueError: It is no saved map, is empty, or is one of another scanner.
    """
    check_type("saved_map", saved, SavedMap)
    if not len(saved.poses):
        raise ValueError("saved_map has no keyframes")
    for field in lidar._fields:
        own, new = getattr(saved.lidar, field), getattr(lidar, field)
        if own != new:
            raise ValueError(
                f"saved_map is of a scanner with {field} {own:g}, the log of one with {new:g}; a "
                "map is continued by the scanner that made it"
            )


def scan_map(saved: SavedMap) -> ScanMap:
    """The keyframes of a saved map."""
    return ScanMap(saved.lidar, saved.poses, saved.scans)


def resume(config: Config, saved: SavedMap) -> SlamState:
    """The state of SLAM after a saved map, with capacity to go on; for the filter alone.

    Args:
        config: Of the filter; `config.filter.max_landmarks` is the largest size of the map.
        saved: The map.

    Raises:
        ValueError: It has more landmarks than `config.filter.max_landmarks`.
    """
    belief, arcs = on_device((saved.belief, saved.arcs))
    used, block = belief.num_seen.size, chunks.SLOT_BLOCK
    if used > config.filter.max_landmarks:
        raise ValueError(
            f"saved_map has {used} landmarks, more than config.filter.max_landmarks = "
            f"{config.filter.max_landmarks}"
        )
    needed = max(used + chunks.MIN_FREE_SLOTS, -(-arcs.num_seen.size // 2))
    capacity = min(block * -(-needed // block), config.filter.max_landmarks)
    arcs = arc_table.grow_arcs(arcs, max(2 * capacity, arcs.num_seen.size))
    return SlamState(with_options(config.filter, grow_belief(belief, capacity)), arcs, None)


def with_saved_keyframes(
    saved: SavedMap, measurements: Measurement, info: StepInfo, scans: Scan
) -> tuple[Measurement, StepInfo, Scan]:
    """What the smoother is given of a log that goes on in a map: the saved keyframes come first.

    Args:
        saved: The map, K keyframes.
        measurements: [T] of the filter, NumPy, with scan matching.
        info: [T] its diagnostics, of which poses and landmark ids are used.
        scans: [T], NumPy.

    Returns:
        The same of K + T keyframes; those that are saved have no features.
    """
    count = len(saved.poses)

    def before(x: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros((count, *x.shape[1:]), x.dtype), x])

    given = jax.tree.map(np.asarray, measurements)
    given = jax.tree.map(before, given)
    match = given.scan_match
    match.increment[:count] = match.expected[:count] = increments(saved.poses)
    match.expected_variance[:count] = np.square(SAVED_STD)
    ids = before(np.asarray(info.id))
    ids[:count] = -1
    poses = np.concatenate([saved.poses.astype(info.pose.dtype), np.asarray(info.pose)])
    both = jax.tree.map(
        lambda old, new: np.concatenate([old.astype(new.dtype), new]), saved.scans, scans
    )
    return given, info._replace(id=ids, pose=poses), both  # type: ignore[arg-type]


def split_closures(
    closures: LoopClosures | None, num_saved: int
) -> tuple[LoopClosures | None, LoopClosures | None]:
    """Loop closures among the keyframes after the saved ones, and of these with saved ones.

    The keyframes after the saved ones are numbered from 0 on.
    """
    if closures is None or not num_saved:
        return closures, None
    early, late = closures.first >= num_saved, closures.second >= num_saved
    new, between = (LoopClosures(*(x[kept] for x in closures)) for kept in (early, late & ~early))
    return (
        new._replace(first=new.first - num_saved, second=new.second - num_saved),
        between._replace(second=between.second - num_saved),
    )
