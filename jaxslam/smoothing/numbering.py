"""Landmarks of a filtered log numbered without gaps, as the smoothers want them.

The filter's ids are never reused, so they have gaps where landmarks were forgotten; the batch
problem needs indices 0..L-1, and a first estimate of each position.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.batching import on_device
from jaxslam.core.features import Features
from jaxslam.core.se2_np import transform
from jaxslam.core.types import WALL, AnyArray, Array, as_float64, check_array
from jaxslam.smoothing.problem import as_index


class NumberedLandmarks(NamedTuple):
    """Landmarks of a filtered log, numbered without gaps, padded to L.

    Attributes:
        landmark_index: (T, M) int32 landmark 0..L-1 of each feature, L for none.
        positions: (L, 2) initial estimate, map frame: position [m] of a point, direction [rad] of a
            wall and 0; zero for padding.
        id: (L,) int32 id that the filter gave the landmark; -1 for padding.
    """

    landmark_index: Array
    positions: Array
    id: Array


def number_landmarks(
    feature_ids: AnyArray,
    poses: AnyArray,
    features: Features,
    *,
    min_observations: int = 2,
    capacity: int | None = None,
) -> NumberedLandmarks:
    """Number the landmarks of a filtered log by their ids, which unlike slots are never reused.

    Computed on the host. The initial estimate is the mean of all observations.

    Args:
        feature_ids: (T, M) int the filter's landmark id of each feature, -1 for none.
        poses: (T, 3) [m, m, rad] estimated by the filter, map frame.
        features: [T] features that the filter was given, robot frame.
        min_observations: Smallest number of observations of a landmark; others are left out.
        capacity: L, to give several logs the same shape; by default the number of landmarks, at
            least 1.

    Raises:
        ValueError: The shapes or kinds do not fit, `min_observations` is below 1, or there are more
            than `capacity` landmarks.
    """
    ids = np.asarray(as_index("feature_ids", feature_ids, ("T", "M")))
    if not isinstance(features, Features):
        raise ValueError(f"features is a {type(features).__name__}, not Features")
    check_array("features.kind", np.asarray(features.kind), ids.shape, jnp.integer)
    as_float64("poses", poses, (len(ids), 3))
    if min_observations < 1:
        raise ValueError(f"min_observations is {min_observations}, not 1 or more")
    kept_ids, count = np.unique(ids[ids >= 0], return_counts=True)
    kept_ids = kept_ids[count >= min_observations]
    capacity = max(len(kept_ids), 1) if capacity is None else capacity
    if len(kept_ids) > capacity:
        raise ValueError(f"{len(kept_ids)} landmarks are more than capacity = {capacity}")
    index = np.where(np.isin(ids, kept_ids), np.searchsorted(kept_ids, ids), capacity)
    positions = _mean_positions(index, np.asarray(poses), features, capacity)
    padded = np.pad(kept_ids, (0, capacity - len(kept_ids)), constant_values=-1)
    return NumberedLandmarks(
        landmark_index=on_device(index.astype(np.int32)),
        positions=jax.device_put(positions),
        id=on_device(padded.astype(np.int32)),
    )


def _mean_positions(
    index: np.ndarray, poses: np.ndarray, features: Features, size: int
) -> np.ndarray:
    """Mean (L, 2) of the observations of each landmark, map frame.

    Directions of walls are undirected lines: they are averaged as unit vectors at twice the angle.
    """
    kept = index < size
    landmark, is_wall = index[kept], (np.asarray(features.kind) == WALL)[kept]
    angle = (np.asarray(features.direction) + poses[:, 2:])[kept]
    doubled = np.stack([np.cos(2 * angle), np.sin(2 * angle)], axis=-1)
    points = transform(poses[:, None], np.asarray(features.xy))[kept]
    total = np.zeros((size, 2), points.dtype)
    np.add.at(total, landmark, np.where(is_wall[:, None], doubled, points))
    positions = total / np.maximum(np.bincount(landmark, minlength=size), 1)[:, None]
    walls = landmark[is_wall]
    positions[walls, 0] = np.arctan2(total[walls, 1], total[walls, 0]) / 2
    positions[walls, 1] = 0.0
    return positions.astype(total.dtype)
