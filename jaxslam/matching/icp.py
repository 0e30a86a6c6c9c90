"""TODO."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.linalg import inverse_cholesky
from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import dot, rotation, transform, wrap_angle
from jaxslam.core.types import Array
from jaxslam.matching.oriented_points import OrientedPoints

FAR_AWAY = 1e6  # [m] coordinates of points that must not become correspondences


class ScanMatchSpec(NamedTuple):
    """Options of scan matching; static under jit.

    Attributes:
        window_scans: K, keyframes of the local map.
        keyframe_distance: [m], [rad] motion since the last keyframe from which a scan becomes the next one.
        max_beams: Points of a scan that are matched at most, evenly spaced.
        beam_window: Beams on either side of a point's own beam that are searched for its correspondence.
        heading_guesses: [rad] offsets of the initial headings from that of the odometry.
        coarse_scans: Keyframes that the coarse search matches against.
        coarse_stride: Every how many points the coarse search uses one.
        coarse_gates: [m] largest distance of a correspondence, iteration by iteration, in the coarse search.
        fine_gates: [m] the same in the refinement.
        kernel_scales: [m] residual at which the weight is one quarter, in coarse search and refinement.
        inner_iterations: Gauss-Newton steps between two searches for correspondences.
        point_std: [m] std of a point's distance to its line. Much larger than that of a range, as the
            errors of neighbouring points are correlated.
        odometry_std_floor: [m], [rad] least std of the odometry prior.
        odometry_slip: Std of the odometry prior as fractions of distance and of turn.
    """

    window_scans: int = 25
    keyframe_distance: tuple[float, float] = (0.1, 0.1)
    max_beams: int = 180
    beam_window: int = 3
    heading_guesses: tuple[float, ...] = (0.0, 0.15, -0.15, 0.3, -0.3)
    coarse_scans: int = 6
    coarse_stride: int = 4
    coarse_gates: tuple[float, ...] = (0.8, 0.7, 0.6, 0.5, 0.4)
    fine_gates: tuple[float, ...] = (0.4, 0.25, 0.15)
    kernel_scales: tuple[float, float] = (0.1, 0.05)
    inner_iterations: int = 3
    point_std: float = 0.1
    odometry_std_floor: tuple[float, float] = (0.05, 0.1)
    odometry_slip: tuple[float, float] = (0.1, 1.0)


class Submap(NamedTuple):
    """Ring buffer of the last K keyframes, in the odometry frame of the scan matcher.

    Attributes:
        oriented_points: [K] oriented points, in the odometry frame.
        poses: (K, 3) of the keyframes.
        num_added: () int32 keyframes ever added; number n is in slot n modulo K.
        last_pose: (3,) of the last scan, keyframe or not.
    """

    oriented_points: OrientedPoints
    poses: Array
    num_added: Array
    last_pose: Array


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


def _correspondences(
    spec: ScanMatchSpec, lidar: Lidar, local: Submap, points: Array, hit: Array, far: Array
) -> _Correspondences:
    """Correspondences of points (N, 2), frame of the map: the nearest in each scan, if near enough.

    The search is projective: a point is transformed to the robot frame of the keyframe, its bearing
    gives a beam, and only the beams within `spec.reach` of that are compared. `far` () [m] limits
    the distances across and along the line; along it, the gap between two beams is allowed too.
    """
    middle = lidar.angle_min + lidar.angle_increment * (lidar.num_beams - 1) / 2
    # Column by column, as pairs of numbers are gathered slowly.
    columns = jnp.where(
        local.oriented_points.valid[..., None], local.oriented_points.points, FAR_AWAY
    )
    columns = columns.swapaxes(1, 2)

    def on_keyframe(
        surface: OrientedPoints, column: Array, pose: Array
    ) -> tuple[Array, Array, Array]:
        (x, y), (surface_x, surface_y) = points.T, column
        bearing = wrap_angle(jnp.arctan2(y - pose[1], x - pose[0]) - pose[2] - middle)
        own_beam = jnp.round(bearing / lidar.angle_increment + (lidar.num_beams - 1) / 2).astype(
            jnp.int32
        )
        least = jnp.full(hit.shape, jnp.inf, points.dtype)  # squared distance
        nearest = jnp.zeros_like(own_beam)
        for k in range(-spec.beam_window, spec.beam_window + 1):
            beam = jnp.clip(own_beam + k, 0, lidar.num_beams - 1)
            square = (x - surface_x[beam]) ** 2 + (y - surface_y[beam]) ** 2
            nearest, least = jnp.where(square < least, beam, nearest), jnp.minimum(square, least)
        normal = surface.normal[nearest]
        offset = dot(normal, surface.points[nearest])
        across = dot(normal, points) - offset
        limit = jnp.maximum(far, surface.neighbour_gap[nearest])
        near = (jnp.abs(across) < far) & (least - across**2 < limit**2)
        return normal, offset, surface.valid[nearest] & hit & near

    normal, offset, found = jax.vmap(on_keyframe)(local.oriented_points, columns, local.poses)
    found = found.astype(points.dtype)
    share = found / jnp.maximum(found.sum(axis=0), 1.0)[None]
    return _Correspondences(normal, offset, share)


def _normal_equations(
    spec: ScanMatchSpec, pairs: _Correspondences, points: Array, pose: Array, kernel: Array
) -> tuple[Array, Array]:
    """H (3, 3) and -sum w J^T e / noise^2 (3,), for points (N, 2), robot frame, at a pose (3,)."""
    x, y = (points @ rotation(pose[2]).T).T
    normal_x, normal_y = pairs.normal[..., 0], pairs.normal[..., 1]
    error = normal_x * (x + pose[0])[None] + normal_y * (y + pose[1])[None] - pairs.offset
    weight = pairs.share / (1.0 + (error / kernel) ** 2) ** 2
    by_heading = normal_y * x[None] - normal_x * y[None]
    jacobian = normal_x, normal_y, by_heading

    def total(first: Array, second: Array) -> Array:
        return jnp.sum(weight * first * second)

    upper = {(i, j): total(jacobian[i], jacobian[j]) for i in range(3) for j in range(i, 3)}
    square = jnp.stack(
        [jnp.stack([upper[min(i, j), max(i, j)] for j in range(3)]) for i in range(3)]
    )
    descent = jnp.stack([total(column, -error) for column in jacobian])
    return square / spec.point_std**2, descent / spec.point_std**2


def icp(
    spec: ScanMatchSpec,
    lidar: Lidar,
    local: Submap,
    points: Array,
    hit: Array,
    start: Array,
    wheels: tuple[Array, Array],
    far: tuple[float, ...],
    kernel: float,
) -> tuple[Array, Array, Array]:
    """Point-to-line ICP of one scan against the local map; the module's docstring has the formulas.

        for each distance of `far`:
            find the correspondences at the pose
            repeat `spec.inner` times:  pose += (H + H_odom)^-1 (...)

    Args:
        spec: Options.
        lidar: The scanner that the map was made with.
        local: What to match against.
        points: (N, 2) [m] of the scan, robot frame.
        hit: (N,) bool, those of them that exist.
        start: (3,) initial pose, in the frame of the map.
        wheels: Pose (3,) by the odometry, and its information (3, 3).
        far: [m] largest distance of a correspondence, iteration by iteration.
        kernel: [m] scale of the Geman-McClure kernel.

    Returns:
        Pose (3,), its heading not wrapped; information (3, 3) of the scan alone, in the frame of
        the map; inlier fraction (), in which a residual e counts exp(-(e / kernel)^2 / 8).
    """
    odometry_pose, odometry_information = wheels

    def correspondences(pose: Array, far: Array) -> _Correspondences:
        return _correspondences(spec, lidar, local, transform(pose, points), hit, far)

    def gauss_newton(pairs: _Correspondences, pose: Array, _: None) -> tuple[Array, None]:
        information, descent = _normal_equations(spec, pairs, points, pose, kernel)
        offset = odometry_pose - pose
        descent = descent + odometry_information @ offset.at[2].set(wrap_angle(offset[2]))
        root = inverse_cholesky(information + odometry_information)[0]
        return pose + root.T @ (root @ descent), None

    def iterate(pose: Array, far: Array) -> tuple[Array, None]:
        step = partial(gauss_newton, correspondences(pose, far))
        return lax.scan(step, pose, length=spec.inner_iterations)

    pose, _ = lax.scan(iterate, start, jnp.array(far))
    pairs = correspondences(pose, jnp.asarray(far[-1]))
    information, _ = _normal_equations(spec, pairs, points, pose, kernel)
    registered = transform(pose, points)
    error = jnp.sum(pairs.normal * registered[None], axis=-1) - pairs.offset
    inlier = jnp.where(pairs.share > 0.0, jnp.exp(-((error / kernel) ** 2) / 8), 0.0)
    count = jnp.maximum(jnp.sum(hit, dtype=pose.dtype), 1.0)
    return pose, information, jnp.sum(jnp.max(inlier, axis=0)) / count
