"""Where a scan is if the quick match is not to be trusted: candidates of a correlative search.

The quick match finds what lies near the prediction. Here the pose may be anywhere in a window of a
metre and a radian to either side, or of a whole turn where nothing fits. The candidates are refined
by ICP; the best of them takes the place of the quick match if it explains clearly more of the scan.
Poses far from what wheels or the motion before say are less likely, and have to explain more.

Where two places explain the scan about as well, the better one is kept, and the information is that
of a Gaussian with the mean and covariance of both: small in the direction from one to the other.
With probabilities p, 1 - p and the offset d between the two,

    cov' = H^-1 + p (1 - p) d d^T        H' = H - H d (H d)^T / (1 / (p (1 - p)) + d^T H d)
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import compose, wrap_angle
from jaxslam.core.types import Array
from jaxslam.matching import correlative
from jaxslam.matching.correlative import CorrelativeSpec
from jaxslam.matching.icp import MatchedPose, PosePrior, ScanMatchSpec, Submap, fine_icp, icp
from jaxslam.matching.motion_prior import difference

PROBABILITY_SCALE = 0.01
"""Difference of two inlier fractions that makes one place e times as likely as the other."""


def search_widely(
    spec: ScanMatchSpec,
    lidar: Lidar,
    submap: Submap,
    odometry: Array,
    points: Array,
    hit: Array,
    quick: MatchedPose,
) -> MatchedPose:
    """The quick match, or a better one from a wide window.

    Args:
        spec: Options.
        lidar: The scanner.
        submap: Of the scans before.
        odometry: (3,) [m, m, rad] increment by the wheels.
        points: (N, 2) [m] of the scan, robot frame.
        hit: (N,) bool, those of them that exist.
        quick: The quick match.
    """
    last, wide = submap.motion.increment, spec.search
    as_wheels_or_before = jnp.stack([odometry, last])
    expected = jax.vmap(compose, in_axes=(None, 0))(submap.last_pose, as_wheels_or_before)
    middle = compose(submap.last_pose, odometry + difference(odometry, last) / 2)
    surfaces = submap.oriented_points
    cloud, valid = surfaces.points.reshape(-1, 2), surfaces.valid.ravel()

    def look(window: CorrelativeSpec) -> Array:
        return correlative.search(window, cloud, valid, middle, expected, points, hit).poses

    candidates = lax.cond(
        quick.inlier_fraction < spec.lost_inliers,
        lambda: look(wide._replace(max_turn=jnp.pi)),
        lambda: look(wide),
    )
    std = jnp.array([spec.search_std[0], spec.search_std[0], spec.search_std[1]])
    thinned = slice(None, None, spec.coarse_stride)

    def value(match: MatchedPose) -> Array:
        return match.inlier_fraction - correlative.surprise(wide, expected, match.pose)

    def follow(start: Array) -> MatchedPose:
        prior = PosePrior(start, jnp.diag(1.0 / std**2))
        return icp(
            spec,
            lidar,
            submap,
            prior,
            start,
            points[thinned],
            hit[thinned],
            gates=spec.coarse_gates[-2:],  # a candidate is off by less than a cell
            kernel_scale=spec.kernel_scales[0],
        )

    followed = jax.vmap(follow)(candidates)
    values = jax.vmap(value)(followed)
    best, second = lax.top_k(values, 2)[1]
    start, runner_up = followed.pose[best], followed.pose[second]
    prior = PosePrior(start, jnp.diag(1.0 / std**2))
    found = fine_icp(spec, lidar, submap, prior, start, points, hit)
    found = found._replace(information=spread_over(found, runner_up, values[second] - values[best]))

    gain = value(found) - value(quick) - spec.min_gain
    match = jax.tree.map(partial(jnp.where, gain > 0.0), found, quick)
    other = jnp.where(gain > 0.0, quick.pose, found.pose)
    return match._replace(information=spread_over(match, other, -jnp.abs(gain)))


def spread_over(match: MatchedPose, other: Array, advantage: Array) -> Array:
    """Information (3, 3) of a match if the scan may be at another place as well.

    Args:
        match: The match.
        other: (3,) [m, m, rad] the other pose.
        advantage: () difference of inlier fractions by which the other one is better; negative.
    """
    probability = jax.nn.sigmoid(advantage / PROBABILITY_SCALE)
    offset = other - match.pose
    offset = offset.at[2].set(wrap_angle(offset[2]))
    pull = match.information @ offset
    share = probability * (1.0 - probability)
    return match.information - share * jnp.outer(pull, pull) / (1.0 + share * (offset @ pull))
