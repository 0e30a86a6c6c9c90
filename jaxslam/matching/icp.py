"""Point-to-line ICP of one scan against a submap of earlier scans.

With R = R(heading) and t the position of a pose, a scan point p has the position q = R p + t in the
frame of the submap. Its correspondence on scan k of the submap, if it has one, is the oriented
point s with unit normal n nearest to q among the beams around its bearing. Then

    e     = n^T (q - s)                                    residual: distance to the line
    de    = [n_x, n_y, n_y (R p)_x - n_x (R p)_y] dpose    its derivative, a row J
    w     = share / (1 + (e / kernel)^2)^2                 Geman-McClure weight
    H     = sum w J^T J / point_std^2                      information of the scan
    dpose = (H + H_prior)^-1 (-sum w J^T e / point_std^2 + H_prior (pose_prior - pose))

where the sums run over all points and scans of the submap, and `share` is one over the number of
correspondences of the point, so that each point counts once. H_prior is the prior's information.

References:
    Censi (2008), An ICP variant using a point-to-line metric. Geman, McClure (1987), Statistical
    methods for tomographic image reconstruction: the kernel.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import dot, transform, wrap_angle
from jaxslam.core.types import Array
from jaxslam.matching.correlative import CorrelativeSpec
from jaxslam.matching.oriented_points import OrientedPoints, beam_towards

FAR_AWAY = 1e6
"""[m] coordinates of points that must not become correspondences."""


class ScanMatchSpec(NamedTuple):
    """Options of scan matching; static under jit.

    Attributes:
        window_scans: K, keyframes of the submap.
        keyframe_distance: [m], [rad] motion since the last keyframe from which a scan becomes the
            next one, and is matched with all of the submap.
        max_beams: Points of a scan that are matched at most, evenly spaced.
        beam_window: Beams on either side of a point's own beam that are searched for its
            correspondence.
        track_scans: Keyframes, the last ones, that every scan is tracked with.
        track_gates: [m] largest distance of a correspondence, iteration by iteration, in tracking.
        track_kernels: [m] residual at which the weight is one quarter, iteration by iteration.
        coarse_stride: Every how many points the coarse search for a loop closure uses one.
        coarse_gates: [m] largest distance of a correspondence in it, iteration by iteration.
        fine_gates: [m] the same in the refinement.
        kernel_scales: [m] residual at which the weight is one quarter, in coarse search and
            refinement.
        inner_iterations: Gauss-Newton steps between two searches for correspondences.
        point_std: [m] std of a point's distance to its line. Much larger than that of a range, as
            the errors of neighbouring points are correlated.
        odometry_std_floor: [m], [rad] least std of the odometry prior.
        odometry_slip: Std of the odometry prior as fractions of distance and of turn.
        use_odometry: Whether the wheels are used; without, the motion is expected to be as before.
        max_inlier_drop: Inlier fraction that the quick match may have less than is usual; below, a
            wide window is searched too.
        lost_inliers: Inlier fraction below which all headings are searched.
        min_gain: Value that a pose of the wide search must have in addition.
        search_std: [m], [rad] std of its candidates, for ICP.
        search: Options of the wide search.
    """

    window_scans: int = 25
    keyframe_distance: tuple[float, float] = (0.3, 0.3)
    max_beams: int = 180
    beam_window: int = 3
    track_scans: int = 6
    track_gates: tuple[float, ...] = (0.8, 0.6, 0.4, 0.25, 0.15)
    track_kernels: tuple[float, ...] = (0.1, 0.1, 0.1, 0.07, 0.05)
    coarse_stride: int = 4
    coarse_gates: tuple[float, ...] = (0.8, 0.7, 0.6, 0.5, 0.4)
    fine_gates: tuple[float, ...] = (0.4, 0.25, 0.15)
    kernel_scales: tuple[float, float] = (0.1, 0.05)
    inner_iterations: int = 3
    point_std: float = 0.1
    odometry_std_floor: tuple[float, float] = (0.05, 0.1)
    odometry_slip: tuple[float, float] = (0.1, 1.0)
    use_odometry: bool = True
    max_inlier_drop: float = 0.1
    lost_inliers: float = 0.3
    min_gain: float = 0.01
    search_std: tuple[float, float] = (0.2, 0.3)
    search: CorrelativeSpec = CorrelativeSpec()


class MotionHistory(NamedTuple):
    """What is remembered of the motion and of the matches, from scan to scan.

    Attributes:
        increment: (3,) [m, m, rad] the last increment.
        usual_change: (2,) [m], [rad] running mean of its change from scan to scan.
        contradicted: () 0 to 1, how often of late the wheels contradicted the scans.
        usual_inliers: () running mean of the inlier fraction.
        wheel_scale: () true distance per distance that the wheels report, as far as it is learned.
        scale_information: () its inverse variance.
        wheels_reverse: () bool, whether the wheels ever reported driving backwards.
    """

    increment: Array
    usual_change: Array
    contradicted: Array
    usual_inliers: Array
    wheel_scale: Array
    scale_information: Array
    wheels_reverse: Array


class Submap(NamedTuple):
    """Ring buffer of the last K keyframes, in the odometry frame of the scan matcher.

    Attributes:
        oriented_points: [K] oriented points, in the odometry frame.
        poses: (K, 3) [m, m, rad] of the keyframes.
        num_added: () int32 keyframes ever added; number n is in slot n modulo K.
        last_pose: (3,) [m, m, rad] of the last scan, keyframe or not.
        motion: What is remembered of the motion.
    """

    oriented_points: OrientedPoints
    poses: Array
    num_added: Array
    last_pose: Array
    motion: MotionHistory


class PosePrior(NamedTuple):
    """What is known of a scan's pose before it is matched, in the frame of the submap.

    Attributes:
        pose: (3,) [m, m, rad] mean.
        information: (3, 3) inverse covariance.
    """

    pose: Array
    information: Array


class MatchedPose(NamedTuple):
    """A pose of a scan that ICP ended at.

    Attributes:
        pose: (3,) [m, m, rad] frame of the submap.
        information: (3, 3) of the scan alone, in the same frame.
        inlier_fraction: () of its points.
    """

    pose: Array
    information: Array
    inlier_fraction: Array


class _Correspondences(NamedTuple):
    """Lines that N points correspond to, on each of K scans.

    Attributes:
        normal: (K, N, 2) unit normal n.
        offset: (K, N) [m] n^T s.
        share: (K, N) weight of the correspondence, 1 in total for a point that has any; 0 for none.
    """

    normal: Array
    offset: Array
    share: Array


def icp(
    spec: ScanMatchSpec,
    lidar: Lidar,
    submap: Submap,
    prior: PosePrior,
    start: Array,
    points: Array,
    hit: Array,
    *,
    gates: tuple[float, ...],
    kernels: tuple[float, ...],
) -> MatchedPose:
    """Point-to-line ICP of one scan against a submap; the module's docstring has the formulas.

        for each gate:
            find the correspondences at the pose, none further than the gate
            repeat `spec.inner_iterations` times:  pose += (H + H_prior)^-1 (...)

    Args:
        spec: Options.
        lidar: The scanner that the submap was made with.
        submap: What to match against.
        prior: Pose that is expected, as by odometry.
        start: (3,) [m, m, rad] initial pose, in the frame of the submap.
        points: (N, 2) [m] of the scan, robot frame.
        hit: (N,) bool, those of them that exist.
        gates: [m] largest distance of a correspondence, iteration by iteration; static.
        kernels: [m] scale of the Geman-McClure kernel, iteration by iteration; static.

    Returns:
        The pose, its heading not wrapped; in the inlier fraction a residual e counts
        exp(-(e / kernel)^2 / 8).
    """

    def correspondences(pose: Array, gate: Array) -> _Correspondences:
        return _correspondences(spec, lidar, submap, transform(pose, points), hit, gate)

    def gauss_newton(
        pairs: _Correspondences, kernel: Array, pose: Array, _: None
    ) -> tuple[Array, None]:
        information, descent = _normal_equations(spec, kernel, pairs, pose, points)
        offset = prior.pose - pose
        descent = descent + prior.information @ offset.at[2].set(wrap_angle(offset[2]))
        return pose + solve(information + prior.information, descent), None

    def iterate(pose: Array, scales: tuple[Array, Array]) -> tuple[Array, None]:
        gate, kernel = scales
        step = partial(gauss_newton, correspondences(pose, gate), kernel)
        return lax.scan(step, pose, length=spec.inner_iterations)

    pose, _ = lax.scan(iterate, start, (jnp.array(gates), jnp.array(kernels)))
    pairs, kernel = correspondences(pose, jnp.asarray(gates[-1])), jnp.asarray(kernels[-1])
    information, _ = _normal_equations(spec, kernel, pairs, pose, points)
    registered = transform(pose, points)
    error = jnp.sum(pairs.normal * registered[None], axis=-1) - pairs.offset
    inlier = jnp.where(pairs.share > 0.0, jnp.exp(-((error / kernel) ** 2) / 8), 0.0)
    count = jnp.maximum(jnp.sum(hit, dtype=pose.dtype), 1.0)
    return MatchedPose(pose, information, jnp.sum(jnp.max(inlier, axis=0)) / count)


def fine_icp(
    spec: ScanMatchSpec,
    lidar: Lidar,
    submap: Submap,
    prior: PosePrior,
    start: Array,
    points: Array,
    hit: Array,
) -> MatchedPose:
    """ICP with close correspondences; arguments as of `icp`."""
    gates, scale = spec.fine_gates, spec.kernel_scales[1]
    kernels = (scale,) * len(gates)
    return icp(spec, lidar, submap, prior, start, points, hit, gates=gates, kernels=kernels)


def _correspondences(
    spec: ScanMatchSpec, lidar: Lidar, submap: Submap, points: Array, hit: Array, gate: Array
) -> _Correspondences:
    """Correspondences of points (N, 2), frame of the submap: in each scan the nearest in the gate.

    The search is projective: a point is transformed to the robot frame of the keyframe, its bearing
    gives a beam, and only the beams within `spec.beam_window` of that are compared. `gate` () [m]
    limits the distances across and along the line; along it, the gap between two beams is allowed
    too.
    """
    # Column by column, as pairs of numbers are gathered slowly.
    columns = jnp.where(
        submap.oriented_points.valid[..., None], submap.oriented_points.points, FAR_AWAY
    )
    columns = columns.swapaxes(1, 2)

    def on_keyframe(
        surface: OrientedPoints, column: Array, pose: Array
    ) -> tuple[Array, Array, Array]:
        (x, y), (surface_x, surface_y) = points.T, column
        own_beam = beam_towards(lidar, pose, points)
        least = jnp.full(hit.shape, jnp.inf, points.dtype)  # squared distance
        nearest = jnp.zeros_like(own_beam)
        for k in range(-spec.beam_window, spec.beam_window + 1):
            beam = jnp.clip(own_beam + k, 0, lidar.num_beams - 1)
            square = (x - surface_x[beam]) ** 2 + (y - surface_y[beam]) ** 2
            nearest, least = jnp.where(square < least, beam, nearest), jnp.minimum(square, least)
        normal = surface.normal[nearest]
        offset = dot(normal, surface.points[nearest])
        across = dot(normal, points) - offset
        limit = jnp.maximum(gate, surface.neighbour_gap[nearest])
        near = (jnp.abs(across) < gate) & (least - across**2 < limit**2)
        return normal, offset, surface.valid[nearest] & hit & near

    normal, offset, found = jax.vmap(on_keyframe)(submap.oriented_points, columns, submap.poses)
    found = found.astype(points.dtype)
    share = found / jnp.maximum(found.sum(axis=0), 1.0)[None]
    return _Correspondences(normal, offset, share)


def _normal_equations(
    spec: ScanMatchSpec, kernel: Array, pairs: _Correspondences, pose: Array, points: Array
) -> tuple[Array, Array]:
    """H (3, 3) and -sum w J^T e / point_std^2 (3,) at a pose (3,), points (N, 2) in robot frame."""
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = cos * points[:, 0] - sin * points[:, 1], sin * points[:, 0] + cos * points[:, 1]
    normal_x, normal_y = pairs.normal[..., 0], pairs.normal[..., 1]
    error = normal_x * (x + pose[0])[None] + normal_y * (y + pose[1])[None] - pairs.offset
    weight = pairs.share / (1.0 + (error / kernel) ** 2) ** 2 / spec.point_std**2
    by_heading = normal_y * x[None] - normal_x * y[None]
    columns = jnp.stack([normal_x, normal_y, by_heading, -error]).reshape(4, -1)
    square = (columns[:3] * weight.reshape(1, -1)) @ columns.T
    return square[:, :3], square[:, 3]


def solve(a: Array, b: Array) -> Array:
    """Solution x (3,) of A x = b with a positive definite A (3, 3), by its cofactors."""
    rows = jnp.stack([jnp.cross(a[1], a[2]), jnp.cross(a[2], a[0]), jnp.cross(a[0], a[1])])
    return rows.T @ b / (a[0] @ rows[0])
