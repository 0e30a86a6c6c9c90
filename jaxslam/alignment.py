"""Scan matching: odometry from laser scans by point-to-line ICP against a sliding local map.

The local map holds the points of the last keyframe scans, with the normals of the surfaces they
lie on. A scan is registered where its points lie on these surfaces. ICP starts from several
headings around that of the odometry, as wheels slip most where a robot turns. The odometry is also
a weak prior, which keeps directions that the scans do not constrain, such as along a bare corridor.
The information returned with each increment is that of the scans alone; `fuse` combines both.

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
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam import lidar as lidars
from jaxslam import programs
from jaxslam.geometry import between, compose, dot, rotation, to_world, wrap_angle
from jaxslam.lidar import Lidar, Scan
from jaxslam.linalg import inverse_root
from jaxslam.types import Array

NEIGHBOURS = 3  # beams on either side that a normal is fitted to
JOINED = (0.06, 0.1)  # [m], and fraction of the range: larger gaps separate two surfaces
NOWHERE = 1e6  # [m] coordinates of points that must not become correspondences
FLAT = 0.04  # largest variance across a surface, as a fraction of that along it
LIKELY = 0.005  # inlier fraction that a heading 1 std off the odometry must have in addition
FLOOR = (0.01, 0.005)  # [m], [rad] least std of odometry where it is fused with scans


class AlignSpec(NamedTuple):
    """Options of scan matching; static under jit.

    Attributes:
        scans: K, keyframes of the local map.
        apart: [m], [rad] motion since the last keyframe from which a scan becomes the next one.
        beams: Points of a scan that are matched at most, evenly spaced.
        reach: Beams on either side of a point's own beam that are searched for its correspondence.
        turns: [rad] offsets of the initial headings from that of the odometry.
        recent: Keyframes that the coarse search matches against.
        thin: Every how many points the coarse search uses one.
        far: [m] largest distance of a correspondence, iteration by iteration, in the coarse search.
        near: [m] the same in the refinement.
        kernel: [m] residual at which the weight is one quarter, in coarse search and refinement.
        inner: Gauss-Newton steps between two searches for correspondences.
        noise: [m] std of a point's distance to its line. Much larger than that of a range, as the
            errors of neighbouring points are correlated.
        floor: [m], [rad] least std of the odometry prior.
        slip: Std of the odometry prior as fractions of distance and of turn.
    """

    scans: int = 25
    apart: tuple[float, float] = (0.1, 0.1)
    beams: int = 180
    reach: int = 3
    turns: tuple[float, ...] = (0.0, 0.15, -0.15, 0.3, -0.3)
    recent: int = 6
    thin: int = 4
    far: tuple[float, ...] = (0.8, 0.7, 0.6, 0.5, 0.4)
    near: tuple[float, ...] = (0.4, 0.25, 0.15)
    kernel: tuple[float, float] = (0.1, 0.05)
    inner: int = 3
    noise: float = 0.1
    floor: tuple[float, float] = (0.05, 0.1)
    slip: tuple[float, float] = (0.1, 1.0)


class Surfaces(NamedTuple):
    """Oriented points: points of a scan with the normals of their surfaces, in some frame.

    Attributes:
        points: (R, 2) [m] on the line fitted to the point and its neighbours.
        normal: (R, 2) unit normal of that line, of either sign.
        gap: (R,) [m] to the further of the two adjacent points on the surface.
        valid: (R,) bool.
    """

    points: Array
    normal: Array
    gap: Array
    valid: Array


class LocalMap(NamedTuple):
    """Ring buffer of the last K keyframes, in the odometry frame of the scan matcher.

    Attributes:
        surfaces: [K] oriented points, in the odometry frame.
        poses: (K, 3) of the keyframes.
        held: () int32 keyframes ever added; number n is in slot n modulo K.
        pose: (3,) of the last scan, keyframe or not.
    """

    surfaces: Surfaces
    poses: Array
    held: Array
    pose: Array


class Aligned(NamedTuple):
    """Result of scan matching: an odometry increment in the frame of the pose before.

    Attributes:
        motion: (3,) [m, m, rad].
        information: (3, 3) inverse covariance, from the scan alone; zero in directions that it does
            not constrain.
        explained: () inlier fraction: part of the points that lie on a surface of the map.
    """

    motion: Array
    information: Array
    explained: Array


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


def surfaces(scan: Scan, lidar: Lidar) -> Surfaces:
    """Oriented points of one scan, robot frame.

    The line of a point is the least-squares fit to itself and its neighbours up to the first gap.

    Raises:
        ValueError: The ranges are not those of one scan of this lidar; while tracing.
    """
    own = lidars.points(scan, lidar)
    index = jnp.arange(lidar.beams)
    neighbours, weight, gap = [own], [scan.hit], jnp.zeros(lidar.beams)
    limit = JOINED[0] + JOINED[1] * scan.ranges
    for side in (1, -1):
        joined, previous = scan.hit, own
        for k in range(1, NEIGHBOURS + 1):
            beam = index + side * k
            inside = (beam >= 0) & (beam < lidar.beams)
            beam = jnp.clip(beam, 0, lidar.beams - 1)
            distance = jnp.linalg.norm(own[beam] - previous, axis=-1)
            joined = joined & inside & scan.hit[beam] & (distance < limit)
            previous = own[beam]
            neighbours.append(previous)
            weight.append(joined)
            gap = jnp.where(joined & (k == 1), jnp.maximum(gap, distance), gap)
    neighbours, weight = jnp.stack(neighbours), jnp.stack(weight).astype(own.dtype)
    count = jnp.maximum(weight.sum(axis=0), 1.0)
    centre = jnp.sum(weight[..., None] * neighbours, axis=0) / count[:, None]
    offset = neighbours - centre[None]
    xx, xy, yy = (
        jnp.sum(weight * offset[..., i] * offset[..., j], axis=0) / count
        for i, j in ((0, 0), (0, 1), (1, 1))
    )
    # Eigenvalues of the scatter matrix are mean +- spread; the line is along the larger one.
    direction = 0.5 * jnp.arctan2(2 * xy, xx - yy)
    normal = jnp.stack([-jnp.sin(direction), jnp.cos(direction)], axis=-1)
    spread, mean = jnp.hypot(xx - yy, 2 * xy) / 2, (xx + yy) / 2
    flat = mean - spread < FLAT * (mean + spread)
    projected = own - dot(own - centre, normal)[:, None] * normal
    return Surfaces(projected, normal, gap, scan.hit & (count >= 3.0) & flat)


def laid(surfaces: Surfaces, pose: Array) -> Surfaces:
    """Oriented points of the frame of a pose (3,), in the frame that the pose is given in."""
    turn = rotation(pose[2])
    return surfaces._replace(
        points=to_world(pose, surfaces.points), normal=surfaces.normal @ turn.T
    )


def empty(spec: AlignSpec, lidar: Lidar) -> LocalMap:
    """A local map without keyframes; the odometry starts at zero."""
    size = spec.scans, lidar.beams
    nothing = Surfaces(
        jnp.zeros((*size, 2)), jnp.zeros((*size, 2)), jnp.zeros(size), jnp.zeros(size, bool)
    )
    return LocalMap(nothing, jnp.zeros((spec.scans, 3)), jnp.int32(0), jnp.zeros(3))


def _correspondences(
    spec: AlignSpec, lidar: Lidar, local: LocalMap, points: Array, hit: Array, far: Array
) -> _Correspondences:
    """Correspondences of points (N, 2), frame of the map: the nearest in each scan, if near enough.

    The search is projective: a point is transformed to the robot frame of the keyframe, its bearing
    gives a beam, and only the beams within `spec.reach` of that are compared. `far` () [m] limits
    the distances across and along the line; along it, the gap between two beams is allowed too.
    """
    middle = lidar.first + lidar.step * (lidar.beams - 1) / 2
    # Column by column, as pairs of numbers are gathered slowly.
    columns = jnp.where(local.surfaces.valid[..., None], local.surfaces.points, NOWHERE)
    columns = columns.swapaxes(1, 2)

    def on_keyframe(surface: Surfaces, column: Array, pose: Array) -> tuple[Array, Array, Array]:
        (x, y), (surface_x, surface_y) = points.T, column
        bearing = wrap_angle(jnp.arctan2(y - pose[1], x - pose[0]) - pose[2] - middle)
        own_beam = jnp.round(bearing / lidar.step + (lidar.beams - 1) / 2).astype(jnp.int32)
        least = jnp.full(hit.shape, jnp.inf, points.dtype)  # squared distance
        nearest = jnp.zeros_like(own_beam)
        for k in range(-spec.reach, spec.reach + 1):
            beam = jnp.clip(own_beam + k, 0, lidar.beams - 1)
            square = (x - surface_x[beam]) ** 2 + (y - surface_y[beam]) ** 2
            nearest, least = jnp.where(square < least, beam, nearest), jnp.minimum(square, least)
        normal = surface.normal[nearest]
        offset = dot(normal, surface.points[nearest])
        across = dot(normal, points) - offset
        limit = jnp.maximum(far, surface.gap[nearest])
        near = (jnp.abs(across) < far) & (least - across**2 < limit**2)
        return normal, offset, surface.valid[nearest] & hit & near

    normal, offset, found = jax.vmap(on_keyframe)(local.surfaces, columns, local.poses)
    found = found.astype(points.dtype)
    share = found / jnp.maximum(found.sum(axis=0), 1.0)[None]
    return _Correspondences(normal, offset, share)


def _normal_equations(
    spec: AlignSpec, pairs: _Correspondences, points: Array, pose: Array, kernel: Array
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
    return square / spec.noise**2, descent / spec.noise**2


def descend(
    spec: AlignSpec,
    lidar: Lidar,
    local: LocalMap,
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
        return _correspondences(spec, lidar, local, to_world(pose, points), hit, far)

    def gauss_newton(pairs: _Correspondences, pose: Array, _: None) -> tuple[Array, None]:
        information, descent = _normal_equations(spec, pairs, points, pose, kernel)
        offset = odometry_pose - pose
        descent = descent + odometry_information @ offset.at[2].set(wrap_angle(offset[2]))
        root = inverse_root(information + odometry_information)[0]
        return pose + root.T @ (root @ descent), None

    def iterate(pose: Array, far: Array) -> tuple[Array, None]:
        step = partial(gauss_newton, correspondences(pose, far))
        return lax.scan(step, pose, length=spec.inner)

    pose, _ = lax.scan(iterate, start, jnp.array(far))
    pairs = correspondences(pose, jnp.asarray(far[-1]))
    information, _ = _normal_equations(spec, pairs, points, pose, kernel)
    registered = to_world(pose, points)
    error = jnp.sum(pairs.normal * registered[None], axis=-1) - pairs.offset
    inlier = jnp.where(pairs.share > 0.0, jnp.exp(-((error / kernel) ** 2) / 8), 0.0)
    count = jnp.maximum(jnp.sum(hit, dtype=pose.dtype), 1.0)
    return pose, information, jnp.sum(jnp.max(inlier, axis=0)) / count


def align(
    spec: AlignSpec, lidar: Lidar, local: LocalMap, scan: Scan, wheels: Array
) -> tuple[LocalMap, Aligned]:
    """Match one scan, coarse to fine, and add it to the local map if it is a keyframe.

        1. Predict the pose by odometry; its std grows with the motion, by `spec.slip`.
        2. Coarse search: ICP from each heading of `spec.turns`, of few points to recent keyframes.
        3. Keep the start of the largest inlier fraction, less a penalty on its turn.
        4. Refine: ICP of all points to all keyframes, with closer correspondences.
        5. If that is not finite, the predicted pose and no information.

    Args:
        spec: Options.
        lidar: The scanner.
        local: The local map of the scans before.
        scan: One scan.
        wheels: (3,) odometry increment since the scan before.

    Returns:
        The local map after the scan, and the increment that the scan matcher finds.

    Raises:
        ValueError: The ranges are not those of one scan of this lidar; while tracing.
    """
    every = -(-lidar.beams // spec.beams)
    points, hit = lidars.points(scan, lidar)[::every], scan.hit[::every]
    predicted = compose(local.pose, wheels)
    moved = jnp.stack([jnp.hypot(wheels[0], wheels[1]), jnp.abs(wheels[2])])
    variance = jnp.array(spec.floor) ** 2 + (jnp.array(spec.slip) * moved) ** 2
    odometry_information = jnp.diag(1.0 / jnp.stack([variance[0], variance[0], variance[1]]))
    prior = predicted, odometry_information

    start = _best_start(spec, lidar, local, points, hit, prior, variance[1])
    pose, information, explained = descend(
        spec, lidar, local, points, hit, start, prior, spec.near, spec.kernel[1]
    )
    finite = jnp.all(jnp.isfinite(pose)) & jnp.all(jnp.isfinite(information))
    pose, information = jnp.where(finite, pose, predicted), jnp.where(finite, information, 0.0)
    pose = pose.at[2].set(wrap_angle(pose[2]))
    turn = jnp.eye(3).at[:2, :2].set(rotation(local.pose[2]))  # from the frame of the pose before
    aligned = Aligned(between(local.pose, pose), turn.T @ information @ turn, explained)
    return _add_keyframe(spec, lidar, local, scan, pose), aligned


def _best_start(
    spec: AlignSpec,
    lidar: Lidar,
    local: LocalMap,
    points: Array,
    hit: Array,
    prior: tuple[Array, Array],
    heading_variance: Array,
) -> Array:
    """Pose (3,) that the coarse search of `align` ends at."""
    age = jnp.arange(min(spec.recent, spec.scans), dtype=jnp.int32)
    recent_slots = (local.held - 1 - age) % spec.scans
    surfaces, poses = jax.tree.map(lambda x: x[recent_slots], (local.surfaces, local.poses))
    recent = local._replace(surfaces=surfaces, poses=poses)
    thinned = slice(None, None, spec.thin)
    predicted = prior[0]
    starts = predicted[None] + jnp.array([[0.0, 0.0, turn] for turn in spec.turns])

    def search(start: Array) -> tuple[Array, Array, Array]:
        kernel = spec.kernel[0]
        return descend(
            spec, lidar, recent, points[thinned], hit[thinned], start, prior, spec.far, kernel
        )

    poses, _, explained = jax.vmap(search)(starts)
    turned = wrap_angle(poses[:, 2] - predicted[2])
    return poses[jnp.argmax(explained - LIKELY * turned**2 / heading_variance)]


def _add_keyframe(
    spec: AlignSpec, lidar: Lidar, local: LocalMap, scan: Scan, pose: Array
) -> LocalMap:
    """The local map after a scan at a pose, which becomes a keyframe if it has moved enough."""
    size = spec.scans
    moved = between(local.poses[(local.held - 1) % size], pose)
    far = jnp.hypot(moved[0], moved[1]) > spec.apart[0]
    new = far | (jnp.abs(moved[2]) > spec.apart[1]) | (local.held == 0)
    slot = jnp.where(new, local.held % size, size)
    own = laid(surfaces(scan, lidar), pose)

    def put(held: Array, item: Array) -> Array:
        return held.at[slot].set(item, mode="drop")

    return LocalMap(
        jax.tree.map(put, local.surfaces, own),
        put(local.poses, pose),
        local.held + new.astype(jnp.int32),
        pose,
    )


@partial(programs.jit, static_argnames=("spec", "lidar"))
def follow(
    spec: AlignSpec,
    lidar: Lidar,
    local: LocalMap,
    scans: Scan,
    wheels: Array,
    count: Array | None = None,
) -> tuple[LocalMap, Aligned]:
    """Match scans [T] one after the other; return the local map after them, and increments [T].

    Args:
        spec: Options.
        lidar: The scanner.
        local: The local map of the scans before.
        scans: [T].
        wheels: (T, 3) odometry increments since the scan before; zero at the first of all.
        count: () int32 number of scans that exist, the first ones; None for all. The others are
            padding and leave the local map as it is.

    Raises:
        ValueError: The ranges are not those of this lidar; while tracing.
    """
    exists = jnp.arange(len(wheels), dtype=jnp.int32) < (len(wheels) if count is None else count)

    def body(local: LocalMap, now: tuple[Scan, Array, Array]) -> tuple[LocalMap, Aligned]:
        scan, odometry, exists = now
        after, aligned = align(spec, lidar, local, scan, odometry)
        return jax.tree.map(partial(jnp.where, exists), after, local), aligned

    return lax.scan(body, local, (scans, wheels, exists))


def fuse(wheels: Array, noise: Array, aligned: Aligned, scale: Array) -> tuple[Array, Array]:
    """Increment (3,) by odometry and scan matching together, and its covariance (3, 3).

    A Kalman update in information form: cov = (noise^-1 + H)^-1, with the scan's information H
    over `scale`^2. Without any, odometry and its noise are returned as they are.

    Args:
        wheels: (3,) odometry increment.
        noise: (3, 3) its covariance; `FLOOR` is added where there is something to fuse it with.
        aligned: Result of scan matching.
        scale: () factor on the standard deviation of scan matching.
    """
    information = aligned.information / scale**2
    floor = jnp.array([FLOOR[0], FLOOR[0], FLOOR[1]]) ** 2
    noise_root = inverse_root(noise + jnp.diag(floor))[0]
    cov_root = inverse_root(noise_root.T @ noise_root + information)[0]
    cov = cov_root.T @ cov_root
    innovation = aligned.motion - wheels
    innovation = innovation.at[2].set(wrap_angle(innovation[2]))
    matched = jnp.any(aligned.information != 0.0)
    motion = wheels + cov @ (information @ innovation)
    return jnp.where(matched, motion, wheels), jnp.where(matched, cov, noise)
