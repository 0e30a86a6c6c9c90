"""Names of regions and doors that stay when a map is made again, or grows."""

import re
from collections.abc import Sequence

import numpy as np

from jaxslam.core.pairing import one_to_one
from jaxslam.core.regions import Door, Regions, contains, outer_first
from jaxslam.core.se2_np import inverse_transform, transform

MIN_OVERLAP = 0.5  # of the smaller of two regions that are the same one
DOOR_DISTANCE = 0.5  # [m] between doors that are the same one, at most


def named(found: Regions, previous: Regions | None = None) -> Regions:
    """Name the regions `room_N` and the doors `door_N`, and sort both by N.

    A region keeps the name of the earlier one that it shares most cells with, if these are half of
    the smaller of the two; each name is given once, those with the largest overlap first. A door
    keeps the name of the nearest earlier one. All others get numbers that were never used, large
    regions first, and doors in the order of their regions.

    Args:
        found: Regions whose names do not matter.
        previous: Regions of the same place, found earlier.
    """
    old = Regions(found.label, (), (), 1.0, np.zeros(3)) if previous is None else previous
    room_numbers = [number_of(region.name) for region in old.regions]
    door_numbers = [number_of(door.name) for door in old.doors]
    last_room = max([old.last_numbers[0], *room_numbers])
    last_door = max([old.last_numbers[1], *door_numbers])
    order = np.argsort([-region.area for region in found.regions], kind="stable")
    rooms = _numbers(_same_regions(found, old), room_numbers, last_room, order.tolist())
    found = _sorted_regions(found, rooms)
    ends = [(door.regions, *door.xy.tolist()) for door in found.doors]
    order_of_doors = sorted(range(len(ends)), key=lambda k: ends[k])
    doors = _numbers(_same_doors(found.doors, old.doors), door_numbers, last_door, order_of_doors)
    last = (max([last_room, *rooms]), max([last_door, *doors]))
    return _sorted_doors(found, doors)._replace(last_numbers=last)


def number_of(name: str) -> int:
    """N of `room_N` or `door_N`; 0 for any other name."""
    match = re.fullmatch(r"(?:room|door)_([1-9][0-9]{0,8})", name)
    return int(match[1]) if match else 0


def _numbers(
    same: dict[int, int], old: Sequence[int], last: int, order: Sequence[int]
) -> list[int]:
    """Number of each item: of the earlier one that it is, or the next after `last` in `order`."""
    numbers = {k: old[same[k]] for k in same if old[same[k]]}
    for k in order:
        if k not in numbers:
            last += 1
            numbers[k] = last
    return [numbers[k] for k in range(len(order))]


def _same_regions(found: Regions, old: Regions) -> dict[int, int]:
    """Index of the earlier region that each region is, where there is one."""
    if not old.regions:
        return {}
    earlier = _rasterised(old, found)
    both = found.label.astype(np.int64) * (len(old.regions) + 1) + earlier
    counts = np.bincount(
        both.ravel(), minlength=(len(found.regions) + 1) * (len(old.regions) + 1)
    ).reshape(len(found.regions) + 1, -1)
    sizes = counts.sum(axis=1)[1:], counts.sum(axis=0)[1:]
    shared = counts[1:, 1:]
    enough = (shared > 0) & (shared >= MIN_OVERLAP * np.minimum.outer(*sizes))
    return one_to_one(np.argwhere(enough), -shared[enough])


def _same_doors(found: Sequence[Door], old: Sequence[Door]) -> dict[int, int]:
    """Index of the earlier door that each door is, where there is one."""
    here = np.array([door.xy for door in found], float).reshape(-1, 1, 2)
    there = np.array([door.xy for door in old], float).reshape(1, -1, 2)
    distance = np.linalg.norm(here - there, axis=2)
    near = distance <= DOOR_DISTANCE
    return one_to_one(np.argwhere(near), distance[near])


def _rasterised(old: Regions, grid: Regions) -> np.ndarray:
    """Earlier region (H, W) int64 of each cell of a grid, from 1 on; 0 for none."""
    earlier = np.zeros(grid.label.shape, np.int64)
    for k in outer_first(old.regions):
        corners = inverse_transform(grid.origin, old.regions[k].polygon) / grid.resolution
        low = np.clip(np.floor(corners.min(axis=0)).astype(int), 0, earlier.shape)
        high = np.clip(np.ceil(corners.max(axis=0)).astype(int), 0, earlier.shape)
        window = earlier[low[0] : high[0], low[1] : high[1]]
        cells = np.indices(window.shape).reshape(2, -1).T + low + 0.5
        centres = transform(grid.origin, cells * grid.resolution)
        window[contains(old.regions[k], centres).reshape(window.shape)] = k + 1
    return earlier


def _sorted_regions(found: Regions, numbers: Sequence[int]) -> Regions:
    """Regions named and sorted by their numbers."""
    order = np.argsort(numbers, kind="stable").tolist()
    place = np.argsort(order, kind="stable").tolist()  # of each region in the new order
    regions = []
    for k in order:
        neighbours = sorted(place[n] for n in found.regions[k].neighbours)
        name = f"room_{numbers[k]}"
        regions.append(found.regions[k]._replace(name=name, neighbours=tuple(neighbours)))
    doors = []
    for door in found.doors:
        first, second = sorted(place[r] for r in door.regions)
        doors.append(door._replace(regions=(first, second)))
    label = np.array([0, *(p + 1 for p in place)], np.int32)[found.label]
    return found._replace(label=label, regions=tuple(regions), doors=tuple(doors))


def _sorted_doors(found: Regions, numbers: Sequence[int]) -> Regions:
    """Regions with their doors named and sorted by their numbers."""
    order = np.argsort(numbers, kind="stable").tolist()
    place = np.argsort(order, kind="stable").tolist()
    doors = tuple(found.doors[k]._replace(name=f"door_{numbers[k]}") for k in order)
    regions = tuple(
        region._replace(doors=tuple(sorted(place[d] for d in region.doors)))
        for region in found.regions
    )
    return found._replace(regions=regions, doors=doors)
