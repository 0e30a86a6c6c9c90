"""Polylines, of JAX arrays or of NumPy arrays: length, resampling, projection.

`resample` and `points_along` take both kinds: JAX arrays, traced ones too, give JAX arrays, and
everything else gives NumPy arrays. The other functions are for the host alone.
"""

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    import jax

ArrayT = TypeVar("ArrayT", "jax.Array", np.ndarray)

DEFAULT_POINTS = 9
"""Points to which a polyline is resampled to be compared, and points of a driven arc."""


def length(line: np.ndarray) -> np.ndarray:
    """Length (...) [m] of polylines (..., n, 2)."""
    return np.linalg.norm(np.diff(line, axis=-2), axis=-1).sum(axis=-1)


def cumulative_lengths(line: np.ndarray) -> np.ndarray:
    """Length (n,) [m] along a polyline (n, 2) from its first point to each of its points."""
    return np.asarray(_cumulative_lengths(np, np.asarray(line)))


def resample(line: ArrayT, count: int = DEFAULT_POINTS) -> ArrayT:
    """Points (count, 2) [m] at equal distances along a polyline (n, 2) [m], its ends included."""
    xp, points = _module(line)
    at_point = _cumulative_lengths(xp, points)
    if xp is np:
        return _interpolate(np, points, at_point, np.linspace(0.0, float(at_point[-1]), count))
    fraction = xp.linspace(0.0, 1.0, count, dtype=at_point.dtype)
    return _interpolate(xp, points, at_point, at_point[-1] * fraction)


def points_along(line: ArrayT, distances: ArrayLike) -> ArrayT:
    """Points (N, 2) [m] at `distances` (N,) [m] along a polyline (n, 2) [m] from its first point.

    Distances below zero give the first point, those beyond the end the last one.
    """
    xp, points = _module(line)
    return _interpolate(xp, points, _cumulative_lengths(xp, points), xp.asarray(distances))


def _module(line: Any) -> tuple[Any, Any]:
    """The array module of a polyline, as the array API standard has it, and its array."""
    xp = getattr(line, "__array_namespace__", lambda: np)()
    return xp, xp.asarray(line)


def _cumulative_lengths(xp: Any, line: Any) -> Any:
    """As `cumulative_lengths`, with the array module of the polyline."""
    step = xp.linalg.norm(xp.diff(line, axis=0), axis=1)
    return xp.concatenate([xp.zeros(1, step.dtype), xp.cumsum(step)])


def _interpolate(xp: Any, line: Any, at_point: Any, wanted: Any) -> Any:
    """Points (N, 2) at lengths `wanted` (N,), between points (n, 2) at the lengths `at_point`."""
    return xp.stack([xp.interp(wanted, at_point, line[:, axis]) for axis in range(2)], axis=1)


def refine(line: np.ndarray, spacing: float, least: int = 1) -> np.ndarray:
    """A polyline (n, 2) [m] with more points on its segments, `spacing` [m] apart or less.

    Args:
        line: (n >= 2, 2) [m].
        spacing: [m].
        least: Number of pieces that each segment is cut into, at least.
    """
    pieces = np.ceil(np.hypot(*np.diff(line, axis=0).T) / spacing)
    pieces = np.maximum(pieces, least).astype(int)
    segment = np.repeat(np.arange(len(pieces)), pieces)
    number = np.arange(len(segment)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    fraction = (number / pieces[segment])[:, None]
    points = line[segment] + fraction * (line[segment + 1] - line[segment])
    return np.concatenate([points, line[-1:]])


def simplify(line: np.ndarray, tolerance: float) -> np.ndarray:
    """Polyline (m, 2) of fewer points, at most `tolerance` from the given one (n, 2).

    A piece is split at its point furthest from the chord, as long as that is too far.

    References:
        Douglas, Peucker (1973), Algorithms for the reduction of the number of points required to
        represent a digitized line or its caricature.
    """
    kept, pieces = {0, len(line) - 1}, [(0, len(line) - 1)]
    while pieces:
        first, last = pieces.pop()
        if last - first < 2:
            continue
        step, offset = line[last] - line[first], line[first + 1 : last] - line[first]
        share = offset @ step / max(float(step @ step), 1e-12)
        share = np.minimum(np.maximum(share, 0.0), 1.0)
        distance = np.hypot(offset[:, 0] - share * step[0], offset[:, 1] - share * step[1])
        furthest = first + 1 + int(distance.argmax())
        if distance[furthest - first - 1] > tolerance:
            kept.add(furthest)
            pieces += [(first, furthest), (furthest, last)]
    return line[sorted(kept)]


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
