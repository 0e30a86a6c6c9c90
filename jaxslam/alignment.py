"""Odometry from scans: each is aligned to the local map of the last ones, beginning at the wheels.

The local map holds the points of the last scans, with the normals of the surfaces they lie on. A
scan is laid where its points lie on those surfaces (point to line), from several first guesses of
its heading, as wheels slip when a robot turns. What the scans do not show, such as the way along a
bare corridor, stays as the wheels say: the information that comes with each motion is that of the
scans alone, and `fuse` puts the two together.

References:
    Censi (2008), An ICP variant using a point-to-line metric. Olson (2009), Real-time correlative
    scan matching: why several guesses are worth their time.
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


class AlignSpec(NamedTuple):
    """How scans are aligned; static under jit."""

    scans: int = 25  # K of the local map
    apart: tuple[float, float] = (0.1, 0.1)  # [m], [rad] from the last that joined it to the next
    beams: int = 180  # of a scan that are aligned at most, evenly taken
    reach: int = 3  # beams on either side of a point's own in which its partner is looked for
    turns: tuple[float, ...] = (0.0, 0.15, -0.15, 0.3, -0.3)  # [rad] of the first guesses
    recent: int = 6  # scans of the local map that a guess is made with
    thin: int = 4  # and every so many beams
    far: tuple[float, ...] = (0.8, 0.7, 0.6, 0.5, 0.4)  # [m] to a partner, round by round: a guess
    near: tuple[float, ...] = (0.4, 0.25, 0.15)  # and the result
    kernel: tuple[float, float] = (0.1, 0.05)  # [m] residual that counts a quarter, likewise
    inner: int = 3  # steps of Gauss-Newton with the same partners
    noise: float = 0.1  # [m] of a point off its line: much more than a range's, as errors go along
    floor: tuple[float, float] = (0.05, 0.1)  # [m], [rad] of the wheels, for the alignment
    slip: tuple[float, float] = (0.1, 1.0)  # parts of the way and of the turn, likewise


class Surfaces(NamedTuple):
    """Points of a scan on the surfaces they belong to, in some frame."""

    points: Array  # (R, 2) [m] on the line through its neighbours
    normal: Array  # (R, 2) of that line, either way
    gap: Array  # (R,) [m] to the further of the two neighbours on the surface
    valid: Array  # (R,) bool


class LocalMap(NamedTuple):
    """The last scans where they were made, in the frame of the scan odometry."""

    surfaces: Surfaces  # [K]
    poses: Array  # (K, 3)
    held: Array  # () int32 scans that have ever joined; they take turns
    pose: Array  # (3,) of the last scan


class Aligned(NamedTuple):
    """What scans tell of a motion, in the frame of the pose before."""

    motion: Array  # (3,) [m, m, rad]
    information: Array  # (3, 3) inverse covariance; zero in directions that they do not show
    explained: Array  # () part of the points that found a surface


class _Pairs(NamedTuple):
    """Partners of N points on K scans."""

    normal: Array  # (K, N, 2)
    offset: Array  # (K, N) [m] of the line along its normal
    share: Array  # (K, N) what each weighs: a point weighs 1 in all; 0 for none


NEIGHBOURS = 3  # on either side, whose line gives the normal
JOINED = (0.06, 0.1)  # [m], and part of the range: neighbours further apart are on two surfaces
NOWHERE = 1e6  # [m] where points are put that are no partners
FLAT = 0.04  # most variance across a surface, as part of that along it


def surfaces(scan: Scan, lidar: Lidar) -> Surfaces:
    """Surfaces of one scan, robot frame.

    A point's line is that of least squares through its neighbours up to the first gap.
    """
    own = lidars.points(scan, lidar)
    index = jnp.arange(lidar.beams)
    near, weight, gap = [own], [scan.hit], jnp.zeros(lidar.beams)
    limit = JOINED[0] + JOINED[1] * scan.ranges
    for side in (1, -1):
        joined, before = scan.hit, own
        for k in range(1, NEIGHBOURS + 1):
            at = index + side * k
            inside = (at >= 0) & (at < lidar.beams)
            at = jnp.clip(at, 0, lidar.beams - 1)
            apart = jnp.linalg.norm(own[at] - before, axis=-1)
            joined = joined & inside & scan.hit[at] & (apart < limit)
            before = own[at]
            near.append(before)
            weight.append(joined)
            gap = jnp.where(joined & (k == 1), jnp.maximum(gap, apart), gap)
    near, weight = jnp.stack(near), jnp.stack(weight).astype(own.dtype)
    count = jnp.maximum(weight.sum(axis=0), 1.0)
    centre = jnp.sum(weight[..., None] * near, axis=0) / count[:, None]
    off = near - centre[None]
    xx, xy, yy = (
        jnp.sum(weight * off[..., i] * off[..., j], axis=0) / count
        for i, j in ((0, 0), (0, 1), (1, 1))
    )
    along = 0.5 * jnp.arctan2(2 * xy, xx - yy)
    normal = jnp.stack([-jnp.sin(along), jnp.cos(along)], axis=-1)
    spread, mean = jnp.hypot(xx - yy, 2 * xy) / 2, (xx + yy) / 2
    flat = mean - spread < FLAT * (mean + spread)
    foot = own - dot(own - centre, normal)[:, None] * normal
    return Surfaces(foot, normal, gap, scan.hit & (count >= 3.0) & flat)


def laid(surfaces: Surfaces, pose: Array) -> Surfaces:
    """Surfaces of the frame of a pose (3,), in the frame that the pose is in."""
    turn = rotation(pose[2])
    return surfaces._replace(
        points=to_world(pose, surfaces.points), normal=surfaces.normal @ turn.T
    )


def empty(spec: AlignSpec, lidar: Lidar) -> LocalMap:
    """A local map without scans; the odometry starts at zero."""
    size = spec.scans, lidar.beams
    nothing = Surfaces(
        jnp.zeros((*size, 2)), jnp.zeros((*size, 2)), jnp.zeros(size), jnp.zeros(size, bool)
    )
    return LocalMap(nothing, jnp.zeros((spec.scans, 3)), jnp.int32(0), jnp.zeros(3))


def _partners(
    spec: AlignSpec, lidar: Lidar, local: LocalMap, points: Array, hit: Array, far: Array
) -> _Pairs:
    """Partners of points (N, 2), frame of the map, within a distance: the nearest in each scan."""
    middle = lidar.first + lidar.step * (lidar.beams - 1) / 2
    # Column by column, as pairs of numbers are gathered slowly.
    columns = jnp.where(local.surfaces.valid[..., None], local.surfaces.points, NOWHERE)
    columns = columns.swapaxes(1, 2)

    def of(surface: Surfaces, column: Array, pose: Array) -> tuple[Array, Array, Array]:
        (x, y), (u, v) = points.T, column
        bearing = wrap_angle(jnp.arctan2(y - pose[1], x - pose[0]) - pose[2] - middle)
        own = jnp.round(bearing / lidar.step + (lidar.beams - 1) / 2).astype(jnp.int32)
        best, at = jnp.full(hit.shape, jnp.inf, points.dtype), jnp.zeros_like(own)
        for k in range(-spec.reach, spec.reach + 1):
            beam = jnp.clip(own + k, 0, lidar.beams - 1)
            square = (x - u[beam]) ** 2 + (y - v[beam]) ** 2
            at, best = jnp.where(square < best, beam, at), jnp.minimum(square, best)
        normal = surface.normal[at]
        offset = dot(normal, surface.points[at])
        across = dot(normal, points) - offset
        limit = jnp.maximum(far, surface.gap[at])
        near = (jnp.abs(across) < far) & (best - across**2 < limit**2)
        return normal, offset, surface.valid[at] & hit & near

    normal, offset, found = jax.vmap(of)(local.surfaces, columns, local.poses)
    found = found.astype(points.dtype)
    return _Pairs(normal, offset, found / jnp.maximum(found.sum(axis=0), 1.0)[None])


def _system(
    spec: AlignSpec, pairs: _Pairs, points: Array, pose: Array, kernel: Array
) -> tuple[Array, Array]:
    """Information (3, 3) of the pairs in a pose, and its product (3,) with the step to take."""
    turned = points @ rotation(pose[2]).T
    x, y = turned.T
    a, b = pairs.normal[..., 0], pairs.normal[..., 1]
    error = a * (x + pose[0])[None] + b * (y + pose[1])[None] - pairs.offset
    weight = pairs.share / (1.0 + (error / kernel) ** 2) ** 2
    lever = b * x[None] - a * y[None]
    rows = a, b, lever
    total = lambda u, v: jnp.sum(weight * u * v)
    upper = {(i, j): total(rows[i], rows[j]) for i in range(3) for j in range(i, 3)}
    row = lambda i: jnp.stack([upper[min(i, j), max(i, j)] for j in range(3)])
    square = jnp.stack([row(0), row(1), row(2)])
    pull = jnp.stack([total(row, -error) for row in rows])
    return square / spec.noise**2, pull / spec.noise**2


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
    """Pose (3,) of a scan from a first guess of it, its information, and the part explained."""
    told, sure = wheels

    def pairs_at(pose: Array, far: Array) -> _Pairs:
        return _partners(spec, lidar, local, to_world(pose, points), hit, far)

    def improve(pairs: _Pairs, pose: Array, _: None) -> tuple[Array, None]:
        square, pull = _system(spec, pairs, points, pose, kernel)
        off = told - pose
        pull = pull + sure @ off.at[2].set(wrap_angle(off[2]))
        root = inverse_root(square + sure)[0]
        return pose + root.T @ (root @ pull), None

    def turn(pose: Array, far: Array) -> tuple[Array, None]:
        return lax.scan(partial(improve, pairs_at(pose, far)), pose, length=spec.inner)

    pose, _ = lax.scan(turn, start, jnp.array(far))
    pairs = pairs_at(pose, jnp.asarray(far[-1]))
    square, _ = _system(spec, pairs, points, pose, kernel)
    there = to_world(pose, points)
    error = jnp.sum(pairs.normal * there[None], axis=-1) - pairs.offset
    near = jnp.where(pairs.share > 0.0, jnp.exp(-((error / kernel) ** 2) / 8), 0.0)
    count = jnp.maximum(jnp.sum(hit, dtype=pose.dtype), 1.0)
    return pose, square, jnp.sum(jnp.max(near, axis=0)) / count


def align(
    spec: AlignSpec, lidar: Lidar, local: LocalMap, scan: Scan, wheels: Array
) -> tuple[LocalMap, Aligned]:
    """Align a scan, and let it join the local map if it was made somewhere new.

    Args:
        spec: How.
        lidar: The scanner.
        local: Of the scans before.
        scan: One scan.
        wheels: (3,) motion since the scan before, by the wheels.
    """
    every = -(-lidar.beams // spec.beams)
    points, hit = lidars.points(scan, lidar)[::every], scan.hit[::every]
    guess = compose(local.pose, wheels)
    rolled = jnp.stack([jnp.hypot(wheels[0], wheels[1]), jnp.abs(wheels[2])])
    unsure = jnp.array(spec.floor) ** 2 + (jnp.array(spec.slip) * rolled) ** 2
    sure = jnp.diag(1.0 / jnp.stack([unsure[0], unsure[0], unsure[1]]))
    wheels_say = guess, sure

    back = jnp.arange(min(spec.recent, spec.scans), dtype=jnp.int32)
    last = (local.held - 1 - back) % spec.scans
    some = lambda x: x[last]
    few = local._replace(surfaces=jax.tree.map(some, local.surfaces), poses=some(local.poses))
    thin = slice(None, None, spec.thin)
    starts = guess[None] + jnp.array([[0.0, 0.0, turn] for turn in spec.turns])
    find = lambda start: descend(
        spec, lidar, few, points[thin], hit[thin], start, wheels_say, spec.far, spec.kernel[0]
    )
    poses, _, explained = jax.vmap(find)(starts)
    off = wrap_angle(poses[:, 2] - guess[2])
    best = jnp.argmax(explained - LIKELY * off**2 / unsure[1])
    pose, square, explained = descend(
        spec, lidar, local, points, hit, poses[best], wheels_say, spec.near, spec.kernel[1]
    )
    good = jnp.all(jnp.isfinite(pose)) & jnp.all(jnp.isfinite(square))
    pose, square = jnp.where(good, pose, guess), jnp.where(good, square, 0.0)
    pose = pose.at[2].set(wrap_angle(pose[2]))
    turn = jnp.eye(3).at[:2, :2].set(rotation(local.pose[2]))
    aligned = Aligned(between(local.pose, pose), turn.T @ square @ turn, explained)
    return _joined(spec, lidar, local, scan, pose), aligned


LIKELY = 0.005  # part explained that half a squared standard deviation of the turn outweighs


def _joined(spec: AlignSpec, lidar: Lidar, local: LocalMap, scan: Scan, pose: Array) -> LocalMap:
    """The local map after a scan at a pose."""
    size = spec.scans
    moved = between(local.poses[(local.held - 1) % size], pose)
    far = jnp.hypot(moved[0], moved[1]) > spec.apart[0]
    new = far | (jnp.abs(moved[2]) > spec.apart[1]) | (local.held == 0)
    slot = jnp.where(new, local.held % size, size)
    own = laid(surfaces(scan, lidar), pose)
    put = lambda old, x: old.at[slot].set(x, mode="drop")
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
    """Align scans [T] one after the other, and the motions [T] that they tell.

    Args:
        spec: How.
        lidar: The scanner.
        local: Of the scans before.
        scans: [T].
        wheels: (T, 3) motions since the scan before, by the wheels; zero at the first of all.
        count: () int32 scans that there are, the first ones; of the others nothing is kept.
    """
    known = jnp.arange(len(wheels), dtype=jnp.int32) < (len(wheels) if count is None else count)

    def body(local: LocalMap, now: tuple[Scan, Array, Array]) -> tuple[LocalMap, Aligned]:
        *given, there = now
        after, aligned = align(spec, lidar, local, *given)
        return jax.tree.map(partial(jnp.where, there), after, local), aligned

    return lax.scan(body, local, (scans, wheels, known))


FLOOR = (0.01, 0.005)  # [m], [rad] of wheels beside scans, even where they stand still


def fuse(wheels: Array, noise: Array, aligned: Aligned, scale: Array) -> tuple[Array, Array]:
    """Motion (3,) by wheels and scans together, and its covariance (3, 3).

    Args:
        wheels: (3,) motion.
        noise: (3, 3) its covariance; `FLOOR` is added where there is something to fuse it with.
        aligned: What the scans tell.
        scale: () factor on their standard deviation.
    """
    told = aligned.information / scale**2
    floor = jnp.array([FLOOR[0], FLOOR[0], FLOOR[1]]) ** 2
    root = inverse_root(noise + jnp.diag(floor))[0]
    both = inverse_root(root.T @ root + told)[0]
    cov = both.T @ both
    off = aligned.motion - wheels
    off = off.at[2].set(wrap_angle(off[2]))
    any_told = jnp.any(aligned.information != 0.0)
    motion = wheels + cov @ (told @ off)
    return jnp.where(any_told, motion, wheels), jnp.where(any_told, cov, noise)
