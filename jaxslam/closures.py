"""Loop closures: scans of a later visit to a place, laid on those of an earlier one.

A filter closes a loop where it meets a landmark again and knows it for the same. Where it did not,
a corridor that was driven twice is drawn twice, as far apart as the way had drifted by then. Here
both visits are taken from the smoothed way, so the later has a good guess of where it was: what is
found is believed only if most of the scan lies on walls, and no other guess does about as well.

References:
    Lu, Milios (1997), Globally consistent range scan alignment for environment mapping. Olson
    (2009), Recognizing places using spectrally clustered local matches: ambiguity of a match.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam import alignment, programs
from jaxslam.alignment import AlignSpec, LocalMap
from jaxslam.batches import pad
from jaxslam.lidar import Lidar, Scan, points
from jaxslam.poses import seen_from
from jaxslam.types import Array, expect


class ClosureSpec(NamedTuple):
    """Which scans are laid on which, and when that is believed; static under jit."""

    every: float = 2.0  # [m] of the way from one scan that is laid to the next
    away: float = 15.0  # [m] of the way between two visits, at least
    near: float = 2.0  # [m] between two poses, at most
    turned: float = 0.5  # [m] that a turn of a radian between two poses counts
    scans: int = 13  # K of the earlier visit
    apart: float = 0.6  # [m] of the way between these
    few: int = 2  # every so many of them are what a guess is made with
    aside: float = 0.7  # [m] of the first guesses, to all four sides
    unsure: tuple[float, float] = (1.0, 0.1)  # [m], [rad] of the guess
    explained: float = 0.8  # least part of the points that found a surface
    other: float = 0.3  # [m] from which another place counts as one
    margin: float = 0.05  # by which it must explain less
    floor: tuple[float, float] = (0.02, 0.004)  # [m], [rad] of the earlier visit's own poses
    tilt: float = 0.1  # [rad] of surfaces, by which a bare wall seems to say where along it one is


class Closures(NamedTuple):
    """Pairs of poses of one way that scans tie to each other; NumPy."""

    first: np.ndarray  # (C,) int index of the pose of the earlier visit
    second: np.ndarray  # (C,) int and of the later one
    motion: np.ndarray  # (C, 3) [m, m, rad] the second in the frame of the first
    information: np.ndarray  # (C, 3, 3) inverse covariance of that, in the same frame


BATCH = 8  # pairs that are laid at a time, by one program
LIKELY = 0.02  # part explained that a squared standard deviation from the guess outweighs
FAINT = 1e-4  # of what is known of the guess: it holds only what scans do not show at all


def find(
    spec: ClosureSpec,
    align: AlignSpec,
    lidar: Lidar,
    poses: np.ndarray,
    scans: Scan,
    *,
    scale: float = 1.0,
) -> Closures:
    """Closures of a way, as far as they are believed.

    Args:
        spec: Which are tried, and believed.
        align: How scans are aligned.
        lidar: The scanner.
        poses: (T, 3), off by a metre at most where it matters; if not finite, there are none.
        scans: [T].
        scale: Factor on the standard deviation that alignment tells.

    Raises:
        ValueError: Poses or ranges have another shape or type.
    """
    expect("poses", poses, ("T", 3), jnp.floating)
    expect("scans.ranges", scans.ranges, (len(poses), lidar.beams), jnp.floating)
    poses, scans = np.asarray(poses, np.float64), jax.tree.map(np.asarray, scans)
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    first, second = candidates(spec, poses, along)
    step = spec.apart * (np.arange(spec.scans) - spec.scans // 2)
    visit = np.searchsorted(along, along[first][:, None] + step[None]).clip(0, len(along) - 1)
    guess = seen_from(poses[first], poses[second])
    around = seen_from(poses[first][:, None], poses[visit])
    given = lambda k: (
        jax.tree.map(lambda x: x[visit[k]], scans),
        around[k],
        jax.tree.map(lambda x: x[second[k]], scans),
        guess[k],
    )
    real = lambda x: jnp.asarray(x, float if x.dtype.kind == "f" else None)
    parts = []
    for at in range(0, len(first), BATCH):
        some = pad(given(slice(at, at + BATCH)), to=BATCH)
        parts.append(_lay_all(spec, align, lidar, jax.tree.map(real, some)))
    if not parts:
        return Closures(first, second, guess, np.zeros((0, 3, 3)))
    found = (np.concatenate(x)[: len(first)].astype(float) for x in zip(*parts, strict=True))
    motion, information, explained, margin = found
    good = (explained >= spec.explained) & (margin >= spec.margin)
    floor = np.diag([spec.floor[0], spec.floor[0], spec.floor[1]]) ** 2
    told = information[good] / scale**2
    pretended = spec.tilt**2 * np.trace(told[:, :2, :2], axis1=1, axis2=2)
    size, axes = np.linalg.eigh(told - pretended[:, None, None] * np.diag([1.0, 1.0, 0.0]))
    told = (axes * np.maximum(size, 0.0)[:, None]) @ axes.swapaxes(1, 2)
    told = np.linalg.solve(np.eye(3) + told @ floor, told)  # with the floor added to its inverse
    return Closures(first[good], second[good], motion[good], (told + told.swapaxes(1, 2)) / 2)


def candidates(
    spec: ClosureSpec, poses: np.ndarray, along: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Indices (C,) of two visits: now and then a pose, and the nearest of those long before.

    Args:
        spec: Which count as near, and as long before.
        poses: (T, 3).
        along: (T,) [m] the way to each.
    """
    pairs = []
    if not np.isfinite(poses).all():
        along = along[:0]
    for k in np.unique(np.floor(along / spec.every), return_index=True)[1]:
        before = np.searchsorted(along, along[k] - spec.away)
        off = seen_from(poses[k], poses[:before])
        away = np.hypot(off[:, 0], off[:, 1])
        cost = np.where(away < spec.near, away + spec.turned * np.abs(off[:, 2]), np.inf)
        if np.min(cost, initial=np.inf) < np.inf:
            pairs.append((np.argmin(cost), k))
    first, second = np.array(pairs, int).reshape(-1, 2).T
    return first, second


def lay(
    spec: ClosureSpec,
    align: AlignSpec,
    lidar: Lidar,
    visit: Scan,
    around: Array,
    scan: Scan,
    guess: Array,
) -> tuple[Array, Array, Array, Array]:
    """A scan on those of an earlier visit, whose frame all poses are in.

    Args:
        spec: How the first guess is made.
        align: How scans are aligned.
        lidar: The scanner.
        visit: [K].
        around: (K, 3) their poses.
        scan: One scan of the later visit.
        guess: (3,) its pose.

    Returns:
        Pose (3,), its information (3, 3), the part explained, and by how much more than at any
        other place that was found.
    """
    surfaces = jax.vmap(partial(alignment.surfaces, lidar=lidar))(visit)
    surfaces = jax.vmap(alignment.laid)(surfaces, around)
    local = LocalMap(surfaces, around, jnp.int32(spec.scans), guess)
    few = jax.tree.map(lambda x: x[:: spec.few], (surfaces, around))
    few = local._replace(surfaces=few[0], poses=few[1])
    every = -(-lidar.beams // align.beams)
    own, hit = points(scan, lidar)[::every], scan.hit[::every]
    unsure = jnp.array([spec.unsure[0], spec.unsure[0], spec.unsure[1]])
    weak = jnp.diag(1.0 / unsure**2)
    aside = spec.aside * jnp.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    descend = partial(alignment.descend, align, lidar)
    thin = slice(None, None, align.thin)

    def first(start: Array) -> tuple[Array, Array, Array]:
        how = (guess, weak), align.far, align.kernel[0]
        return descend(few, own[thin], hit[thin], start, *how)

    places, _, explained = jax.vmap(first)(guess[None] + aside)
    off = jnp.sum(((places - guess[None]) / unsure[None])[:, :2] ** 2, axis=1)
    worth = explained - LIKELY * off
    best = jnp.argmax(worth)
    elsewhere = jnp.linalg.norm((places - places[best][None])[:, :2], axis=1) > spec.other
    margin = worth[best] - jnp.max(jnp.where(elsewhere, worth, -jnp.inf))
    # A wall has two sides, and this scan sees the one that it is on.
    side = lambda place: jnp.sum(surfaces.normal * (place - surfaces.points), axis=-1)
    own_side = side(around[:, None, :2]) * side(places[best][None, None, :2]) > 0.0
    local = local._replace(surfaces=surfaces._replace(valid=surfaces.valid & own_side))
    how = (guess, FAINT * weak), align.near, align.kernel[1]
    pose, information, explained = descend(local, own, hit, places[best], *how)
    good = jnp.all(jnp.isfinite(pose)) & jnp.all(jnp.isfinite(information))
    explained = jnp.where(good & jnp.isfinite(explained), explained, 0.0)
    return jnp.where(good, pose, guess), jnp.where(good, information, 0.0), explained, margin


@partial(programs.jit, static_argnames=("spec", "align", "lidar"))
def _lay_all(
    spec: ClosureSpec, align: AlignSpec, lidar: Lidar, given: tuple[Scan | Array, ...]
) -> tuple[Array, Array, Array, Array]:
    """`lay` of many, one after the other: each stays in the cache."""
    return lax.map(lambda one: lay(spec, align, lidar, *one), given)


def residuals(closures: Closures, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whitened residuals (C, 3) of poses (T, 3), their derivatives (C, 3, 3) by either pose."""
    one, other = poses[closures.first], poses[closures.second]
    told = seen_from(one, other)
    error = told - closures.motion
    error[:, 2] -= 2 * np.pi * np.round(error[:, 2] / (2 * np.pi))
    by_one, by_other = np.zeros((2, len(one), 3, 3))
    c, s = np.cos(one[:, 2]), np.sin(one[:, 2])
    by_other[:, :2, :2] = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    by_one[:, :2, :2] = -by_other[:, :2, :2]
    by_one[:, :2, 2] = np.stack([told[:, 1], -told[:, 0]], axis=-1)
    by_one[:, 2, 2], by_other[:, 2, 2] = -1.0, 1.0
    size, axes = np.linalg.eigh(closures.information)
    root = np.sqrt(np.maximum(size, 0.0))[..., None] * axes.swapaxes(1, 2)
    return (root @ error[..., None])[..., 0], root @ by_one, root @ by_other
