"""Where a scan is if the quick match is not to be trusted: candidates of a correlative search.

The quick match finds what lies near the prediction. Here the pose may be anywhere in a window of a
metre and a radian to either side, or of a whole turn where nothing fits. The candidates are refined
by ICP. Quick match and candidates are compared by

    value = (inliers - contradictions) / 2 - surprise / returned

where inliers are the points that lie on surfaces of the submap, contradictions those in space that
its scans saw to be free, both as fractions; the surprise grows with the distance from where wheels
or the motion before would have the robot (`motion_prior`). The fewer beams returned, as a fraction,
the less does it say that many of their points fit.

Where two places have about the same value, the better one is kept, and the information is that of a
Gaussian with the mean and covariance of both: small in the direction from one to the other. With
probabilities p, 1 - p and the offset d between the two,

    cov' = H^-1 + p (1 - p) d d^T        H' = H - H d (H d)^T / (1 / (p (1 - p)) + d^T H d)
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import transform, wrap_angle
from jaxslam.core.types import Array
from jaxslam.matching import correlative
from jaxslam.matching.icp import MatchedPose, PosePrior, ScanMatchSpec, Submap, fine_icp
from jaxslam.matching.motion_prior import PoseHypotheses, log_density
from jaxslam.matching.oriented_points import OrientedPoints, beam_towards

PROBABILITY_SCALE = 0.01
"""Difference of two values that makes one place e times as likely as the other."""

SAME_PLACE = (0.1, 0.05)
"""[m], [rad] within which two refined poses are one place."""

FREE_MARGIN = 0.3
"""[m] from which on a point before a surface is in free space."""


def search_widely(
    spec: ScanMatchSpec,
    lidar: Lidar,
    submap: Submap,
    hypotheses: PoseHypotheses,
    points: Array,
    hit: Array,
    quick: MatchedPose,
    only_compare: Array,
) -> MatchedPose:
    """The quick match, or a better one from a wide window.

    Args:
        spec: Options.
        lidar: The scanner.
        submap: Of the scans before.
        hypotheses: Where the scan is expected.
        points: (N, 2) [m] of the scan, robot frame.
        hit: (N,) bool, those of them that exist.
        quick: The quick match.
        only_compare: () bool, whether the window is searched only if the quick match is worse than
            one that begins where the motion before would have the robot.
    """
    surfaces = submap.oriented_points
    information = jnp.diag(
        1.0 / jnp.array([spec.search_std[0], spec.search_std[0], spec.search_std[1]]) ** 2
    )

    def refine(start: Array) -> MatchedPose:
        prior = PosePrior(start, information)
        return fine_icp(spec, lidar, submap, prior, start, points, hit)

    share = _fraction(jnp.maximum(jnp.sum(hit), 1), jnp.array(hit.size), points.dtype)

    def value(match: MatchedPose) -> Array:
        contradicted = contradicted_fraction(
            lidar, surfaces, submap.poses, transform(match.pose, points), hit
        )
        unlikely = correlative.surprise(spec.search, log_density(hypotheses, match.pose))
        value = (match.inlier_fraction - contradicted) / 2 - unlikely / share
        return jnp.where(jnp.isfinite(value), value, -jnp.inf)

    # Begun where the wheels had the robot; then where the motion before has it; then the search;
    # then where it is if it drove backwards, which may be out of the window of the search.
    num_found = 3 + spec.search.num_candidates
    num_likely = num_found - (hypotheses.weights[2] == 0.0).astype(jnp.int32)
    found = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_found, *x.shape)), quick)
    values = jnp.full(num_found, -jnp.inf, quick.pose.dtype).at[0].set(value(quick) + spec.min_gain)
    starts = jnp.broadcast_to(hypotheses.poses[1], (num_found, 3)).at[-1].set(hypotheses.poses[2])

    def is_left(state: _Refining) -> Array:
        settled = only_compare & (state.number == 2) & (state.values[0] >= state.values[1])
        return (state.number < num_likely) & ~settled

    def body(state: _Refining) -> _Refining:
        number, starts, found, values = state
        starts = lax.cond(
            number == 2,
            lambda: starts.at[2:-1].set(
                _candidates(spec, surfaces, hypotheses, points, hit, quick)
            ),
            lambda: starts,
        )
        match = refine(starts[number])
        found = jax.tree.map(lambda held, one: held.at[number].set(one), found, match)
        return _Refining(number + 1, starts, found, values.at[number].set(value(match)))

    state = lax.while_loop(is_left, body, _Refining(jnp.int32(1), starts, found, values))
    found, values = state.found, state.values
    match = jax.tree.map(lambda x: x[jnp.argmax(values)], found)
    off = found.pose - match.pose[None]
    near = jnp.hypot(off[:, 0], off[:, 1]) < SAME_PLACE[0]
    same = near & (jnp.abs(wrap_angle(off[:, 2])) < SAME_PLACE[1])
    elsewhere = jnp.where(same, -jnp.inf, values)
    other = found.pose[jnp.argmax(elsewhere)]
    behind = jnp.max(elsewhere) - jnp.max(values)
    return match._replace(information=spread_over(match, other, behind))


class _Refining(NamedTuple):
    """State while E poses are refined: the next one's number, starts, matches [E], and values."""

    number: Array
    starts: Array
    found: MatchedPose
    values: Array


def _candidates(
    spec: ScanMatchSpec,
    surfaces: OrientedPoints,
    hypotheses: PoseHypotheses,
    points: Array,
    hit: Array,
    quick: MatchedPose,
) -> Array:
    """Candidates (C, 3) of the correlative search around the middle of wheels and motion before."""
    first, second = hypotheses.poses[:2]
    turn = wrap_angle(second[2] - first[2])
    middle = jnp.stack(
        [(first[0] + second[0]) / 2, (first[1] + second[1]) / 2, first[2] + turn / 2]
    )
    return correlative.search(
        spec.search,
        surfaces.points.reshape(-1, 2),
        surfaces.valid.ravel(),
        middle,
        partial(log_density, hypotheses),
        points,
        hit,
        quick.inlier_fraction < spec.lost_inliers,
    ).poses


def contradicted_fraction(
    lidar: Lidar, surfaces: OrientedPoints, poses: Array, points: Array, hit: Array
) -> Array:
    """Fraction () of the points that lie in space which the keyframes saw to be free.

    A point is in free space of a keyframe if it is nearer than all surfaces that this saw around
    its bearing, by `FREE_MARGIN`; each point counts by the share of such keyframes, of those that
    saw a surface there.

    Args:
        lidar: The scanner.
        surfaces: [K] of the keyframes, in the frame of the points.
        poses: (K, 3) [m, m, rad] of the keyframes.
        points: (N, 2) [m].
        hit: (N,) bool, those of them that exist.
    """

    def in_free_space(surface: OrientedPoints, pose: Array) -> tuple[Array, Array]:
        distance = jnp.linalg.norm(surface.points - pose[None, :2], axis=-1)
        away = points - pose[None, :2]
        around = (
            beam_towards(lidar, pose, points)[:, None] + jnp.arange(-1, 2, dtype=jnp.int32)[None]
        )
        inside = jnp.all((around >= 0) & (around < lidar.num_beams), axis=-1)
        around = around.clip(0, lidar.num_beams - 1)
        seen = inside & jnp.all(surface.valid[around], axis=-1)
        nearest = jnp.min(distance[around], axis=-1)
        return seen, seen & (jnp.linalg.norm(away, axis=-1) < nearest - FREE_MARGIN)

    seen, free = jax.vmap(in_free_space)(surfaces, poses)
    share = _fraction(jnp.sum(free, axis=0), jnp.sum(seen, axis=0), points.dtype)
    return _fraction(jnp.sum(jnp.where(hit, share, 0.0)), jnp.sum(hit), points.dtype)


def _fraction(part: Array, whole: Array, dtype: np.dtype) -> Array:
    """Part / whole of numbers, 0 where there is nothing."""
    return part.astype(dtype) / jnp.maximum(whole, 1).astype(dtype)


def spread_over(match: MatchedPose, other: Array, advantage: Array) -> Array:
    """Information (3, 3) of a match if the scan may be at another place as well.

    Args:
        match: The match.
        other: (3,) [m, m, rad] the other pose.
        advantage: () difference of values by which the other one is better; negative.
    """
    probability = jax.nn.sigmoid(advantage / PROBABILITY_SCALE)
    offset = other - match.pose
    offset = offset.at[2].set(wrap_angle(offset[2]))
    pull = match.information @ offset
    share = probability * (1.0 - probability)
    return match.information - share * jnp.outer(pull, pull) / (1.0 + share * (offset @ pull))
