"""Place recognition: where in a map a scan was taken, without a guess.

    index = build_index(spec, lidar, poses, scans)       # once for a map, `place_index`
    places = find_places(spec, index, make_query(spec, lidar, scans, poses))

A query is one scan, or several joined by odometry where one shows too little. Hypotheses are the
positions of the index, each with the four turns, one a quadrant, by which the wall directions of
the query agree best with those around the position:

    agreement(turn) = sum_b directions(b + turn) query(b)

All of them are scored by some points of the query, by their distances from the walls of the map;
the best are refined by point-to-line ICP, and scored by all points (`place_fit` has the formulas).

Look-alike places have about the same score. So the difference between the best and the best at any
other place, the margin, decides whether a place is accepted; the others are returned as well.
The work is the same for all queries, and linear in the positions of the index.

References:
    Olson (2009), Real-time correlative scan matching. Censi, Iocchi, Grisetti (2005), Scan matching
    in the Hough domain: headings from histograms of wall directions.
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

FREE_BEFORE = (0.3, 0.6, 1.0, 1.5, 2.5, 4.0)
"""[m] before a surface point where the query saw free space."""

MAX_FREE_SHARE = 0.95
"""Share of a range up to which that is: not the scanner itself."""

PRIOR_STD = (0.5, 0.5, 0.1)
"""[m, m, rad] std of a hypothesis, which keeps what a corridor does not constrain."""

KERNEL = 0.3
"""Std of a point's distance from its wall in a refinement, as a fraction of its gate."""


class Places(NamedTuple):
    """Places that fit a query, the best first; C of them.

    Attributes:
        poses: (C, 3) [m, m, rad] map frame.
        score: (C,) at most 1; -inf where there are no more places.
        margin: () score of the first less that of the second.
        accepted: () bool, whether the first one is the place, by score and margin.
    """

    poses: Array
    score: Array
    margin: Array
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
    is_free = (share > 1.0 - MAX_FREE_SHARE) & surfaces.valid[..., None]
    surfaces = jax.vmap(transform_points)(poses, surfaces)
    free = jax.vmap(transform)(poses, free.reshape(len(poses), -1, 2)).reshape(free.shape)
    chosen = _evenly(surfaces.valid.ravel(), spec.max_points)
    points, normal, valid = (
        x.reshape(-1, *x.shape[2:])[chosen]
        for x in (surfaces.points, surfaces.normal, surfaces.valid)
    )
    free, is_free = (x.reshape(-1, *x.shape[2:])[chosen] for x in (free, is_free))
    few = jnp.arange(spec.max_points, dtype=jnp.int32) < jnp.sum(surfaces.valid, dtype=jnp.int32)
    return PlaceQuery(points, normal, valid & few, free, is_free & few[:, None])


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
    some = PlaceQuery(*(x[::every] for x in query))

    def coarse_score(std: float, pose: Array) -> Array:
        distance = distance_at(spec, index, transform(pose, some.points))
        return mean_of(1.0 / (1.0 + (distance / std) ** 2) ** 2, some.valid)

    turns = _best_turns(spec, index, query)
    poses = jnp.concatenate(
        [jnp.repeat(index.positions, turns.shape[1], axis=0), turns.reshape(-1, 1)], axis=1
    )
    exists = jnp.repeat(index.valid, turns.shape[1])
    coarse = _Stage(some, spec.coarse_std, spec.num_coarse, spec.coarse_gates)
    fine = _Stage(query, spec.coarse_std / 2, spec.num_fine, spec.fine_gates)
    for stage in (coarse, fine):
        scores = jnp.where(exists, jax.vmap(partial(coarse_score, stage.std))(poses), -jnp.inf)
        best = lax.top_k(scores, min(stage.size, len(scores)))[1]
        poses, exists = jax.vmap(partial(_refine, spec, index, stage))(poses[best]), exists[best]
    scores = jax.vmap(partial(score_pose, spec, index, query))(poses)
    scores = jnp.where(exists, scores, -jnp.inf)
    poses, scores = _distinct(spec, poses, scores)
    margin = scores[0] - scores[1] if len(scores) > 1 else scores[0]
    accepted = (scores[0] >= spec.min_score) & (margin >= spec.min_margin)
    return Places(poses, scores, margin, accepted)


class _Stage(NamedTuple):
    """How the best poses are refined: `size` of them by a score, with the points of a query."""

    query: PlaceQuery
    std: float
    size: int
    gates: tuple[float, ...]


def _best_turns(spec: PlaceSpec, index: PlaceIndex, query: PlaceQuery) -> Array:
    """Turns (N, 4) [rad] of the query by which its walls agree best with those of positions."""
    bins = spec.direction_bins
    direction = jnp.arctan2(query.normal[:, 1], query.normal[:, 0]) * (bins / (2.0 * jnp.pi))
    # Shares of the two neighbouring bins, so that agreement does not depend on their borders.
    low = jnp.floor(direction)
    upper = direction - low
    bin_of = low.astype(jnp.int32)
    weight = query.valid.astype(direction.dtype)
    counts = jnp.zeros(bins, direction.dtype)
    counts = counts.at[bin_of % bins].add(weight * (1.0 - upper))
    counts = counts.at[(bin_of + 1) % bins].add(weight * upper)
    shift = jnp.arange(bins, dtype=jnp.int32)
    turned = counts[(shift[:, None] - shift[None]) % bins]  # (b, turn): by each turn
    agreement = (index.directions @ turned).reshape(-1, 4, bins // 4)
    first = jnp.arange(4, dtype=jnp.int32) * (bins // 4)  # of each quadrant
    best = first[None] + jnp.argmax(agreement, axis=-1).astype(jnp.int32)
    return best.astype(direction.dtype) * (2.0 * jnp.pi / bins)


def _refine(spec: PlaceSpec, index: PlaceIndex, stage: _Stage, hypothesis: Array) -> Array:
    """Pose (3,) from a hypothesis (3,)."""
    stds = tuple(KERNEL * gate for gate in stage.gates)
    prior = jnp.diag(1.0 / jnp.array(PRIOR_STD) ** 2)
    return fit_pose(spec, index, stage.query, stage.gates, stds, hypothesis, prior).pose


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
