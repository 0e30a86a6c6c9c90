"""Polylines in JAX and in NumPy: length, resampling, projection."""

import jax.numpy as jnp
import numpy as np

from jaxslam.core.types import Array


def resample(way: Array, count: int) -> Array:
    """Points (count, 2) [m] at equal distances along a polyline (n, 2) [m], its ends included."""
    size = jnp.sqrt(jnp.sum(jnp.diff(way, axis=0) ** 2, axis=1))
    along = jnp.concatenate([jnp.zeros(1, size.dtype), jnp.cumsum(size)])
    wanted = along[-1] * jnp.linspace(0.0, 1.0, count, dtype=size.dtype)
    return jnp.stack([jnp.interp(wanted, along, way[:, k]) for k in range(2)], axis=1)


DEFAULT_POINTS = 9  # points to which a polyline is resampled to be compared, and of a driven arc


def length(line: np.ndarray) -> np.ndarray:
    """Length (...) [m] of polylines (..., n, 2)."""
    return np.linalg.norm(np.diff(line, axis=-2), axis=-1).sum(axis=-1)


def cumulative_lengths(line: np.ndarray) -> np.ndarray:
    """Length (n,) [m] along a polyline (n, 2) from its first point to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def resample_np(line: np.ndarray, count: int = DEFAULT_POINTS) -> np.ndarray:
    """Points (count, 2) at equal distances along a polyline (n, 2) [m], its ends included."""
    at_point = cumulative_lengths(line)
    wanted = np.linspace(0.0, at_point[-1], count)
    return np.stack([np.interp(wanted, at_point, line[:, axis]) for axis in range(2)], axis=1)


def project(points: np.ndarray, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest points on a polyline.

    Args:
        points: (M, 2) [m].
        line: (n >= 2, 2) [m].

    Returns:
        Distance (M,) [m] of each point from the polyline, and the length (M,) [m] along the
        polyline at which the nearest point lies.
    """
    start, step = line[:-1], np.diff(line, axis=0)
    squared_length = np.maximum(np.sum(step**2, axis=1), 1e-12)
    fraction = np.sum((points[:, None] - start) * step, axis=2) / squared_length
    fraction = np.clip(fraction, 0.0, 1.0)  # (M, n - 1) of each segment, to the foot of the normal
    distance = np.linalg.norm(start + fraction[..., None] * step - points[:, None], axis=2)
    nearest = np.argmin(distance, axis=1)
    segment_length = np.sqrt(np.sum(step**2, axis=1))
    before = np.concatenate([[0.0], np.cumsum(segment_length)])
    rows = np.arange(len(points))
    along_line = before[nearest] + fraction[rows, nearest] * segment_length[nearest]
    return distance[rows, nearest], along_line
