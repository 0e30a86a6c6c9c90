"""Index of a map for place recognition: where its walls are, and where a robot may stand.

It is made once of the keyframes of a map, on the host. All look-ups are by cell, so a query costs
the same for each pose that is tried, however many keyframes have seen the place:

    surface of a cell: the nearest surface point s of any keyframe, and its normal n
    positions:         free ones on and beside the path, `PlaceSpec.position_spacing` apart
    views:             what a scanner would measure at each position, see `place_views`

Normals point to where the surface was seen from; so the two sides of a wall are different.
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import scipy

from jaxslam.core.batching import on_device, pad_to
from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.types import AnyArray, Array, as_float64
from jaxslam.matching import checks
from jaxslam.matching.oriented_points import (
    OrientedPoints,
    oriented_points,
    towards_scanner,
    transform_points,
)
from jaxslam.matching.place_views import views_of_map

MARGIN = 2.0
"""[m] of the grid around all that the keyframes saw."""

GRID_BLOCK = 128
"""Numbers of cells are multiples of this, so that maps of about one size share a program."""

POSITION_BLOCK = 256
"""The same for the number of positions."""

KEYFRAME_BLOCK = 64
"""The same for the number of keyframes."""

PATH_GAP = 3.0
"""[m] between two keyframes that follow each other, up to which the robot drove straight."""


class PlaceSpec(NamedTuple):
    """Options of place recognition; static under jit.

    Attributes:
        cell: [m] side of a cell of the grid.
        position_spacing: [m] between two positions of the index.
        position_offset: [m] from the path up to which there are positions.
        min_clearance: [m] least distance of a position from any wall.
        max_points: Points of a query.
        coarse_points: Those of them, evenly spaced, that most poses are scored by.
        coarse_std: [m] of a point's distance from a wall in that score.
        num_views: Poses, those whose views agree best, that are scored with these points.
        num_coarse: Poses, the best of those, that are refined with these points.
        num_fine: Poses, the best of those, that are refined with all points.
        coarse_gates: [m] largest distance of a point from its wall, iteration by iteration.
        fine_gates: [m] the same in the second refinement.
        std: [m] of a point's distance from a wall in the final score.
        num_candidates: C, places that are returned.
        distinct: [m], [rad] beyond which two poses are different places.
        margin_weight: Of the margin in the certainty of a place, see `Places`.
        max_margin: Margin beyond which certainty does not increase.
        min_certainty: Least certainty of a place that is accepted.
        min_margin: Least margin of a place that is accepted.
    """

    cell: float = 0.1
    position_spacing: float = 0.4
    position_offset: float = 0.6
    min_clearance: float = 0.2
    max_points: int = 120
    coarse_points: int = 40
    coarse_std: float = 0.4
    num_views: int = 1024
    num_coarse: int = 256
    num_fine: int = 48
    coarse_gates: tuple[float, ...] = (0.6, 0.45, 0.3)
    fine_gates: tuple[float, ...] = (0.2, 0.15, 0.1, 0.1)
    std: float = 0.05
    num_candidates: int = 4
    distinct: tuple[float, float] = (0.5, 0.17)
    margin_weight: float = 3.0
    max_margin: float = 0.15
    min_certainty: float = 0.96
    min_margin: float = 0.03


class PlaceIndex(NamedTuple):
    """Index of a map; G x H cells, N positions; K, F as in `place_views`.

    Attributes:
        origin: (2,) [m] corner of the grid: cell (i, j) is around origin + cell (i, j).
        distance: (G, H) [m] to the nearest surface point.
        normal: (G, H, 2) unit normal of that surface, to where it was seen from.
        offset: (G, H) [m] n^T (s - origin).
        positions: (N, 2) [m] map frame.
        views: (2, K, N, F) spectra of what a scanner would measure there.
        valid: (N,) bool, the positions that exist.
    """

    origin: Array
    distance: Array
    normal: Array
    offset: Array
    positions: Array
    views: Array
    valid: Array


def build_index(spec: PlaceSpec, lidar: Lidar, poses: AnyArray, scans: Scan) -> PlaceIndex:
    """Index of a map.

    Args:
        spec: Options.
        lidar: The scanner.
        poses: (K, 3) [m, m, rad] of the keyframes, map frame.
        scans: [K] of the keyframes.

    Raises:
        ValueError: An option is out of range, there is no keyframe, or poses and scans are not K
            each, those of this lidar, and finite.
    """
    check_place_spec(spec)
    check_lidar(lidar)
    poses = as_float64("poses", poses, ("K", 3))
    scans = checks.as_scans("scans", lidar, scans, (len(poses),))
    if not len(poses) or not np.isfinite(poses).all():
        raise ValueError("poses are those of no keyframe, or not finite")
    # The last keyframe again changes nothing, and few numbers of keyframes are compiled.
    padded = pad_to((poses, scans), to=len(poses) + -len(poses) % KEYFRAME_BLOCK)
    surfaces = jax.tree.map(np.asarray, _surfaces(lidar, on_device(padded[0]), padded[1]))
    seen = surfaces.valid
    points, normals = (x[seen].astype(float) for x in (surfaces.points, surfaces.normal))
    everything = np.concatenate([points, poses[:, :2]])
    low, high = everything.min(axis=0) - MARGIN, everything.max(axis=0) + MARGIN
    size = GRID_BLOCK * np.ceil((high - low) / spec.cell / GRID_BLOCK).astype(int)
    distance, normal, offset = _nearest_surfaces(spec, size, points - low, normals)
    positions = _positions(spec, poses[:, :2], low, distance)
    padding = -len(positions) % POSITION_BLOCK
    valid = np.arange(len(positions) + padding) < len(positions)
    positions = pad_to(positions, to=len(valid))
    table = on_device(distance)
    return PlaceIndex(
        origin=on_device(low),
        distance=table,
        normal=on_device(normal),
        offset=on_device(offset),
        positions=on_device(positions),
        views=views_of_map(spec.cell, table, on_device(positions - low)),
        valid=on_device(valid),
    )


def check_place_spec(spec: PlaceSpec) -> None:
    """Check the options of place recognition.

    Raises:
        ValueError: One is out of range; the message names it.
    """
    checks.check_static("spec", spec, PlaceSpec)
    for field in ("cell", "position_spacing", "coarse_std", "std"):
        checks.check_positive(f"spec.{field}", getattr(spec, field))
    counts = "max_points coarse_points num_views num_coarse num_fine num_candidates"
    for field in counts.split():
        checks.check_at_least(f"spec.{field}", getattr(spec, field), 1)
    for field in ("coarse_gates", "fine_gates"):
        for gate in getattr(spec, field):
            checks.check_positive(f"spec.{field}", gate)


@partial(jax.jit, static_argnames="lidar")
def _surfaces(lidar: Lidar, poses: Array, scans: Scan) -> OrientedPoints:
    """Oriented points [K] of scans [K] at poses (K, 3), normals to where they were seen from."""
    points = towards_scanner(jax.vmap(partial(oriented_points, lidar))(scans))
    return jax.vmap(transform_points)(poses, points)


def _nearest_surfaces(
    spec: PlaceSpec, size: np.ndarray, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance (G, H), normal (G, H, 2) and offset (G, H) of the nearest surface of each cell."""
    cells = np.round(points / spec.cell).astype(int)
    point_at = np.full(size, -1)
    point_at[tuple(cells.T)] = np.arange(len(points))
    empty = point_at < 0
    if empty.all():
        return np.full(size, np.inf), np.zeros((*size, 2)), np.zeros(size)
    distance, index = scipy.ndimage.distance_transform_edt(
        empty, sampling=spec.cell, return_distances=True, return_indices=True
    )
    nearest = point_at[tuple(index)]
    normal = normals[nearest]
    return distance, normal, np.sum(normal * points[nearest], axis=-1)


def _positions(
    spec: PlaceSpec, path: np.ndarray, low: np.ndarray, distance: np.ndarray
) -> np.ndarray:
    """Positions (N, 2) [m] where a robot may stand: on the path (K, 2), and free ones beside it."""
    steps = int(np.ceil(spec.position_offset / spec.position_spacing))
    offsets = spec.position_spacing * np.arange(-steps, steps + 1)
    beside = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), axis=-1).reshape(-1, 2)
    beside = beside[np.hypot(*beside.T) <= spec.position_offset]
    cells = np.round(_driven(path, spec.position_spacing / 2) / spec.position_spacing).astype(int)
    around = spec.position_spacing * np.unique(cells, axis=0)[:, None] + beside[None]
    around = np.unique(np.round(around.reshape(-1, 2), 6), axis=0)
    index = np.round((around - low) / spec.cell).astype(int)
    index = index.clip(0, np.array(distance.shape) - 1)
    return around[distance[tuple(index.T)] >= spec.min_clearance]


def _driven(path: np.ndarray, spacing: float) -> np.ndarray:
    """Points on a path (K, 2) [m], `spacing` apart where its points follow each other closely."""
    step = np.hypot(*np.diff(path, axis=0).T)
    pieces = [path]
    for start, end, length in zip(path[:-1], path[1:], step, strict=True):
        if spacing < length <= PATH_GAP:
            share = np.arange(spacing, length, spacing)[:, None] / length
            pieces.append(start + share * (end - start))
    return np.concatenate(pieces)
