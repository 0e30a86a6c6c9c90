"""Rooms, corridors and halls of an occupancy map, and the doors between them.

The steps of `find_regions`:

    free space, small free-standing obstacles (furniture) filled
    -> gaps between walls that face each other (`gaps`), the doors among them (`doors`)
    -> parts between doors, small ones merged (`region_merging`) -> outlines (`region_outline`)
    -> names, those of an earlier division where they fit (`region_names`)
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from jaxslam.core.maps import OccupancyMap, check_occupancy
from jaxslam.core.regions import Door, Region, Regions
from jaxslam.core.se2_np import transform
from jaxslam.core.types import as_size, check_type
from jaxslam.mapping import medial_axis, region_names
from jaxslam.mapping.doors import find_doors
from jaxslam.mapping.gaps import Gaps, take
from jaxslam.mapping.region_merging import divide, largest
from jaxslam.mapping.region_outline import outlines

FURNITURE_SIZE = 1.0  # [m] of a free-standing obstacle that divides no room
MIN_AREA = 1.0  # [m^2] of a region
MIN_CLOSED_AREA = 5.0  # [m^2] of a region without a door
CORRIDOR_LENGTH = 3.0  # length of a corridor, at least, relative to its width
CORRIDOR_WIDTH = 4.0  # [m] of most of a corridor, at most
WIDER_SHARE = 0.25  # of a corridor that may be wider than its length allows, less than
OUTSIDE_SHARE = 0.5  # of the border of a grid that lies outside, more than
HALL_AREA = 50.0  # [m^2] of a hall, at least, or
HALL_WIDTH = 7.0  # [m] of the largest circle in it, at least
OBSTACLE_WIDTH = 4.0  # [m] of a free-standing obstacle, at most: a table, a shelf, a pillar
OBSTACLE_SHARE = 0.5  # of the area of the region around it, less than
_EIGHT = np.ones((3, 3), bool)


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

    A region is free space in which the robot fits, at least `MIN_AREA` large (`MIN_CLOSED_AREA`
    without a door), whether or not the robot fits through its doors. Small free-standing obstacles
    belong to the region around them, but not to its area; so does the space between large ones and
    the walls. Free space along most of the border of
    the grid, on all four sides, is outside, no region, unless there is no other region.

    A corridor is long for its width, and narrow: little of it is wider than its length allows. A
    hall is no corridor, and large or wide; all else is a room. Tables, shelves and pillars that
    stand free in a region make it neither narrower nor smaller for that; the block that a ring of
    corridors leads around does.

    Args:
        occupied: (H, W) bool; i grows with x, j with y.
        free: (H, W) bool; a cell that is neither is unknown, and bounds regions like a wall.
        resolution: [m] side of a cell, from `MIN_RESOLUTION` to `MAX_RESOLUTION` of `core.maps`.
        origin: (3,) [m, m, rad] pose of the corner of cell [0, 0] in the map frame.
        robot_radius: [m] of the robot, more than 0.
        previous: Regions of the same place, found earlier, whose names are kept; of these, only
            names, polygons, doors and `last_numbers` matter.

    Raises:
        ValueError: An argument has another type, shape or range.

    References:
        Bormann, Jordan, Li, Hampp, Haegele (2016), on room segmentation, ICRA: the problem and its
        benchmark. Mielle, Magnusson, Lilienthal (2018), A method to segment maps from different
        modalities using free space layout.
    """
    given: Any = occupied, free, resolution, origin
    occupied, free, resolution, origin, _ = check_occupancy(OccupancyMap(*given), name="")
    robot_radius = as_size("robot_radius", robot_radius, positive=True)
    if previous is not None:
        check_type("previous", previous, Regions)
    label = np.zeros(free.shape, np.int32)
    free = np.asarray(free & ~occupied)
    if not free.any():
        return region_names.named(Regions(label, (), (), resolution, origin), previous)
    (box,) = ndimage.find_objects(free.astype(np.int8))
    space, distance, nearest = _space(occupied[box], free[box], resolution)
    around_box = tuple(slice(side.start, side.stop + 2) for side in box)  # of the padded grid
    gaps = find_doors(space, distance, nearest, resolution=resolution)
    cells, sides = divide(
        space,
        distance,
        gaps,
        unseen=lambda: np.pad(_around(~(occupied | free)), 1)[around_box],
        min_area=MIN_AREA / resolution**2,
        min_radius=robot_radius / resolution,
        niche_area=MIN_CLOSED_AREA / resolution**2,
    )
    kept = _has_door(cells, sides, MIN_CLOSED_AREA / resolution**2)
    label[box] = cells[1:-1, 1:-1]
    kept &= ~_is_outside(label, kept)
    number = np.where(kept, np.cumsum(kept), 0).astype(np.int32)
    label, cells, sides = number[label], number[cells], number[sides]
    corner = np.array([side.start for side in box])
    gaps = gaps._replace(feet=gaps.feet - 1 + corner, middle=gaps.middle - 1.0 + corner)
    area = np.bincount(label[free], minlength=int(number.max()) + 1)[1:] * resolution**2
    has_door = np.isin(np.arange(len(area) + 1), sides[_joins(sides)])
    regions = _regions(label, area, has_door, resolution, origin)
    found = Regions(label, regions, (), resolution, origin)
    return region_names.named(_with_doors(found, gaps, sides), previous)


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
    distance, nearest = medial_axis.nearest_obstacles(space)
    return space, distance - 0.5, nearest


def _around(cells: np.ndarray) -> np.ndarray:
    """Those of some cells (H, W) bool that are connected with the border of the grid."""
    part, count = ndimage.label(cells)
    is_around = np.zeros(count + 1, bool)
    for side in (part[0], part[-1], part[:, 0], part[:, -1]):
        is_around[side] = True
    is_around[0] = False
    return np.asarray(is_around[part])


def _joins(sides: np.ndarray) -> np.ndarray:
    """Which gaps (K,) join two regions, of labels (K, 2) on their sides."""
    return np.asarray((sides > 0).all(axis=1) & (sides[:, 0] != sides[:, 1]))


def _has_door(label: np.ndarray, sides: np.ndarray, min_area: float) -> np.ndarray:
    """Which labels (L + 1,) have a door, `min_area` cells without one, or are the largest; not 0.

    Smaller ones are the insides of furniture, or what was seen through glass.

    Args:
        label: (H, W) int.
        sides: (K, 2) labels on the two sides of each gap.
        min_area: [cells]
    """
    area = np.bincount(label.ravel())
    area[0] = 0
    kept = (area >= min_area) | (area == area.max())
    kept[sides[_joins(sides)].ravel()] = True
    kept[0] = False
    return kept


def _is_outside(label: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Which of the `kept` labels (L + 1,) lie around all others: along most of the border."""
    sides = label[0], label[-1], label[1:-1, 0], label[1:-1, -1]
    counts = np.stack([np.bincount(side, minlength=len(kept)) for side in sides])
    total = sum(len(side) for side in sides)
    outside = kept & (counts.sum(axis=0) > OUTSIDE_SHARE * total) & (counts > 0).all(axis=0)
    return outside & (kept.sum() > 1)


def _to_map(points: np.ndarray, resolution: float, origin: np.ndarray) -> np.ndarray:
    """Points (..., 2) [cells, from the corner of the grid] in the map frame [m]."""
    return transform(origin, points * resolution)


def _regions(
    label: np.ndarray, area: np.ndarray, has_door: np.ndarray, resolution: float, origin: np.ndarray
) -> tuple[Region, ...]:
    """Regions of the labels, without names and doors.

    Args:
        label: (H, W) int, 0 for none.
        area: (R,) [m^2] of each region.
        has_door: (R + 1,) bool, whether each label has a door.
        resolution: [m] side of a cell.
        origin: (3,) [m, m, rad] pose of the corner of cell [0, 0] in the map frame.
    """
    found = []
    boxes = ndimage.find_objects(label, len(area))
    for k, (box, loops) in enumerate(zip(boxes, outlines(label, len(area)), strict=True)):
        cells = label[box] == k + 1
        cells = _without_obstacles(cells, has_door[label[box]] & ~cells, resolution)
        kind = _kind(cells, resolution)
        polygon, *holes = (_to_map(loop, resolution, origin) for loop in loops)
        found.append(Region("", kind, polygon, float(area[k]), (), (), tuple(holes)))
    return tuple(found)


def _without_obstacles(cells: np.ndarray, others: np.ndarray, resolution: float) -> np.ndarray:
    """Cells (H, W) bool of a region, and of the obstacles that stand free in it.

    These are its holes without a cell of a region that has a door, at most `OBSTACLE_WIDTH` wide,
    less than `OBSTACLE_SHARE` as large as the region.

    Args:
        cells: (H, W) bool of the region, in its bounding box.
        others: (H, W) bool of other regions that have a door.
        resolution: [m] side of a cell.
    """
    part, count = ndimage.label(np.pad(~cells, 1, constant_values=True), structure=_EIGHT)
    if count == 1:
        return cells
    hole = part[1:-1, 1:-1]
    is_obstacle = np.bincount(hole.ravel(), minlength=count + 1) < OBSTACLE_SHARE * cells.sum()
    is_obstacle[hole[others]] = False
    is_obstacle[[0, part[0, 0]]] = False
    if not is_obstacle.any():
        return cells
    distance = ndimage.distance_transform_edt(is_obstacle[hole])
    is_obstacle &= 2.0 * largest(distance, hole, count) - 1.0 <= OBSTACLE_WIDTH / resolution + 1e-9
    return np.asarray(cells | is_obstacle[hole])


def _kind(cells: np.ndarray, resolution: float) -> str:
    """Kind of a region of some cells (H, W) bool.

    A strip of the area A that is n times as long as wide has the width sqrt(A / n).
    """
    cells = np.pad(cells, 1)
    distance = ndimage.distance_transform_edt(cells) - 0.5
    most_wide = np.sqrt(cells.sum() / CORRIDOR_LENGTH)
    is_long = _share(cells, distance, most_wide) < WIDER_SHARE
    if is_long and _share(cells, distance, CORRIDOR_WIDTH / resolution) < 0.5:
        return "corridor"
    is_wide = _largest_circle(distance) * resolution >= HALL_WIDTH - 1e-9
    return "hall" if is_wide or cells.sum() * resolution**2 >= HALL_AREA - 1e-9 else "room"


def _largest_circle(distance: np.ndarray) -> float:
    """Width [cells] of the largest circle, around the middle of a cell or a corner of four.

    Args:
        distance: (H, W) [cells] from the middle of a cell to the nearest edge of an obstacle.
    """
    around_corner = ndimage.minimum_filter(distance, size=2).max() + 0.5
    return 2.0 * float(max(distance.max(), around_corner))


def _share(cells: np.ndarray, distance: np.ndarray, width: float) -> float:
    """Share of cells (H, W) bool in circles of a width [cells] that fit between the others.

    Args:
        cells: (H, W) bool.
        distance: (H, W) [cells] to the edge of the nearest other cell.
        width: [cells]
    """
    middle = distance >= 0.5 * width
    if not middle.any():
        return 0.0
    covered = ndimage.distance_transform_edt(~middle) - 0.5 <= 0.5 * width
    return float((cells & covered).sum() / cells.sum())


def _with_doors(found: Regions, gaps: Gaps, sides: np.ndarray) -> Regions:
    """Regions with the gaps that join two of them as doors; `sides` (K, 2) are their labels."""
    joins = _joins(sides)
    gaps, pairs = take(gaps, joins), np.sort(sides[joins] - 1, axis=1)
    ends = gaps.feet + 0.5
    ends = ends + 0.5 * gaps.along[:, None] * np.array([1.0, -1.0])[:, None]
    jambs = _to_map(ends, found.resolution, found.origin)
    doors = tuple(
        Door("", jamb.mean(axis=0), jamb, float(width) * found.resolution, (int(a), int(b)))
        for jamb, width, (a, b) in zip(jambs, gaps.width, pairs, strict=True)
    )
    of_region: list[list[int]] = [[] for _ in found.regions]
    neighbours: list[set[int]] = [set() for _ in found.regions]
    for k, (a, b) in enumerate(pairs.tolist()):
        for here, there in ((a, b), (b, a)):
            of_region[here].append(k)
            neighbours[here].add(there)
    regions = tuple(
        region._replace(doors=tuple(of_region[k]), neighbours=tuple(sorted(neighbours[k])))
        for k, region in enumerate(found.regions)
    )
    return found._replace(regions=regions, doors=doors)
