"""Scan matching: odometry from laser scans by point-to-line ICP against a sliding submap.

The submap holds the points of the last keyframe scans, with the normals of the surfaces they are
on. A scan is registered where its points are on these surfaces. ICP starts from several headings
around that of the odometry, as wheels slip most where a robot turns. The odometry is also a weak
prior, which keeps directions that the scans do not constrain, such as along a bare corridor.
The information returned with each increment is that of the scans alone; `fuse_odometry` combines
both. `icp` has the formulas.

    submap = empty_submap(spec, lidar)
    submap, match = match_scan(spec, lidar, submap, scan, odometry)      # one scan
    submap, matches = match_scans(spec, lidar, submap, scans, odometry)  # T scans, compiled

References:
    Olson (2009), Real-time correlative scan matching: a search over headings.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core import trace_cache
from jaxslam.core.linalg import inverse_cholesky
from jaxslam.core.measurement import ScanMatch
from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.se2 import compose, relative, rotation, wrap_angle
from jaxslam.core.types import AnyArray, Array
from jaxslam.frontend.lidar import beam_ends
from jaxslam.matching import checks, correlative
from jaxslam.matching.icp import PosePrior, ScanMatchSpec, Submap, icp
from jaxslam.matching.motion_prior import contradicts, difference, expected_motion, first_history, is_leap, next_history
from jaxslam.matching.mount import mount_variance
from jaxslam.matching.oriented_points import OrientedPoints, oriented_points, transform_points

TURN_PENALTY = 0.005
"""Inlier fraction that a heading 1 std off the odometry must have in addition."""

FUSION_STD_FLOOR = (0.01, 0.005)
"""[m], [rad] least std of odometry where it is fused with scans."""


def empty_submap(spec: ScanMatchSpec, lidar: Lidar) -> Submap:
    """A submap without keyframes; the odometry starts at zero.

    Raises:
        ValueError: An option is out of range.
    """
    checks.check_scan_match_spec(spec)
    check_lidar(lidar)
    size = spec.window_scans, lidar.num_beams
    nothing = OrientedPoints(
        jnp.zeros((*size, 2)), jnp.zeros((*size, 2)), jnp.zeros(size), jnp.zeros(size, bool)
    )
    return Submap(nothing, jnp.zeros((spec.window_scans, 3)), jnp.int32(0), jnp.zeros(3), first_history())


def match_scan(
    spec: ScanMatchSpec, lidar: Lidar, submap: Submap, scan: Scan, odometry: AnyArray
) -> tuple[Submap, ScanMatch]:
    """Match one scan, coarse to fine, and add it to the submap if it is a keyframe.

        1. Predict the pose by odometry; its std grows with the motion, by `spec.odometry_slip`.
        2. Coarse search: ICP from each of `spec.heading_guesses`, of few points to recent
           keyframes.
        3. Keep the start of the largest inlier fraction, less a penalty on its turn.
        4. Refine: ICP of all points to all keyframes, with closer correspondences.
        5. If that is not finite, the predicted pose and no information.

    It is one step, for robots online: call it by `jax.jit(match_scan, static_argnums=(0, 1))`.

    Args:
        spec: Options.
        lidar: The scanner.
        submap: The submap of the scans before.
        scan: One scan.
        odometry: (3,) [m, m, rad] odometry increment since the scan before.

    Returns:
        The submap after the scan, and the increment that the scan matcher finds.

    Raises:
        ValueError: Scan, odometry or submap are not those of this lidar and these options.
    """
    checks.check_scan_match_spec(spec)
    submap = checks.as_submap(spec, lidar, submap)
    odometry = checks.as_default_float("odometry", odometry, (3,))
    scan = checks.as_scans("scan", lidar, scan)
    return _match_scan(spec, lidar, submap, scan, odometry)


def match_scans(
    spec: ScanMatchSpec,
    lidar: Lidar,
    submap: Submap,
    scans: Scan,
    odometry: AnyArray,
    count: AnyArray | int | None = None,
) -> tuple[Submap, ScanMatch]:
    """Match scans [T] one after the other; return the submap after them, and increments [T].

    Compiled once for each T: match a long log in chunks of one length, the last padded by any
    scans and marked by `count`.

    Args:
        spec: Options.
        lidar: The scanner.
        submap: The submap of the scans before.
        scans: [T].
        odometry: (T, 3) [m, m, rad] odometry increments since the scan before; zero at the first
            of all.
        count: () int number of scans that exist, the first ones; None for all. The others are
            padding and leave the submap as it is.

    Raises:
        ValueError: Scans, odometry or submap are not those of this lidar and these options, there
            are not as many scans as increments, or `count` is not 0 to T.
    """
    checks.check_scan_match_spec(spec)
    submap = checks.as_submap(spec, lidar, submap)
    odometry = checks.as_default_float("odometry", odometry, ("T", 3))
    scans = checks.as_scans("scans", lidar, scans, odometry.shape[:1])
    if count is not None:
        count = checks.as_count("count", count, len(odometry))
    return _match_scans(spec, lidar, submap, scans, odometry, count)


def fuse_odometry(
    std_scale: Array, odometry: Array, odometry_cov: Array, scan_match: ScanMatch
) -> tuple[Array, Array]:
    """Increment (3,) by odometry and scan matching together, and its covariance (3, 3).

    A Kalman update in information form: cov = (Q^-1 + H / std_scale^2)^-1, with the covariance Q
    of the odometry and the information H of the scan. Without any, odometry and its covariance
    are returned as they are.

    Args:
        std_scale: () factor on the standard deviation of scan matching.
        odometry: (3,) [m, m, rad] odometry increment.
        odometry_cov: (3, 3) its covariance; `FUSION_STD_FLOOR` is added where there is something
            to fuse it with.
        scan_match: Result of scan matching.
    """
    information = scan_match.information / std_scale**2
    floor = jnp.array([FUSION_STD_FLOOR[0], FUSION_STD_FLOOR[0], FUSION_STD_FLOOR[1]]) ** 2
    floor = jnp.diag(floor) + mount_variance(odometry)
    if scan_match.expected is not None:
        odometry = scan_match.expected
        distrust = 1.0 - scan_match.wheel_trust
        odometry_cov = odometry_cov + distrust * jnp.diag(jnp.array([0.2, 0.2, 0.3]) ** 2)
    innovation = scan_match.increment - odometry
    innovation = innovation.at[2].set(wrap_angle(innovation[2]))
    odometry_root = inverse_cholesky(odometry_cov + floor)[0]
    by_odometry = odometry_root.T @ odometry_root
    weight = _odometry_weight(by_odometry, information, innovation)
    cov_root = inverse_cholesky(weight * by_odometry + information)[0]
    cov = cov_root.T @ cov_root
    matched = jnp.any(scan_match.information != 0.0)
    increment = odometry + cov @ (information @ innovation)
    return jnp.where(matched, increment, odometry), jnp.where(matched, cov, odometry_cov)


def _odometry_weight(odometry_information: Array, information: Array, innovation: Array) -> Array:
    """Weight () of odometry, by a Student t distribution of 3 degrees of freedom.

    d^2 = e^T (Q + H^-1)^-1 e, where (Q + H^-1)^-1 = H - H (Q^-1 + H)^-1 H also for a singular H.
    """
    root = inverse_cholesky(odometry_information + information)[0]
    pull = information @ innovation
    square = innovation @ pull - jnp.sum((root @ pull) ** 2)
    return jnp.minimum(1.0, 6.0 / (3.0 + jnp.maximum(square, 0.0)))


def _match_scan(
    spec: ScanMatchSpec, lidar: Lidar, submap: Submap, scan: Scan, odometry: Array
) -> tuple[Submap, ScanMatch]:
    """`match_scan` of what has been checked."""
    every = -(-lidar.num_beams // spec.max_beams)
    points, hit = beam_ends(lidar, scan)[::every], scan.hit[::every]
    history, before = submap.motion, submap.last_pose
    motion = expected_motion(spec, history, odometry, history.distrust)
    prior = PosePrior(compose(before, motion.increment), jnp.diag(motion.information))

    start = _best_start(spec, lidar, submap, prior, 1.0 / motion.information[2], points, hit)
    quick = _refine(spec, lidar, submap, prior, start, points, hit)
    found = relative(before, quick[0])
    little = quick[2] < history.usual_inliers - spec.max_inlier_drop
    leap = is_leap(history, odometry)
    contra = contradicts(spec, odometry, found)
    odd = (little | leap | contra) & (submap.num_added > 0)
    wide = partial(_search, spec, lidar, submap, odometry, points, hit, quick)
    pose, information, inlier_fraction = lax.cond(odd, wide, lambda: quick)
    finite = jnp.all(jnp.isfinite(pose)) & jnp.all(jnp.isfinite(information))
    pose, information = jnp.where(finite, pose, prior.pose), jnp.where(finite, information, 0.0)
    pose = pose.at[2].set(wrap_angle(pose[2]))
    # From the frame of the pose before.
    turn = jnp.eye(3).at[:2, :2].set(rotation(before[2]))
    increment = relative(before, pose)
    contradicted = contradicts(spec, odometry, increment)
    believed = expected_motion(
        spec, history, odometry, jnp.maximum(history.distrust, contradicted)
    )
    match = ScanMatch(
        increment,
        turn.T @ information @ turn,
        inlier_fraction,
        believed.increment,
        believed.trust,
        jnp.stack([odd, little, leap, contra, quick[2]]),
    )
    history = next_history(history, increment, inlier_fraction, contradicted)
    return _add_keyframe(spec, lidar, submap._replace(motion=history), scan, pose), match


def _refine(
    spec: ScanMatchSpec,
    lidar: Lidar,
    submap: Submap,
    prior: PosePrior,
    start: Array,
    points: Array,
    hit: Array,
) -> tuple[Array, Array, Array]:
    """ICP of all points to all keyframes, with close correspondences."""
    return icp(
        spec,
        lidar,
        submap,
        prior,
        start,
        points,
        hit,
        gates=spec.fine_gates,
        kernel_scale=spec.kernel_scales[1],
    )


def _search(
    spec: ScanMatchSpec,
    lidar: Lidar,
    submap: Submap,
    odometry: Array,
    points: Array,
    hit: Array,
    quick: tuple[Array, Array, Array],
) -> tuple[Array, Array, Array]:
    """The best of the quick match and of the candidates of a wide correlative search."""
    before, last = submap.last_pose, submap.motion.increment
    expected = jnp.stack([compose(before, odometry), compose(before, last)])
    middle = compose(before, odometry + difference(odometry, last) / 2)
    surfaces = submap.oriented_points
    candidates = correlative.search(
        spec.search, surfaces.points.reshape(-1, 2), surfaces.valid.ravel(), middle, expected, points, hit
    ).poses
    std = jnp.array([spec.motion_std[0], spec.motion_std[0], spec.motion_std[1]])
    thinned = slice(None, None, spec.coarse_stride)

    def follow(start: Array) -> tuple[Array, Array]:
        pose, _, inlier_fraction = icp(
            spec,
            lidar,
            submap,
            PosePrior(start, jnp.diag(1.0 / std**2)),
            start,
            points[thinned],
            hit[thinned],
            gates=spec.coarse_gates[2:],
            kernel_scale=spec.kernel_scales[0],
        )
        return pose, inlier_fraction - correlative.surprise(spec.search, expected, pose)

    poses, score = jax.vmap(follow)(candidates)
    best = poses[jnp.argmax(score)]
    other = _refine(spec, lidar, submap, PosePrior(best, jnp.diag(1.0 / std**2)), best, points, hit)
    gain = other[2] - quick[2]
    gain -= correlative.surprise(spec.search, expected, other[0])
    gain += correlative.surprise(spec.search, expected, quick[0])
    return jax.tree.map(partial(jnp.where, gain > spec.min_gain), other, quick)


def _best_start(
    spec: ScanMatchSpec,
    lidar: Lidar,
    submap: Submap,
    prior: PosePrior,
    heading_variance: Array,
    points: Array,
    hit: Array,
) -> Array:
    """Pose (3,) that the coarse search of `match_scan` ends at."""
    age = jnp.arange(min(spec.coarse_scans, spec.window_scans), dtype=jnp.int32)
    recent_slots = (submap.num_added - 1 - age) % spec.window_scans
    surfaces, poses = jax.tree.map(
        lambda x: x[recent_slots], (submap.oriented_points, submap.poses)
    )
    recent = submap._replace(oriented_points=surfaces, poses=poses)
    thinned = slice(None, None, spec.coarse_stride)
    starts = prior.pose[None] + jnp.array([[0.0, 0.0, turn] for turn in spec.heading_guesses])

    def search(start: Array) -> tuple[Array, Array, Array]:
        return icp(
            spec,
            lidar,
            recent,
            prior,
            start,
            points[thinned],
            hit[thinned],
            gates=spec.coarse_gates,
            kernel_scale=spec.kernel_scales[0],
        )

    poses, _, inlier_fraction = jax.vmap(search)(starts)
    turned = wrap_angle(poses[:, 2] - prior.pose[2])
    return poses[jnp.argmax(inlier_fraction - TURN_PENALTY * turned**2 / heading_variance)]


def _add_keyframe(
    spec: ScanMatchSpec, lidar: Lidar, submap: Submap, scan: Scan, pose: Array
) -> Submap:
    """The submap after a scan at a pose, which becomes a keyframe if it has moved enough."""
    size = spec.window_scans
    moved = relative(submap.poses[(submap.num_added - 1) % size], pose)
    far = jnp.hypot(moved[0], moved[1]) > spec.keyframe_distance[0]
    new = far | (jnp.abs(moved[2]) > spec.keyframe_distance[1]) | (submap.num_added == 0)
    slot = jnp.where(new, submap.num_added % size, size)
    keyframe = transform_points(pose, oriented_points(lidar, scan))

    def put(held: Array, item: Array) -> Array:
        return held.at[slot].set(item, mode="drop")

    return Submap(
        jax.tree.map(put, submap.oriented_points, keyframe),
        put(submap.poses, pose),
        submap.num_added + new.astype(jnp.int32),
        pose,
        submap.motion,
    )


@partial(trace_cache.jit, static_argnames=("spec", "lidar"))
def _match_scans(
    spec: ScanMatchSpec,
    lidar: Lidar,
    submap: Submap,
    scans: Scan,
    odometry: Array,
    count: Array | None,
) -> tuple[Submap, ScanMatch]:
    """`match_scans` of what has been checked."""
    exists = jnp.arange(len(odometry), dtype=jnp.int32) < (
        len(odometry) if count is None else count
    )

    def body(submap: Submap, now: tuple[Scan, Array, Array]) -> tuple[Submap, ScanMatch]:
        scan, odometry, exists = now
        after, match = _match_scan(spec, lidar, submap, scan, odometry)
        return jax.tree.map(partial(jnp.where, exists), after, submap), match

    return lax.scan(body, submap, (scans, odometry, exists))
