"""Joint covariance of pose and map in blocks, and linearised measurements of single landmarks."""

from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.core.linalg import add_outer_products
from jaxslam.core.types import Array
from jaxslam.filtering.covariance import DeferredCovariance


class CovarianceBlocks(NamedTuple):
    """A symmetric matrix over pose and map, D = 3 + 2 L.

    Attributes:
        pose: (3, 3) block of the pose, [m, m, rad].
        cross: (3, 2 L) block of pose and map.
        map: (2 L, 2 L) block of the map; dense or deferred.
    """

    pose: Array
    cross: Array
    map: Array | DeferredCovariance


class LinearizedMeasurements(NamedTuple):
    """Linearised measurements; zero rows with unit noise change nothing.

    Attributes:
        residual: (M, 2) v, measured minus predicted: range [m] and bearing [rad], or the direction
            of a wall [rad] and 0.
        H_pose: (M, 2, 3) H, derivative of the prediction by the pose.
        H_landmark: (M, 2, 2) H, derivative of the prediction by the landmark's two numbers.
        R: (M, 2, 2) R, covariance of the measurement; identity where unmatched.
        slot: (M,) int32 slot of the landmark, below L; measurements that count have different ones.
    """

    residual: Array
    H_pose: Array
    H_landmark: Array
    R: Array
    slot: Array


def add_block_products(
    cov: CovarianceBlocks, left: tuple[Array, Array], right: tuple[Array, Array], *, sign: int = 1
) -> CovarianceBlocks:
    """Update of low rank, cov + sign left^T right.

    Args:
        cov: The covariance; its map must be dense.
        left: Columns of the pose (k, 3) and of the map (k, 2 L).
        right: Likewise.
        sign: 1 or -1.

    Raises:
        ValueError: The covariance of the map is deferred; while tracing.
    """
    if isinstance(cov.map, DeferredCovariance):
        raise ValueError("cov.map is deferred: flush it before an update of the whole map")
    return CovarianceBlocks(
        pose=add_outer_products(cov.pose, left[0], right[0], sign=sign),
        cross=add_outer_products(cov.cross, left[0], right[1], sign=sign),
        map=add_outer_products(cov.map, left[1], right[1], sign=sign),
    )


def mask_measurements(rows: LinearizedMeasurements, keep: Array) -> LinearizedMeasurements:
    """Measurements of which those that are not kept, (M,) bool, change nothing."""
    keep = keep[:, None, None]
    return rows._replace(
        residual=jnp.where(keep[..., 0], rows.residual, 0.0),
        H_pose=jnp.where(keep, rows.H_pose, 0.0),
        H_landmark=jnp.where(keep, rows.H_landmark, 0.0),
        R=jnp.where(keep, rows.R, jnp.eye(2, dtype=rows.R.dtype)),
    )
