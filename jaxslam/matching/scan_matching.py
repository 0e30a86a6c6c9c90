"""Scan matching: odometry from laser scans by point-to-line ICP against a sliding local map.

The local map holds the points of the last keyframe scans, with the normals of the surfaces they
lie on. A scan is registered where its points lie on these surfaces. ICP starts from several
headings around that of the odometry, as wheels slip most where a robot turns. The odometry is also
a weak prior, which keeps directions that the scans do not constrain, such as along a bare corridor.
The information returned with each increment is that of the scans alone; `fuse_odometry` combines both.

Point-to-line ICP. With R = R(heading) and t the position of a pose, a scan point p has the world
position q = R p + t. Its correspondence on scan k of the map, if it has one, is the surface point
s with unit normal n nearest to q among the beams around its bearing. Then

    e     = n^T (q - s)                                    residual: distance to the line
    de    = [n_x, n_y, n_y (R p)_x - n_x (R p)_y] dpose    its derivative, a row J
    w     = share / (1 + (e / kernel)^2)^2                 Geman-McClure weight
    H     = sum w J^T J / noise^2                          information of the scan
    dpose = (H + H_odom)^-1 (-sum w J^T e / noise^2 + H_odom (pose_odom - pose))

where the sums run over all points and scans of the map, and `share` is one over the number of
correspondences of the point, so that each point counts once. H_odom is the odometry's information.

References:
    Censi (2008), An ICP variant using a point-to-line metric. Olson (2009), Real-time correlative
    scan matching: a search over headings. Geman, McClure (1987), Statistical methods for
    tomographic image reconstruction: the kernel.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core import trace_cache
from jaxslam.core.linalg import inverse_cholesky
from jaxslam.core.measurement import ScanMatch
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import compose, relative, rotation, wrap_angle
from jaxslam.core.types import Array
from jaxslam.frontend.lidar import beam_ends
from jaxslam.matching.icp import ScanMatchSpec, Submap, icp
from jaxslam.matching.oriented_points import OrientedPoints, oriented_points, transform_points

TURN_PENALTY = 0.005  # inlier fraction that a heading 1 std off the odometry must have in addition
FUSION_STD_FLOOR = (0.01, 0.005)  # [m], [rad] least std of odometry where it is fused with scans


def empty_submap(spec: ScanMatchSpec, lidar: Lidar) -> Submap:
    """A local map without keyframes; the odometry starts at zero."""
    size = spec.window_scans, lidar.num_beams
    nothing = OrientedPoints(
        jnp.zeros((*size, 2)), jnp.zeros((*size, 2)), jnp.zeros(size), jnp.zeros(size, bool)
    )
    return Submap(nothing, jnp.zeros((spec.window_scans, 3)), jnp.int32(0), jnp.zeros(3))


def match_scan(
    spec: ScanMatchSpec, lidar: Lidar, submap: Submap, scan: Scan, odometry: Array
) -> tuple[Submap, ScanMatch]:
    """Match one scan, coarse to fine, and add it to the local map if it is a keyframe.

        1. Predict the pose by odometry; its std grows with the motion, by `spec.slip`.
        2. Coarse search: ICP from each heading of `spec.turns`, of few points to recent keyframes.
        3. Keep the start of the largest inlier fraction, less a penalty on its turn.
        4. Refine: ICP of all points to all keyframes, with closer correspondences.
        5. If that is not finite, the predicted pose and no information.

    Args:
        spec: Options.
        lidar: The scanner.
        submap: The local map of the scans before.
        scan: One scan.
        odometry: (3,) odometry increment since the scan before.

    Returns:
        The local map after the scan, and the increment that the scan matcher finds.

    Raises:
        ValueError: The ranges are not those of one scan of this lidar; while tracing.
    """
    every = -(-lidar.num_beams // spec.max_beams)
    points, hit = beam_ends(lidar, scan)[::every], scan.hit[::every]
    predicted = compose(submap.last_pose, odometry)
    moved = jnp.stack([jnp.hypot(odometry[0], odometry[1]), jnp.abs(odometry[2])])
    variance = (
        jnp.array(spec.odometry_std_floor) ** 2 + (jnp.array(spec.odometry_slip) * moved) ** 2
    )
    odometry_information = jnp.diag(1.0 / jnp.stack([variance[0], variance[0], variance[1]]))
    prior = predicted, odometry_information

    start = _best_start(spec, lidar, submap, points, hit, prior, variance[1])
    pose, information, explained = icp(
        spec, lidar, submap, points, hit, start, prior, spec.fine_gates, spec.kernel_scales[1]
    )
    finite = jnp.all(jnp.isfinite(pose)) & jnp.all(jnp.isfinite(information))
    pose, information = jnp.where(finite, pose, predicted), jnp.where(finite, information, 0.0)
    pose = pose.at[2].set(wrap_angle(pose[2]))
    turn = (
        jnp.eye(3).at[:2, :2].set(rotation(submap.last_pose[2]))
    )  # from the frame of the pose before
    aligned = ScanMatch(relative(submap.last_pose, pose), turn.T @ information @ turn, explained)
    return _add_keyframe(spec, lidar, submap, scan, pose), aligned


def _best_start(
    spec: ScanMatchSpec,
    lidar: Lidar,
    local: Submap,
    points: Array,
    hit: Array,
    prior: tuple[Array, Array],
    heading_variance: Array,
) -> Array:
    """Pose (3,) that the coarse search of `match_scan` ends at."""
    age = jnp.arange(min(spec.coarse_scans, spec.window_scans), dtype=jnp.int32)
    recent_slots = (local.num_added - 1 - age) % spec.window_scans
    surfaces, poses = jax.tree.map(lambda x: x[recent_slots], (local.oriented_points, local.poses))
    recent = local._replace(oriented_points=surfaces, poses=poses)
    thinned = slice(None, None, spec.coarse_stride)
    predicted = prior[0]
    starts = predicted[None] + jnp.array([[0.0, 0.0, turn] for turn in spec.heading_guesses])

    def search(start: Array) -> tuple[Array, Array, Array]:
        kernel = spec.kernel_scales[0]
        return icp(
            spec,
            lidar,
            recent,
            points[thinned],
            hit[thinned],
            start,
            prior,
            spec.coarse_gates,
            kernel,
        )

    poses, _, explained = jax.vmap(search)(starts)
    turned = wrap_angle(poses[:, 2] - predicted[2])
    return poses[jnp.argmax(explained - TURN_PENALTY * turned**2 / heading_variance)]


def _add_keyframe(
    spec: ScanMatchSpec, lidar: Lidar, local: Submap, scan: Scan, pose: Array
) -> Submap:
    """The local map after a scan at a pose, which becomes a keyframe if it has moved enough."""
    size = spec.window_scans
    moved = relative(local.poses[(local.num_added - 1) % size], pose)
    far = jnp.hypot(moved[0], moved[1]) > spec.keyframe_distance[0]
    new = far | (jnp.abs(moved[2]) > spec.keyframe_distance[1]) | (local.num_added == 0)
    slot = jnp.where(new, local.num_added % size, size)
    own = transform_points(oriented_points(lidar, scan), pose)

    def put(held: Array, item: Array) -> Array:
        return held.at[slot].set(item, mode="drop")

    return Submap(
        jax.tree.map(put, local.oriented_points, own),
        put(local.poses, pose),
        local.num_added + new.astype(jnp.int32),
        pose,
    )


@partial(trace_cache.jit, static_argnames=("spec", "lidar"))
def match_scans(
    spec: ScanMatchSpec,
    lidar: Lidar,
    submap: Submap,
    scans: Scan,
    odometry: Array,
    count: Array | None = None,
) -> tuple[Submap, ScanMatch]:
    """Match scans [T] one after the other; return the local map after them, and increments [T].

    Args:
        spec: Options.
        lidar: The scanner.
        submap: The local map of the scans before.
        scans: [T].
        odometry: (T, 3) odometry increments since the scan before; zero at the first of all.
        count: () int32 number of scans that exist, the first ones; None for all. The others are
            padding and leave the local map as it is.

    Raises:
        ValueError: The ranges are not those of this lidar; while tracing.
    """
    exists = jnp.arange(len(odometry), dtype=jnp.int32) < (
        len(odometry) if count is None else count
    )

    def body(local: Submap, now: tuple[Scan, Array, Array]) -> tuple[Submap, ScanMatch]:
        scan, odometry, exists = now
        after, aligned = match_scan(spec, lidar, local, scan, odometry)
        return jax.tree.map(partial(jnp.where, exists), after, local), aligned

    return lax.scan(body, submap, (scans, odometry, exists))


def fuse_odometry(
    odometry: Array, odometry_cov: Array, scan_match: ScanMatch, std_scale: Array
) -> tuple[Array, Array]:
    """Increment (3,) by odometry and scan matching together, and its covariance (3, 3).

    A Kalman update in information form: cov = (noise^-1 + H)^-1, with the scan's information H
    over `std_scale`^2. Without any, odometry and its noise are returned as they are.

    Args:
        odometry: (3,) odometry increment.
        odometry_cov: (3, 3) its covariance; `FUSION_STD_FLOOR` is added where there is something to fuse it with.
        scan_match: Result of scan matching.
        std_scale: () factor on the standard deviation of scan matching.
    """
    information = scan_match.information / std_scale**2
    floor = jnp.array([FUSION_STD_FLOOR[0], FUSION_STD_FLOOR[0], FUSION_STD_FLOOR[1]]) ** 2
    noise_root = inverse_cholesky(odometry_cov + jnp.diag(floor))[0]
    cov_root = inverse_cholesky(noise_root.T @ noise_root + information)[0]
    cov = cov_root.T @ cov_root
    innovation = scan_match.increment - odometry
    innovation = innovation.at[2].set(wrap_angle(innovation[2]))
    matched = jnp.any(scan_match.information != 0.0)
    motion = odometry + cov @ (information @ innovation)
    return jnp.where(matched, motion, odometry), jnp.where(matched, cov, odometry_cov)
