"""Landmarks of a filtered log numbered without gaps, as the smoother wants them."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxslam.core.features import Features
from jaxslam.core.se2_np import transform
from jaxslam.core.types import WALL, Array, check_array


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
    feature_ids: Array,
    poses: Array,
    features: Features,
    *,
    min_observations: int = 2,
    capacity: int | None = None,
) -> NumberedLandmarks:
    """Number the landmarks of a filtered log by their ids, which unlike slots are never reused.

    Computed on the host. The initial estimate is the mean of all observations.

    Args:
        feature_ids: (T, M) int32 the filter's landmark id of each feature, -1 for none.
        poses: (T, 3) [m, m, rad] estimated by the filter, map frame.
        features: [T] features that the filter was given, base_link frame.
        min_observations: Smallest number of observations of a landmark; others are left out.
        capacity: L, to give several logs the same shape; by default the number of landmarks, at
            least 1.

    Raises:
        ValueError: The shapes do not fit, or there are more than `capacity` landmarks.
    """
    check_array("id", feature_ids, features.kind.shape, jnp.int32)
    check_array("poses", poses, features.kind.shape[:1] + (3,), jnp.floating)
    ids = np.asarray(feature_ids)
    kept_ids, count = np.unique(ids[ids >= 0], return_counts=True)
    kept_ids = kept_ids[count >= min_observations]
    capacity = max(len(kept_ids), 1) if capacity is None else capacity
    if len(kept_ids) > capacity:
        raise ValueError(f"{len(kept_ids)} landmarks are more than size = {capacity}")
    which = np.where(np.isin(ids, kept_ids), np.searchsorted(kept_ids, ids), capacity)
    positions = _mean_positions(which, np.asarray(poses), features, capacity)
    padded = np.pad(kept_ids, (0, capacity - len(kept_ids)), constant_values=-1)
    return NumberedLandmarks(
        landmark_index=jnp.asarray(which, jnp.int32),
        positions=jnp.asarray(positions),
        id=jnp.asarray(padded, jnp.int32),
    )


def _mean_positions(which: np.ndarray, poses: np.ndarray, nodes: Features, size: int) -> np.ndarray:
    """Mean (L, 2) of the observations of each landmark, map frame.

    Directions of walls are undirected lines: they are averaged as unit vectors at twice the angle.
    """
    kept = which < size
    kept_which, is_wall = which[kept], (np.asarray(nodes.kind) == WALL)[kept]
    angle = (np.asarray(nodes.direction) + poses[:, 2:])[kept]
    doubled = np.stack([np.cos(2 * angle), np.sin(2 * angle)], axis=-1)
    points = transform(poses[:, None], np.asarray(nodes.xy))[kept]
    total = np.zeros((size, 2), points.dtype)
    np.add.at(total, kept_which, np.where(is_wall[:, None], doubled, points))
    positions = total / np.maximum(np.bincount(kept_which, minlength=size), 1)[:, None]
    walls = kept_which[is_wall]
    positions[walls, 0] = np.arctan2(total[walls, 1], total[walls, 0]) / 2
    positions[walls, 1] = 0.0
    return positions.astype(total.dtype)
