"""Place recognition: where in a map a scan was taken, without a guess.

    index = build_index(spec, lidar, poses, scans)       # once for a map, `place_index`
    places = find_places(spec, index, make_query(spec, lidar, scans, poses))

A query is one scan, or several joined by odometry where one shows too little. Hypotheses are the
positions of the index, each with four headings, one a quadrant: those at which the query agrees
best with what a scanner would measure there (`place_views`). Those that agree best are scored by
some points of the query, by their distances d from the walls of the map; the best are refined by
point-to-line ICP, scored again, refined with all points, and scored by them (`place_fit` has the
formulas).

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
from jaxslam.core.se2 import transform, wrap_angle
from jaxslam.core.types import AnyArray, Array
from jaxslam.frontend.lidar import beam_ends
from jaxslam.matching import checks
from jaxslam.matching.oriented_points import oriented_points, towards_scanner, transform_points
from jaxslam.matching.place_fit import PlaceQuery, distance_at, fit_pose, mean_of, score_pose
from jaxslam.matching.place_index import PlaceIndex, PlaceSpec, check_place_spec
from jaxslam.matching.place_views import NUM_BEARINGS, agreement, view_of_points

FREE_BEFORE = (0.3, 0.6, 1.0, 1.5, 2.5, 4.0)
"""[m] before a surface point where the query saw free space."""

MAX_FREE_SHARE = 0.95
"""Share of a range up to which that is: not the scanner itself."""

PRIOR_STD = (0.5, 0.5, 0.1)
"""[m], [m], [rad] std of a hypothesis, which keeps what a corridor does not constrain."""


KERNEL = 0.3
"""Std of a point's distance from its wall in a refinement, as a fraction of its gate."""


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
    scores = jax.vmap(partial(score_pose, spec, index, query))(poses)
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
    """Pose (3,) from a hypothesis (3,)."""
    stds = tuple(KERNEL * gate for gate in gates)
    prior = jnp.diag(1.0 / jnp.array(PRIOR_STD) ** 2)
    return fit_pose(spec, index, query, gates, stds, start, prior).pose


def _coarse_score(
    spec: PlaceSpec, std: float, index: PlaceIndex, query: PlaceQuery, pose: Array
) -> Array:
    """Share () of the points near walls, by a std [m] of their distances."""
    distance = distance_at(spec, index, transform(pose, query.points))
    return mean_of(1.0 / (1.0 + (distance / std) ** 2) ** 2, query.valid)


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


def _evenly(valid: Array, count: int) -> Array:
    """Indices (count,) of those that are valid (N,), evenly spaced among them."""
    total = jnp.sum(valid, dtype=jnp.int32)
    rank = jnp.cumsum(valid, dtype=jnp.int32) - 1
    wanted = jnp.arange(count, dtype=jnp.int32) * jnp.maximum(total, count) // count
    return jnp.searchsorted(rank, wanted).clip(0, len(valid) - 1)
