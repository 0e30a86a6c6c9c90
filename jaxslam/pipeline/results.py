"""The record that SLAM on a whole log results in."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxslam.core.features import Features
from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.core.measurement import ScanMatch
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.mapping.arc_table import ArcTable
from jaxslam.mapping.map_consistency import MapConsistency
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.pipeline.stages import KeyframeChunk


class SlamResult(NamedTuple):
    """Result of SLAM on a log of T scans, K of which are keyframes.

    Attributes:
        poses: (T, 3) float64 [m, m, rad] estimated trajectory, map frame: filtered, or smoothed;
            NaN for scans that are in none of its pieces.
        online_poses: (T, 3) float64 [m, m, rad] estimates at the time: those of the filter, and
            between keyframes the matched motion since. Where pieces were joined, the filter was
            run again, knowing that.
        keyframes: (K,) int numbers of the keyframes, which the filter was given; the first and the
            last scan of each piece are among them. All scans where `config.keyframe_distance` is
            None.
        belief: Of the filter after the last scan; if smoothed, with the smoothed last pose and
            landmark positions, and still the covariance of the filter.
        info: [K] diagnostics of the filter, with its estimates at the time.
        features: [K] features.
        topological_map: Topological map.
        consistency: Whether the scans agree with the map; its `warnings` say where they do not.
        scan_matches: [K] increments by scan matching since the keyframe before, where scans were
            matched.
        loop_closures: Loop closures that the trajectory was smoothed with, where there were any;
            they are between keyframes, by their index 0 .. K - 1.
        odometry: (K, 3) [m, m, rad] increments since the keyframe before that the filter was given:
            repaired, or zero where odometry is not used.
        notes: What was corrected, joined or left out, to be printed.
        arcs: Arcs that the topological map is made of, as observed, and those that are gone; to go
            on from.
        piece: (T,) int piece of the drive that each scan is in, from 0; -1 for scans that are not
            in this map.
        saved_poses: (S, 3) float64 [m, m, rad] of the keyframes of the saved map that this one goes
            on in, map frame; None without one. Loop closures with them are not listed.
        next_id: No node or landmark has had this id or a higher one.
        occupancy: Occupancy map of the keyframes, those of a saved map too.
        other_parts: Maps of the pieces that nothing joins to this one, each in a frame of its own,
            the largest first.
    """

    poses: np.ndarray
    online_poses: np.ndarray
    keyframes: np.ndarray
    belief: Belief
    info: StepInfo
    features: Features
    topological_map: TopologicalMap
    consistency: MapConsistency
    scan_matches: ScanMatch | None = None
    loop_closures: LoopClosures | None = None
    odometry: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    arcs: ArcTable | None = None
    piece: np.ndarray = np.zeros(0, int)
    saved_poses: np.ndarray | None = None
    saved_closures: LoopClosures | None = None
    next_id: int = 0
    occupancy: OccupancyMap | None = None
    other_parts: "tuple[SlamResult, ...]" = ()


def piece_of(chunks: Sequence[KeyframeChunk], num_scans: int) -> np.ndarray:
    """Piece (T,) of each scan; -1 for those of no chunk."""
    piece = np.full(num_scans, -1)
    for chunk in chunks:
        end = int(chunk.keyframes[-1]) + 1
        piece[end - len(chunk.matched.is_keyframe) : end] = chunk.piece
    return piece


def spread(poses: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Poses (N, 3) of the scans that are one's own (T,), as rows of all (T, 3); NaN elsewhere."""
    rows = np.full((len(own), 3), np.nan)
    rows[own] = poses
    return rows
