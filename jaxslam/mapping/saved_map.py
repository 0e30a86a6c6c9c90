"""A map that is kept for later sessions: scans, landmarks, arcs, and what they were made with."""

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxslam.core.maps import TopologicalMap
from jaxslam.core.scan import Lidar, Scan
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.covariance import flush
from jaxslam.filtering.noise import NoiseParams
from jaxslam.mapping.arc_table import ArcTable

# Fields of a belief with one number a slot.
_TRACK = "num_seen last_seen num_missed num_pending kind id direction descriptor".split()


class SavedMap(NamedTuple):
    """What a session leaves to later ones: NumPy arrays, K keyframes of a scanner of R beams.

    To go on from it, give landmarks and arcs capacity again: `belief.grow_belief(saved.belief, L)`,
    `arc_table.grow_arcs(saved.arcs, A)`.

    Attributes:
        lidar: The scanner.
        params: Q and R of the filter.
        times: (K,) float64 [s] stamps of the keyframes, by the clock of the log.
        poses: (K, 3) float64 [m, m, rad] of the scanner at the keyframes, map frame; smoothed
            where the session was.
        pose_cov: (K, 3, 3) float32 covariances of the filter's estimates of these poses at the
            time, not smoothed; zero at the first pose, which defines the map frame.
        scans: [K] of the keyframes: ranges (K, R) float32 [m] and hit (K, R) bool.
        belief: Pose and landmarks after the last scan, L slots, none of them free; as
            `SlamResult.belief`. The covariance of the map is dense and exactly symmetric.
        arcs: Observed arcs between landmarks, by landmark ids; none of the A slots is free.
        topological_map: The map made of them; the ids of its nodes are those of the landmarks.
    """

    lidar: Lidar
    params: NoiseParams
    times: np.ndarray
    poses: np.ndarray
    pose_cov: np.ndarray
    scans: Scan
    belief: Belief
    arcs: ArcTable
    topological_map: TopologicalMap


def used_landmarks(belief: Belief) -> Belief:
    """The belief without its free slots, NumPy; its covariance dense and exactly symmetric.

    Biases of odometry and scales of the noise are of one drive, and not part of a map.
    """
    belief = belief._replace(map_cov=flush(belief.map_cov), bias=None, adaptation=None)
    belief = jax.tree.map(np.asarray, belief)
    used = belief.num_seen > 0
    numbers = np.repeat(used, 2)  # (2 L,) the two numbers of each landmark
    state = np.append(np.ones(3, bool), numbers)
    cov: Any = np.asarray(belief.map_cov)[np.ix_(numbers, numbers)]
    return belief._replace(
        mean=belief.mean[state],
        first_estimate=belief.first_estimate[state],
        cross_cov=belief.cross_cov[:, numbers],
        map_cov=np.triu(cov) + np.triu(cov, 1).T,
        **{name: getattr(belief, name)[used] for name in _TRACK},
    )


def used_arcs(arcs: ArcTable) -> ArcTable:
    """The arcs without free slots, NumPy."""
    arcs = jax.tree.map(np.asarray, arcs)
    used = arcs.num_seen > 0
    return jax.tree.map(lambda x: x[used], arcs)
