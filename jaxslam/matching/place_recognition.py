"""Place recognition: where in a map a scan was taken, without a guess.

    index = build_index(spec, lidar, poses, scans)       # once for a map, `place_index`
    places = find_places(spec, index, make_query(spec, lidar, scans, poses))

A query is one scan, or several joined by odometry where one shows too little. Hypotheses are the
positions of the index, each with four headings, one a quadrant: those at which the query agrees
best with what a scanner would measure there (`place_views`). Those that agree best are scored by
some points of the query, by their distances d from the walls of the map; the best are refined by
point-to-line ICP, where a cell names the wall of a point, scored again, and refined with all
points. The final score is the share of the points that lie on walls, less that of what the query
saw to be free and which is a wall in the map. Points are on walls by d, which is of cells, and by
their distance e across the wall, which is exact:

    score = mean (w(d) + w(e)) / 2 over points - mean w(d) over points of free space
    w(d) = exp(-d^2 / (2 std^2))

Look-alike places have about the same score. So the difference between the best and the best at any
other place, the margin, decides with the score whether a place is accepted; the others are returned
as well. The work is the same for all queries, and linear in the positions of the index.

References:
    Olson (2009), Real-time correlative scan matching. Thrun, Burgard, Fox (2005), Probabilistic
    Robotics, section 6.4: likelihood fields.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core import trace_cache
from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.se2 import dot, rotation, transform, wrap_angle
from jaxslam.core.types import AnyArray, Array
from jaxslam.frontend.lidar import beam_ends
from jaxslam.matching import checks
from jaxslam.matching.icp import solve
from jaxslam.matching.oriented_points import oriented_points, towards_scanner, transform_points
from jaxslam.matching.place_index import PlaceIndex, PlaceSpec, check_place_spec
from jaxslam.matching.place_views import NUM_BEARINGS, agreement, view_of_points

FREE_BEFORE = (0.3, 0.6, 1.0, 1.5, 2.5, 4.0)
"""[m] before a surface point where the query saw free space."""

MAX_FREE_SHARE = 0.95
"""Share of a range up to which that is: not the scanner itself."""

PRIOR_STD = (0.5, 0.1)
"""[m], [rad] std of a hypothesis, which keeps what a corridor does not constrain."""


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


class Places(NamedTuple):
    """Places that fit a query, the best first; C of them.

    Attributes:
        poses: (C, 3) [m, m, rad] map frame.
        score: (C,) at most 1; -inf where there are no more places.
        margin: () score of the first less that of the second.
        certainty: () score of the first + margin_weight min(margin, max_margin).
        accepted: () bool, whether the first one is the place, by certainty and margin.
    """

    poses: Array
    score: Array
    margin: Array
    certainty: Array
    accepted: Array


def make_query(spec: PlaceSpec, lidar: Lidar, scans: Scan, poses: AnyArray) -> PlaceQuery:
    """Query of scans that are joined by odometry.

    Call it by `jax.jit(make_query, static_argnums=(0, 1))`.

    Args:
        spec: Options.
        lidar: The scanner; it may be another one than that of the map.
        scans: [W], W >= 1.
        poses: (W, 3) [m, m, rad] of the scans in the frame of the last one.

    Raises:
        ValueError: An option is out of range, or poses and scans are not W each, those of this
            lidar.
    """
    check_place_spec(spec)
    check_lidar(lidar)
    poses = checks.as_default_float("poses", poses, ("W", 3))
    scans = checks.as_scans("scans", lidar, scans, poses.shape[:1])
    surfaces = towards_scanner(jax.vmap(partial(oriented_points, lidar))(scans))
    ends = jax.vmap(partial(beam_ends, lidar))(scans)
    ranges = jnp.linalg.norm(ends, axis=-1, keepdims=True)
    share = 1.0 - jnp.array(FREE_BEFORE)[None, None] / jnp.maximum(ranges, 1e-3)
    free = ends[:, :, None] * share[..., None]
    is_free = (share > 1.0 - MAX_FREE_SHARE) & scans.hit[..., None]
    on_surface = surfaces.valid[..., None]
    surfaces = surfaces._replace(
        points=jnp.where(on_surface, surfaces.points, ends),
        normal=jnp.where(on_surface, surfaces.normal, 0.0),
    )
    surfaces = jax.vmap(transform_points)(poses, surfaces)
    free = jax.vmap(transform)(poses, free.reshape(len(poses), -1, 2)).reshape(free.shape)
    chosen = _evenly(scans.hit.ravel(), spec.max_points)
    points, normal, valid = (
        x.reshape(-1, *x.shape[2:])[chosen] for x in (surfaces.points, surfaces.normal, scans.hit)
    )
    free, is_free = (x.reshape(-1, *x.shape[2:])[chosen] for x in (free, is_free))
    few = jnp.arange(spec.max_points, dtype=jnp.int32) < jnp.sum(scans.hit, dtype=jnp.int32)
    valid = valid & few
    view = view_of_points(points, valid)
    return PlaceQuery(points, normal, valid, free, is_free & few[:, None], view)


@partial(trace_cache.jit, static_argnames=("spec",))
def find_places(spec: PlaceSpec, index: PlaceIndex, query: PlaceQuery) -> Places:
    """Places of a map that fit a query; compiled.

    Under `jax.vmap` over queries, the index is shared.

    Args:
        spec: Options; those of the index.
        index: Of the map.
        query: With `spec.max_points` points.
    """
    every = -(-spec.max_points // spec.coarse_points)
    some = query._replace(
        points=query.points[::every], normal=query.normal[::every], valid=query.valid[::every]
    )

    def best_of(std: float, size: int, poses: Array, exists: Array) -> tuple[Array, Array]:
        scores = jax.vmap(partial(_coarse_score, spec, std, index, some))(poses)
        best = lax.top_k(jnp.where(exists, scores, -jnp.inf), min(size, len(poses)))[1]
        return poses[best], exists[best]

    poses, exists = _hypotheses(index, query, spec.num_views)
    poses, exists = best_of(spec.coarse_std, spec.num_coarse, poses, exists)
    poses = jax.vmap(partial(_refine, spec, index, some, spec.coarse_gates))(poses)
    poses, exists = best_of(spec.coarse_std / 2, spec.num_fine, poses, exists)
    poses = jax.vmap(partial(_refine, spec, index, query, spec.fine_gates))(poses)
    scores = jax.vmap(partial(_score, spec, index, query))(poses)
    poses, scores = _distinct(spec, poses, jnp.where(exists, scores, -jnp.inf))
    margin = scores[0] - scores[1] if len(scores) > 1 else scores[0]
    certainty = scores[0] + spec.margin_weight * jnp.minimum(margin, spec.max_margin)
    accepted = (certainty >= spec.min_certainty) & (margin >= spec.min_margin)
    return Places(poses, scores, margin, certainty, accepted)


def _hypotheses(index: PlaceIndex, query: PlaceQuery, size: int) -> tuple[Array, Array]:
    """Poses (size, 3) whose views agree best, one a quadrant and position; whether they exist."""
    found = agreement(index.views, query.view).reshape(-1, 4, NUM_BEARINGS // 4)
    first = jnp.arange(4, dtype=jnp.int32) * (NUM_BEARINGS // 4)  # of each quadrant
    turns = (first[None] + jnp.argmax(found, axis=-1).astype(jnp.int32)).ravel()
    scores = jnp.where(index.valid[:, None], jnp.max(found, axis=-1), -jnp.inf).ravel()
    best = lax.top_k(scores, min(size, len(scores)))[1]
    turn = turns[best].astype(found.dtype) * (2.0 * jnp.pi / NUM_BEARINGS)
    return jnp.column_stack([index.positions[best // 4], turn]), scores[best] > -jnp.inf


def _refine(
    spec: PlaceSpec, index: PlaceIndex, query: PlaceQuery, gates: tuple[float, ...], start: Array
) -> Array:
    """Pose (3,) by point-to-line ICP from a hypothesis."""
    std = jnp.array([PRIOR_STD[0], PRIOR_STD[0], PRIOR_STD[1]])
    prior = jnp.diag(1.0 / std**2)

    def step(pose: Array, gate: Array) -> tuple[Array, None]:
        points = transform(pose, query.points)
        distance = _look_up(spec, index, points, index.distance)
        normal = _look_up(spec, index, points, index.normal)
        offset = _look_up(spec, index, points, index.offset)
        error = dot(normal, points - index.origin[None]) - offset
        facing = dot(normal, query.normal @ rotation(pose[2]).T) > 0.5
        used = query.valid & facing & (distance < gate)
        weight = jnp.where(used, 1.0 / (1.0 + (error / gate) ** 2) ** 2, 0.0)
        arm = points - pose[None, :2]
        by_heading = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
        columns = jnp.stack([*normal.T, by_heading, error])
        square = (columns[:3] * weight[None]) @ columns.T / (0.3 * gate) ** 2
        descent = prior @ (start - pose) - square[:, 3]
        return pose + solve(square[:, :3] + prior, descent), None

    return lax.scan(step, start, jnp.array(gates))[0]


def _coarse_score(
    spec: PlaceSpec, std: float, index: PlaceIndex, query: PlaceQuery, pose: Array
) -> Array:
    """Share () of the points near walls, by a std [m] of their distances."""
    distance = _look_up(spec, index, transform(pose, query.points), index.distance)
    return _mean(1.0 / (1.0 + (distance / std) ** 2) ** 2, query.valid)


def _score(spec: PlaceSpec, index: PlaceIndex, query: PlaceQuery, pose: Array) -> Array:
    """Share of the points on walls, less that of free space that is a wall; ()."""

    def on_wall(distance: Array) -> Array:
        return jnp.exp(-0.5 * (distance / spec.std) ** 2)

    points = transform(pose, query.points)
    distance = _look_up(spec, index, points, index.distance)
    normal = _look_up(spec, index, points, index.normal)
    across = dot(normal, points - index.origin[None]) - _look_up(spec, index, points, index.offset)
    on_line = jnp.where(distance < ON_LINE * spec.cell, on_wall(across), 0.0)
    free = transform(pose, query.free.reshape(-1, 2))
    in_wall = on_wall(_look_up(spec, index, free, index.distance))
    return (
        0.5 * _mean(on_wall(distance), query.valid)
        + 0.5 * _mean(on_line, query.valid)
        - _mean(in_wall, query.is_free.ravel())
    )


def _distinct(spec: PlaceSpec, poses: Array, scores: Array) -> tuple[Array, Array]:
    """The best poses (C, 3) at different places, and their scores (C,)."""

    def take(left: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        best = jnp.argmax(left)
        off = poses - poses[best][None]
        near = jnp.hypot(off[:, 0], off[:, 1]) < spec.distinct[0]
        same = near & (jnp.abs(wrap_angle(off[:, 2])) < spec.distinct[1])
        pose = poses[best].at[2].set(wrap_angle(poses[best, 2]))
        return jnp.where(same, -jnp.inf, left), (pose, left[best])

    return lax.scan(take, scores, length=spec.num_candidates)[1]


def _look_up(spec: PlaceSpec, index: PlaceIndex, points: Array, table: Array) -> Array:
    """Entries of a table (G, H, ...) at points (N, 2) [m] of the map frame."""
    cell = jnp.round((points - index.origin[None]) / spec.cell).astype(jnp.int32)
    height, width = table.shape[:2]
    return table[cell[:, 0].clip(0, height - 1), cell[:, 1].clip(0, width - 1)]


def _evenly(valid: Array, count: int) -> Array:
    """Indices (count,) of those that are valid (N,), evenly spaced among them."""
    total = jnp.sum(valid, dtype=jnp.int32)
    rank = jnp.cumsum(valid, dtype=jnp.int32) - 1
    wanted = jnp.arange(count, dtype=jnp.int32) * jnp.maximum(total, count) // count
    return jnp.searchsorted(rank, wanted).clip(0, len(valid) - 1)


def _mean(values: Array, valid: Array) -> Array:
    """Mean () of the values (N,) that are valid; 0 of none."""
    total = jnp.sum(jnp.where(valid, values, 0.0))
    return total / jnp.maximum(jnp.sum(valid, dtype=values.dtype), 1.0)
