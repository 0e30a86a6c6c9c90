"""Scan matching: odometry from laser scans by point-to-line ICP against a sliding submap.

The submap holds the points of the last keyframe scans, with the normals of the surfaces they are
on. A scan is registered where its points are on these surfaces, by ICP from the pose that is
expected: with the last few keyframes, and if it becomes a keyframe itself, with all. The pose that
is expected is also a weak prior, which keeps directions that the scans do not constrain, such as
along a bare corridor.

Wheels may be wrong by far more than ICP reaches: they slip, hang, or repeat old values. Where this
quick match explains less of the scan than usual or contradicts the wheels, or the wheels leap or
are only guessed, `wide_search` looks further. Wheels that are contradicted again and again are
trusted less (`motion_prior`); with `use_odometry=False` they are not used at all.
The information returned with each increment is that of the scans alone; `odometry_fusion` combines
both. `icp` has the formulas.

    submap = empty_submap(spec, lidar)
    submap, match = match_scan(spec, lidar, submap, scan, odometry)      # one scan
    submap, matches = match_scans(spec, lidar, submap, scans, odometry)  # T scans, compiled
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core import trace_cache
from jaxslam.core.arguments import as_bool
from jaxslam.core.measurement import ScanMatch
from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.se2 import compose, relative, rotation, wrap_angle
from jaxslam.core.types import AnyArray, Array
from jaxslam.frontend.lidar import beam_ends
from jaxslam.matching import checks
from jaxslam.matching.icp import MatchedPose, PosePrior, ScanMatchSpec, Submap, fine_icp, icp
from jaxslam.matching.motion_prior import (
    GUESSED_OUTLIER,
    change_variance,
    contradicts,
    expected_motion,
    first_history,
    leap,
    learn_scale,
    next_history,
    pose_hypotheses,
    wheel_motion,
    wrong_again,
)
from jaxslam.matching.oriented_points import OrientedPoints, oriented_points, transform_points
from jaxslam.matching.wide_search import search_widely


def empty_submap(spec: ScanMatchSpec, lidar: Lidar) -> Submap:
    """A submap without keyframes; the odometry starts at zero.

    Raises:
        ValueError: An option is out of range.
    """
    checks.check_scan_match_spec(spec)
    check_lidar(lidar)
    return _no_keyframes(spec.window_scans, lidar.num_beams)


@partial(jax.jit, static_argnums=(0, 1))
def _no_keyframes(window_scans: int, num_beams: int) -> Submap:
    size = window_scans, num_beams
    nothing = OrientedPoints(
        jnp.zeros((*size, 2)), jnp.zeros((*size, 2)), jnp.zeros(size), jnp.zeros(size, bool)
    )
    return Submap(
        nothing, jnp.zeros((window_scans, 3)), jnp.int32(0), jnp.zeros(3), first_history()
    )


def match_scan(
    spec: ScanMatchSpec,
    lidar: Lidar,
    submap: Submap,
    scan: Scan,
    odometry: AnyArray,
    *,
    guessed: AnyArray | bool = False,
) -> tuple[Submap, ScanMatch]:
    """Match one scan, coarse to fine, and add it to the submap if it is a keyframe.

        1. Predict the pose by odometry, as far as it is trusted; its std grows with the motion, by
           `spec.odometry_slip`.
        2. Track: ICP of all points to recent keyframes, from far correspondences to close
           ones.
        3. If it has moved enough to become a keyframe: ICP of all points to all keyframes, with
           close correspondences.
        4. If this explains little, contradicts the wheels, or these are not to be trusted, search a
           wide window as well. Under `jax.vmap` that is computed for every scan, needed or not.
        5. If the result is not finite, the predicted pose and no information.

    It is one step, for robots online: call it by `jax.jit(match_scan, static_argnums=(0, 1))`.

    Args:
        spec: Options.
        lidar: The scanner.
        submap: The submap of the scans before.
        scan: One scan.
        odometry: (3,) [m, m, rad] odometry increment since the scan before.
        guessed: () bool, whether that is a guess of the reader, not what the wheels said.

    Returns:
        The submap after the scan, and the increment that the scan matcher finds.

    Raises:
        ValueError: Scan, odometry or submap are not those of this lidar and these options.
    """
    checks.check_scan_match_spec(spec)
    submap = checks.as_submap(spec, lidar, submap)
    odometry = checks.as_default_float("odometry", odometry, (3,))
    scan = checks.as_scans("scan", lidar, scan)
    guessed = as_bool("guessed", guessed, ())
    return _match_scan(spec, lidar, submap, scan, odometry, guessed)


def match_scans(
    spec: ScanMatchSpec,
    lidar: Lidar,
    submap: Submap,
    scans: Scan,
    odometry: AnyArray,
    count: AnyArray | int | None = None,
    *,
    guessed: AnyArray | None = None,
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
        guessed: (T,) bool, which increments are guesses of the reader, not what the wheels said;
            None for none.

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
    if guessed is None:
        guessed = np.zeros(len(odometry), bool)
    guessed = as_bool("guessed", guessed, odometry.shape[:1])
    return _match_scans(spec, lidar, submap, scans, odometry, guessed, count)


def _match_scan(
    spec: ScanMatchSpec, lidar: Lidar, submap: Submap, scan: Scan, odometry: Array, guessed: Array
) -> tuple[Submap, ScanMatch]:
    """`match_scan` of what has been checked."""
    every = -(-lidar.num_beams // spec.max_beams)
    points, hit = beam_ends(lidar, scan)[::every], scan.hit[::every]
    before, history = submap.last_pose, submap.motion
    wheels = wheel_motion(spec, history, odometry, guessed)
    motion = expected_motion(history, wheels)
    turn = jnp.eye(3).at[:2, :2].set(rotation(before[2]))  # from the frame of the pose before
    information = turn @ jnp.diag(motion.information) @ turn.T
    prior = PosePrior(compose(before, motion.increment), information)

    tracked = _track(spec, lidar, submap, prior, points, hit)
    is_keyframe = _has_moved(spec, submap, tracked.pose)
    quick = lax.cond(
        is_keyframe,
        lambda: fine_icp(spec, lidar, submap, prior, tracked.pose, points, hit),
        lambda: tracked,
    )
    # Scans that are only tracked may wait for the next keyframe, if they explain something.
    max_drop = spec.max_inlier_drop * jnp.where(is_keyframe, 1.0, 1.5)
    explains_little = quick.inlier_fraction < history.usual_inliers - max_drop
    odd = explains_little | guessed | wrong_again(spec, history, wheels)
    odd |= contradicts(wheels, relative(before, quick.pose))
    leaps = leap(spec, history, wheels)
    match = lax.cond(
        (odd | leaps) & (submap.num_added > 0),
        lambda quick: search_widely(
            spec,
            lidar,
            submap,
            pose_hypotheses(history, wheels, before),
            points,
            hit,
            quick,
            ~odd,
        ),
        lambda quick: quick,
        quick,
    )
    finite = jnp.all(jnp.isfinite(match.pose)) & jnp.all(jnp.isfinite(match.information))
    pose = jnp.where(finite, match.pose, prior.pose)
    pose = pose.at[2].set(wrap_angle(pose[2]))
    information = jnp.where(finite, match.information, 0.0)
    increment = relative(before, pose)
    contradicted = contradicts(wheels, increment)
    outlier = jnp.where(contradicted, 1.0, wheels.outlier_probability)
    expected = expected_motion(history, wheels._replace(outlier_probability=outlier))
    result = ScanMatch(
        increment,
        turn.T @ information @ turn,
        match.inlier_fraction,
        expected.increment,
        (1.0 - expected.odometry_weight) * change_variance(history),
        expected.odometry_weight,
    )
    learn = finite & ~contradicted & (wheels.outlier_probability < GUESSED_OUTLIER)
    history = learn_scale(history, wheels, increment, result.information, learn)
    history = next_history(history, wheels, increment, match.inlier_fraction, contradicted)
    return _add_keyframe(spec, lidar, submap._replace(motion=history), scan, pose), result


def _track(
    spec: ScanMatchSpec, lidar: Lidar, submap: Submap, prior: PosePrior, points: Array, hit: Array
) -> MatchedPose:
    """Where the scan is by the last `spec.track_scans` keyframes alone."""
    age = jnp.arange(min(spec.track_scans, spec.window_scans), dtype=jnp.int32)
    recent_slots = (submap.num_added - 1 - age) % spec.window_scans
    surfaces, poses = jax.tree.map(
        lambda x: x[recent_slots], (submap.oriented_points, submap.poses)
    )
    return icp(
        spec,
        lidar,
        submap._replace(oriented_points=surfaces, poses=poses),
        prior,
        prior.pose,
        points,
        hit,
        gates=spec.track_gates,
        kernels=spec.track_kernels,
    )


def _has_moved(spec: ScanMatchSpec, submap: Submap, pose: Array) -> Array:
    """Whether a scan at a pose is far enough from the last keyframe to become one; () bool."""
    moved = relative(submap.poses[(submap.num_added - 1) % spec.window_scans], pose)
    far = jnp.hypot(moved[0], moved[1]) > spec.keyframe_distance[0]
    return far | (jnp.abs(moved[2]) > spec.keyframe_distance[1]) | (submap.num_added == 0)


def _add_keyframe(
    spec: ScanMatchSpec, lidar: Lidar, submap: Submap, scan: Scan, pose: Array
) -> Submap:
    """The submap after a scan at a pose, which becomes a keyframe if it has moved enough."""
    new = _has_moved(spec, submap, pose)
    slot = jnp.where(new, submap.num_added % spec.window_scans, spec.window_scans)
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
    guessed: Array,
    count: Array | None,
) -> tuple[Submap, ScanMatch]:
    """`match_scans` of what has been checked."""
    exists = jnp.arange(len(odometry), dtype=jnp.int32) < (
        len(odometry) if count is None else count
    )

    def body(submap: Submap, now: tuple[Scan, Array, Array, Array]) -> tuple[Submap, ScanMatch]:
        scan, odometry, guessed, exists = now
        after, match = _match_scan(spec, lidar, submap, scan, odometry, guessed)
        return jax.tree.map(partial(jnp.where, exists), after, submap), match

    return lax.scan(body, submap, (scans, odometry, guessed, exists))
