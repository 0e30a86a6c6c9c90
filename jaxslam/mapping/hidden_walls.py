"""Small unknown places beside walls that were seen: the walls go on behind what hides them.

A few scans leave pockets that no beam has reached, beside a door jamb or along a wall that is seen
at a small angle. Of the walls that were seen around, the one whose line is nearest says which side
of it they are on:

        free        |  pocket: in front of the nearest wall, so free
           .-.      |
        ==='  '=====   wall, seen left and right of the pocket
           solid       behind it: wall
"""

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxslam.core.maps import OccupancyMap
from jaxslam.core.scan import Lidar, Scan

DEPTH = 0.3
"""[m] from free space, up to which unknown space is divided so."""

REACH = 0.6
"""[m] from a point of a wall, up to which the wall goes on."""

SPACING, MAX_POINTS = 0.05, 128
"""[m] between points of a wall; and how many of them around a place are looked at."""

FIT, FLAT = 0.15, 0.04
"""[m], [-] A wall is straight if its points within this radius vary across it by less than this
share of along it."""


def with_hidden_walls(
    occupancy: OccupancyMap, lidar: Lidar, poses: np.ndarray, scans: Scan
) -> OccupancyMap:
    """The grid with its unknown cells near walls free, or occupied, by the side of the wall.

    Args:
        occupancy: The grid of these scans, not turned against the map frame.
        lidar: The scanner.
        poses: (T, 3) [m, m, rad] of the scanner, map frame.
        scans: [T].
    """
    points, normals = _wall_points(lidar, poses, scans)
    size = int(np.ceil(DEPTH / occupancy.resolution))
    unknown = ~(occupancy.free | occupancy.occupied)
    distance = ndimage.distance_transform_edt(~occupancy.free)
    cells = np.argwhere(unknown & (distance <= size))
    if not len(points) or not len(cells):
        return occupancy
    centres = (cells + 0.5) * occupancy.resolution + occupancy.origin[:2]
    apart, nearest = cKDTree(points).query(centres, MAX_POINTS, distance_upper_bound=REACH)
    near = np.isfinite(apart)
    nearest = np.where(near, nearest, 0)
    offset = np.sum((centres[:, None] - points[nearest]) * normals[nearest], axis=2)
    offset = np.where(near, offset, np.inf)
    side = np.take_along_axis(offset, np.argmin(np.abs(offset), axis=1)[:, None], axis=1)[:, 0]
    cells, ahead = cells[near.any(axis=1)], side[near.any(axis=1)] > 0.0
    free, occupied = occupancy.free.copy(), occupancy.occupied.copy()
    free[tuple(cells[ahead].T)] = True
    occupied[tuple(cells[~ahead].T)] = True
    return occupancy._replace(free=free, occupied=occupied)


def _wall_points(lidar: Lidar, poses: np.ndarray, scans: Scan) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) [m] of straight walls in the map frame, and normals (N, 2) to the scanner.

    The normal is that of the line through all points around that were seen from the same side.
    """
    ranges, hit = np.asarray(scans.ranges, float), np.asarray(scans.hit)
    angle = poses[:, 2:] + lidar.angle_min + lidar.angle_increment * np.arange(lidar.num_beams)
    beam = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    ends, beam = (poses[:, None, :2] + ranges[..., None] * beam)[hit], beam[hit]
    side = np.round(np.arctan2(beam[:, 1], beam[:, 0]) / (np.pi / 4)) % 8
    cell = np.column_stack([np.floor(ends / SPACING), side])
    chosen = np.unique(cell, axis=0, return_index=True)[1]
    points, normals = [], []
    around = cKDTree(ends).query_ball_point(ends[chosen], FIT)
    for k, near in zip(chosen.tolist(), around, strict=True):
        same = np.array(near)[beam[near] @ beam[k] > 0.0]
        centre = ends[same].mean(axis=0)
        (xx, xy), (_, yy) = (ends[same] - centre).T @ (ends[same] - centre) / len(same)
        spread, mean = np.hypot(xx - yy, 2 * xy) / 2, (xx + yy) / 2
        if len(same) >= 5 and mean - spread < FLAT * (mean + spread):
            turn = 0.5 * np.arctan2(2 * xy, xx - yy)
            normal = np.array([-np.sin(turn), np.cos(turn)])
            points.append(centre)
            normals.append(-normal if normal @ beam[k] > 0.0 else normal)
    return np.array(points).reshape(-1, 2), np.array(normals).reshape(-1, 2)
