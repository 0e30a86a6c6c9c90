"""Rooms, corridors and halls of an occupancy map, and the doors between them.

    free space, small free-standing obstacles (furniture) filled
    -> gaps between walls that face each other (`gaps`), the doors among them (`doors`)
    -> parts between doors, small ones merged (`region_merging`) -> outlines (`region_outline`)
    -> names, those of an earlier division where they fit (`region_names`)
"""

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from jaxslam.core.regions import Door, Region, Regions
from jaxslam.core.se2_np import transform
from jaxslam.core.types import as_float64, check_array
from jaxslam.mapping import medial_axis, region_names
from jaxslam.mapping.doors import find_doors
from jaxslam.mapping.gaps import Gaps, take
from jaxslam.mapping.region_merging import divide
from jaxslam.mapping.region_outline import outlines

FURNITURE_SIZE = 1.0  # [m] of a free-standing obstacle that divides no room
MIN_AREA = 1.5  # [m^2] of a region
CORRIDOR_LENGTH = 3.0  # length of a corridor, at least, relative to its largest width
HALL_AREA = 50.0  # [m^2] of a hall, at least


def find_regions(
    occupied: ArrayLike,
    free: ArrayLike,
    *,
    resolution: float,
    origin: ArrayLike,
    robot_radius: float = 0.25,
    previous: Regions | None = None,
) -> Regions:
    """Divide the free space of an occupancy map into regions at its doors.

    A region is free space in which the robot fits, at least `MIN_AREA` large, whether or not the
    robot fits through its doors. Small free-standing obstacles belong to the region around them
    (not to its area). Free space that reaches all four sides of the grid is outside, no region.

    Args:
        occupied: (H, W) bool; i grows with x, j with y.
        free: (H, W) bool; a cell that is neither is unknown, and bounds regions like a wall.
        resolution: [m] side of a cell.
        origin: (3,) [m, m, rad] pose of the corner of cell [0, 0] in the map frame.
        robot_radius: [m] of the robot.
        previous: Regions of the same place, found earlier, whose names are kept; of these, only
            names, polygons, doors and `last_numbers` matter.

    Raises:
        ValueError: An argument has another type, shape or range.

    References:
        Bormann, Jordan, Li, Hampp, Haegele (2016), Room segmentation: survey, implementation, and
        analysis. Mielle, Magnusson, Lilienthal (2018), A method to segment maps from different
        modalities using free space layout.
    """
    occupied, free = np.asarray(occupied), np.asarray(free)
    check_array("occupied", occupied, ("H", "W"), jnp.bool_)
    check_array("free", free, occupied.shape, jnp.bool_)
    origin = as_float64("origin", origin, (3,))
    for name, size in (("resolution", resolution), ("robot_radius", robot_radius)):
        if not 0.0 < size < np.inf:
            raise ValueError(f"{name} is {size}, not a positive number of metres")
    label = np.zeros(free.shape, np.int32)
    empty = Regions(label, (), (), resolution, origin)
    free = free & ~occupied
    boxes = ndimage.find_objects(free.astype(np.int8))
    if not boxes:
        return region_names.named(empty, previous)
    box = boxes[0]
    space, distance, nearest = _space(occupied[box], free[box], resolution)
    gaps = find_doors(space, distance, nearest, resolution=resolution)
    cells, sides = divide(
        space,
        distance,
        gaps,
        min_area=MIN_AREA / resolution**2,
        min_radius=robot_radius / resolution,
    )
    inside = cells[1:-1, 1:-1]
    if inside.shape == label.shape:
        sides = _without_outside(inside, sides)
    label[box] = inside
    corner = np.array([side.start for side in box])
    gaps = gaps._replace(feet=gaps.feet - 1 + corner, middle=gaps.middle - 1.0 + corner)
    radius = ndimage.maximum(distance, cells, np.arange(1, cells.max(initial=0) + 1))
    area = np.bincount(label[free], minlength=len(radius) + 1)[1:] * resolution**2
    regions = empty._replace(
        regions=_regions(label, area, np.asarray(radius) * resolution, resolution, origin)
    )
    return region_names.named(_with_doors(regions, gaps, sides), previous)


def _space(
    occupied: np.ndarray, free: np.ndarray, resolution: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Free space without furniture, with a border that is not free.

    Returns:
        Free cells (H + 2, W + 2) bool, their distance [cells] to the nearest obstacle and its
        indices (2, H + 2, W + 2).
    """
    size = FURNITURE_SIZE / resolution
    space = medial_axis.free_space(occupied, free, min_obstacle_size=size, min_unknown_size=size)
    space = np.pad(space, 1)
    distance, nearest = ndimage.distance_transform_edt(space, return_indices=True)
    return space, distance - 0.5, nearest


def _without_outside(label: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Take the region that reaches all four sides out of `label`, in place, and out of `sides`."""
    borders = (label[0], label[-1], label[:, 0], label[:, -1])
    outside = set.intersection(*(set(np.unique(b).tolist()) for b in borders)) - {0}
    if not outside:
        return sides
    number = np.arange(label.max() + 1)
    number[list(outside)] = 0
    kept = number > 0
    number[kept] = np.arange(1, kept.sum() + 1)
    label[:] = number[label]
    return number[sides]


def _to_map(points: np.ndarray, resolution: float, origin: np.ndarray) -> np.ndarray:
    """Points (..., 2) [cells, from the corner of the grid] in the map frame [m]."""
    return transform(origin, points * resolution)


def _regions(
    label: np.ndarray,
    area: np.ndarray,
    radius: np.ndarray,
    resolution: float,
    origin: np.ndarray,
) -> tuple[Region, ...]:
    """Regions of the labels, without names and doors; `area` [m^2] and `radius` [m] of each."""
    found = []
    for k, polygon in enumerate(outlines(label, len(area))):
        long = area[k] >= CORRIDOR_LENGTH * (2.0 * radius[k]) ** 2
        kind = "corridor" if long else "hall" if area[k] >= HALL_AREA else "room"
        found.append(
            Region("", kind, _to_map(polygon, resolution, origin), float(area[k]), (), ())
        )
    return tuple(found)


def _with_doors(found: Regions, gaps: Gaps, sides: np.ndarray) -> Regions:
    """Regions with the gaps that join two of them as doors; `sides` (K, 2) are their labels."""
    joins = (sides > 0).all(axis=1) & (sides[:, 0] != sides[:, 1])
    gaps, pairs = take(gaps, joins), np.sort(sides[joins] - 1, axis=1)
    ends = gaps.feet + 0.5
    ends = ends + 0.5 * gaps.along[:, None] * np.array([1.0, -1.0])[:, None]
    jambs = _to_map(ends, found.resolution, found.origin)
    doors = tuple(
        Door("", jamb.mean(axis=0), jamb, float(width) * found.resolution, (int(a), int(b)))
        for jamb, width, (a, b) in zip(jambs, gaps.width, pairs, strict=True)
    )
    regions = tuple(
        region._replace(
            doors=tuple(np.flatnonzero((pairs == k).any(axis=1)).tolist()),
            neighbours=tuple(np.unique(pairs[(pairs == k).any(axis=1)]).tolist()),
        )
        for k, region in enumerate(found.regions)
    )
    regions = tuple(
        region._replace(neighbours=tuple(n for n in region.neighbours if n != k))
        for k, region in enumerate(regions)
    )
    return found._replace(regions=regions, doors=doors)
