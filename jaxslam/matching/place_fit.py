"""How a query fits a map at a pose: point-to-line ICP on the cells of an index, and a score.

A cell of the index names the wall of a point that falls into it. With R = R(heading) and t the
position of a pose, a point p of the query has the position q = R p + t, and its cell a surface s
with the normal n:

    e     = n^T (q - s)                                    residual: distance to the wall
    w     = 1 / (1 + (e / gate)^2)^2                       if |q - s| < gate, and normals agree
    H     = sum w J^T J / std^2                            information of the query
    dpose = (H + H_prior)^-1 (-sum w J^T e / std^2 + H_prior (pose_prior - pose))

The score is the share of the points that lie on walls, by their distance d from the nearest surface
and, where that is near, by e; less the share of what the query saw to be free and which is a wall
in the map:

    score = mean (w(d) + w(e)) / 2 over points - mean w(d) over points of free space
    w(d) = exp(-d^2 / (2 std^2))

References:
    Censi (2008), An ICP variant using a point-to-line metric. Thrun, Burgard, Fox (2005),
    Probabilistic Robotics, section 6.4: likelihood fields.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from jaxslam.core.se2 import dot, rotation, transform
from jaxslam.core.types import Array
from jaxslam.matching.icp import solve
from jaxslam.matching.place_index import PlaceIndex, PlaceSpec

ON_LINE = 2.5
"""Cells from the nearest surface up to which a point is on its line."""


class PlaceQuery(NamedTuple):
    """What is looked for, in the frame of the last scan: P points.

    Attributes:
        points: (P, 2) [m] where beams ended.
        normal: (P, 2) unit normals of their surfaces, to where they were seen from; 0 if unknown.
        valid: (P,) bool.
        free: (P, F, 2) [m] in free space before each point.
        is_free: (P, F) bool, those of them that exist.
        view: (2, K, F) spectrum of the ranges around the last scan, see `place_views`.
    """

    points: Array
    normal: Array
    valid: Array
    free: Array
    is_free: Array
    view: Array


class PoseFit(NamedTuple):
    """A pose by ICP.

    Attributes:
        pose: (3,) [m, m, rad] map frame.
        information: (3, 3) H of the query at the last iteration, without the prior.
    """

    pose: Array
    information: Array


def fit_pose(
    spec: PlaceSpec,
    index: PlaceIndex,
    query: PlaceQuery,
    gates: tuple[float, ...],
    stds: tuple[float, ...],
    prior: Array,
    prior_information: Array,
) -> PoseFit:
    """Pose of a query by ICP from its prior.

    Args:
        spec: Options; those of the index.
        index: Of the map.
        query: What was seen.
        gates: [m] largest distance of a point from its wall, iteration by iteration.
        stds: [m] of a point's distance from its wall, iteration by iteration.
        prior: (3,) [m, m, rad] map frame, where ICP starts.
        prior_information: (3, 3) positive definite.
    """

    def step(fit: PoseFit, now: tuple[Array, Array]) -> tuple[PoseFit, None]:
        pose, (gate, std) = fit.pose, now
        points = transform(pose, query.points)
        cell = cells_of(spec, index, points)
        normal, distance = index.normal[cell], index.distance[cell]
        error = dot(normal, points - index.origin[None]) - index.offset[cell]
        facing = dot(normal, query.normal @ rotation(pose[2]).T) > 0.5
        used = query.valid & facing & (distance < gate)
        weight = jnp.where(used, 1.0 / (1.0 + (error / gate) ** 2) ** 2, 0.0)
        arm = points - pose[None, :2]
        by_heading = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
        columns = jnp.stack([*normal.T, by_heading, error])
        square = (columns[:3] * weight[None]) @ columns.T / std**2
        information = square[:, :3]
        descent = prior_information @ (prior - pose) - square[:, 3]
        return PoseFit(pose + solve(information + prior_information, descent), information), None

    start = PoseFit(prior, jnp.zeros_like(prior_information))
    return lax.scan(step, start, (jnp.array(gates), jnp.array(stds)))[0]


def score_pose(spec: PlaceSpec, index: PlaceIndex, query: PlaceQuery, pose: Array) -> Array:
    """Share of the points on walls, less that of free space that is a wall; ()."""

    def on_wall(distance: Array) -> Array:
        return jnp.exp(-0.5 * (distance / spec.std) ** 2)

    points = transform(pose, query.points)
    cell = cells_of(spec, index, points)
    distance = index.distance[cell]
    across = dot(index.normal[cell], points - index.origin[None]) - index.offset[cell]
    on_line = jnp.where(distance < ON_LINE * spec.cell, on_wall(across), 0.0)
    in_wall = on_wall(distance_at(spec, index, transform(pose, query.free.reshape(-1, 2))))
    return (
        0.5 * mean_of(on_wall(distance), query.valid)
        + 0.5 * mean_of(on_line, query.valid)
        - mean_of(in_wall, query.is_free.ravel())
    )


def distance_at(spec: PlaceSpec, index: PlaceIndex, points: Array) -> Array:
    """Distances (N,) [m] from the nearest wall, of points (N, 2) [m] of the map frame."""
    return index.distance[cells_of(spec, index, points)]


def cells_of(spec: PlaceSpec, index: PlaceIndex, points: Array) -> tuple[Array, Array]:
    """Cells (N,), (N,) int32 of points (N, 2) [m] of the map frame; those of its edge beyond it."""
    cell = jnp.round((points - index.origin[None]) / spec.cell).astype(jnp.int32)
    height, width = index.distance.shape
    return cell[:, 0].clip(0, height - 1), cell[:, 1].clip(0, width - 1)


def mean_of(values: Array, valid: Array) -> Array:
    """Mean () of the values (N,) that are valid; 0 of none."""
    total = jnp.sum(jnp.where(valid, values, 0.0))
    return total / jnp.maximum(jnp.sum(valid, dtype=values.dtype), 1.0)
