"""Oriented points: the points of a scan, each with the normal of the surface that it lies on.

Point-to-line ICP (`icp`) measures the distance of a point from a line. The lines are those fitted
here, to a point and its neighbours on the same surface. A surface ends where the gap between two
neighbouring points is too large for their range; points of corners and of scattered returns, whose
neighbours are on no line, are not valid.
"""

from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import dot, rotation, transform, wrap_angle
from jaxslam.core.types import Array
from jaxslam.frontend.lidar import beam_ends

NORMAL_NEIGHBOURS = 3
"""Beams on either side that a normal is fitted to."""

MAX_NEIGHBOUR_GAP = (0.06, 0.1)
"""[m], and fraction of the range: larger gaps separate two surfaces."""

MAX_FLATNESS = 0.04
"""Largest variance across a surface, as a fraction of that along it."""


class OrientedPoints(NamedTuple):
    """Points of a scan with the normals of their surfaces, in some frame.

    Attributes:
        points: (R, 2) [m] on the line fitted to the point and its neighbours.
        normal: (R, 2) unit normal of that line, of either sign.
        neighbour_gap: (R,) [m] to the further of the two adjacent points on the surface.
        valid: (R,) bool.
    """

    points: Array
    normal: Array
    neighbour_gap: Array
    valid: Array


def oriented_points(lidar: Lidar, scan: Scan) -> OrientedPoints:
    """Oriented points of one scan, robot frame.

    The line of a point is the least-squares fit to itself and its neighbours up to the first gap.

    Args:
        lidar: The scanner.
        scan: One scan.

    Raises:
        ValueError: The ranges are not those of one scan of this lidar; while tracing.
    """
    ends = beam_ends(lidar, scan)
    neighbours, weight, gap = _neighbours(lidar, scan, ends)
    count = jnp.maximum(weight.sum(axis=0), 1.0)
    centre = jnp.sum(weight[..., None] * neighbours, axis=0) / count[:, None]
    offset = neighbours - centre[None]
    xx, xy, yy = (
        jnp.sum(weight * offset[..., i] * offset[..., j], axis=0) / count
        for i, j in ((0, 0), (0, 1), (1, 1))
    )
    # Eigenvalues of the scatter matrix are mean +- spread; the line is along the larger one.
    direction = 0.5 * jnp.arctan2(2 * xy, xx - yy)
    normal = jnp.stack([-jnp.sin(direction), jnp.cos(direction)], axis=-1)
    spread, mean = jnp.hypot(xx - yy, 2 * xy) / 2, (xx + yy) / 2
    flat = mean - spread < MAX_FLATNESS * (mean + spread)
    projected = ends - dot(ends - centre, normal)[:, None] * normal
    return OrientedPoints(projected, normal, gap, scan.hit & (count >= 3.0) & flat)


def _neighbours(lidar: Lidar, scan: Scan, ends: Array) -> tuple[Array, Array, Array]:
    """Points on the surface of each point, with N = 2 `NORMAL_NEIGHBOURS` + 1.

    Returns:
        Ends (N, R, 2) [m] of the beam and its neighbours, their weights (N, R), 1 on the surface
        and 0 off it; and `OrientedPoints.neighbour_gap` (R,).
    """
    index = jnp.arange(lidar.num_beams)
    neighbours, on_surface, gap = [ends], [scan.hit], jnp.zeros(lidar.num_beams)
    limit = MAX_NEIGHBOUR_GAP[0] + MAX_NEIGHBOUR_GAP[1] * scan.ranges
    for side in (1, -1):
        joined, previous = scan.hit, ends
        for k in range(1, NORMAL_NEIGHBOURS + 1):
            beam = index + side * k
            inside = (beam >= 0) & (beam < lidar.num_beams)
            beam = jnp.clip(beam, 0, lidar.num_beams - 1)
            distance = jnp.linalg.norm(ends[beam] - previous, axis=-1)
            joined = joined & inside & scan.hit[beam] & (distance < limit)
            previous = ends[beam]
            neighbours.append(previous)
            on_surface.append(joined)
            gap = jnp.where(joined & (k == 1), jnp.maximum(gap, distance), gap)
    return jnp.stack(neighbours), jnp.stack(on_surface).astype(ends.dtype), gap


def towards_scanner(points: OrientedPoints) -> OrientedPoints:
    """Oriented points of the robot frame, their normals turned to where they were seen from."""
    away = dot(points.normal, points.points) > 0.0
    return points._replace(normal=jnp.where(away[..., None], -points.normal, points.normal))


def transform_points(pose: Array, points: OrientedPoints) -> OrientedPoints:
    """Oriented points of the frame of a pose (3,), in the frame that the pose is given in."""
    turn = rotation(pose[2])
    return points._replace(points=transform(pose, points.points), normal=points.normal @ turn.T)


def beam_towards(lidar: Lidar, pose: Array, points: Array) -> Array:
    """Beam (N,) int32 that looks nearest at each point; beyond 0 .. R - 1 out of the field of view.

    Args:
        lidar: The scanner.
        pose: (3,) [m, m, rad] of the scanner.
        points: (N, 2) [m] in the same frame.
    """
    last = lidar.num_beams - 1
    middle = lidar.angle_min + lidar.angle_increment * last / 2
    x, y = points.T
    bearing = wrap_angle(jnp.arctan2(y - pose[1], x - pose[0]) - pose[2] - middle)
    return jnp.round(bearing / lidar.angle_increment + last / 2).astype(jnp.int32)
