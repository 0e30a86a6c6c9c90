"""Whether the scans of a result agree with its map, and with the saved one that it goes on in."""

import jax
import numpy as np

from jaxslam.core.scan import Lidar, Scan
from jaxslam.mapping.map_consistency import MapConsistency, check_map
from jaxslam.mapping.saved_map import SavedMap

UNEXPLAINED = 0.01
"""Share of the scans that contradict a map that is fine, at most."""


def check_poses(
    lidar: Lidar,
    poses: np.ndarray,
    scans: Scan,
    piece: np.ndarray,
    saved: tuple[SavedMap, np.ndarray] | None,
) -> MapConsistency:
    """Agreement of the scans of a log with its map; of a saved map's scans, as earlier visits.

    Args:
        lidar: The scanner.
        poses: (T, 3) [m, m, rad] map frame; those that are not finite are left out.
        scans: [T].
        piece: (T,) int as of `check_map`.
        saved: The saved map, and the poses (S, 3) of its keyframes in the frame of this one; None
            where there is none. Warnings are of scans of the log alone, and numbered as these.
    """
    if saved is None:
        return check_map(lidar, poses, scans, piece=piece)
    saved_map, saved_poses = saved
    count = len(saved_poses)
    both = jax.tree.map(lambda *x: np.concatenate(x), saved_map.scans, scans)
    piece = np.concatenate([np.full(count, -2), piece])  # -1 are scans without a pose
    poses = np.concatenate([saved_poses, poses])
    found = check_map(lidar, poses, both, piece=piece, since=count)
    new = found.scan >= count
    warnings = tuple(
        warning._replace(
            first_scan=max(warning.first_scan - count, 0), last_scan=warning.last_scan - count
        )
        for warning in found.warnings
        if warning.last_scan >= count
    )
    return found._replace(
        scan=found.scan[new] - count,
        poses=found.poses[new],
        step_contradiction=found.step_contradiction[new[1:]][1:],
        step_confirmation=found.step_confirmation[new[1:]][1:],
        visit_contradiction=found.visit_contradiction[new],
        warnings=warnings,
    )


def is_contradicted(found: MapConsistency) -> bool:
    """Whether the scans contradict a map more than one that is fine."""
    return bool(found.warnings) or np.sum(~found.explained) > UNEXPLAINED * len(found.scan)


def remark(found: MapConsistency) -> tuple[str, ...]:
    """A note if more scans contradict a map than usual, though there is no warning."""
    if found.warnings or not is_contradicted(found):
        return ()
    contradicts = found.scan[~found.explained]
    share, first, last = len(contradicts) / len(found.scan), contradicts[0], contradicts[-1]
    return (
        f"{share:.1%} of the scans, between {first} and {last}, contradict the map, none of them "
        "for long enough to warn: it may be bent there",
    )
