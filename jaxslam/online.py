"""A drive mapped as its scans come in: odometry from scans, filter, topological map.

Scans are taken `STRETCH` at a time by programs that know neither the length of the drive nor, up
to a step, the number of its landmarks: what is compiled for one log serves all by that scanner.
Where the robot is, and the map, are there after each stretch.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam import alignment, association, closures, programs, slam, smoother, sparse, topomap
from jaxslam.alignment import Aligned, LocalMap
from jaxslam.batches import pad
from jaxslam.belief import Belief, grown
from jaxslam.closures import Closures
from jaxslam.covariance import make_room, postpone, settle
from jaxslam.lidar import Scan
from jaxslam.links import Links
from jaxslam.nodes import Nodes
from jaxslam.noise import Noise
from jaxslam.slam import Config, Info, Inputs
from jaxslam.topomap import Arcs, Graph
from jaxslam.types import Array

STRETCH = 64  # scans
ROOM = 384  # slots by which the map of the filter grows
SPARE = 128  # free ones at the beginning of a stretch, at least
ROUNDS = 2  # of finding closures at most, each from the way that the one before left,
STILL = 0.3  # [m] if it left any pose this far from where it was
LIKE = 512  # scans, or landmarks: runs are smoothed as if they had a multiple of them
MOST = 2048  # slots, unless told otherwise: what a building of some kilometres of corridor has


class Mapper(NamedTuple):
    """All that is known after some scans, and all that the next ones need."""

    belief: Belief
    arcs: Arcs
    local: LocalMap | None  # of aligned scans; None where odometry is that of the wheels


class Part(NamedTuple):
    """What some scans in a row gave; NumPy arrays that lead with their number."""

    info: Info
    nodes: Nodes
    aligned: Aligned | None  # motions by scans, where they are aligned


class Survey(NamedTuple):
    """A drive, mapped, with its topological map."""

    poses: np.ndarray  # (T, 3) float64, world frame, as they are known at the end
    belief: Belief  # at the end; if smoothed, its places are, with the filter's covariance
    info: Info  # [T] of the filter: what was known by then
    nodes: Nodes  # [T]
    graph: Graph
    aligned: Aligned | None = None  # [T] motions by scans, where they were aligned
    closures: Closures | None = None  # that it was smoothed with, where they were


class _Seen(NamedTuple):
    """A stretch of scans, looked at, filled up with its last scan."""

    count: Array  # () int32 scans that there are
    scans: Scan  # [STRETCH]
    inputs: Inputs  # [STRETCH]
    links: Links  # [STRETCH]
    local: LocalMap | None  # after them


@partial(programs.jit, static_argnames=("config", "aligned"))
def begin(config: Config, start: Array, *, aligned: bool) -> Mapper:
    """A robot at a pose (3,) with an empty map.

    Args:
        config: Of the filter; `landmarks` is how many the map may come to hold.
        start: First pose, world frame.
        aligned: Whether scans are to be aligned and fused with the wheels.
    """
    room = min(ROOM, config.landmarks)
    return Mapper(
        slam.init(config._replace(landmarks=room), start),
        topomap.empty(arcs=2 * room),
        alignment.empty(config.alignment, config.lidar) if aligned else None,
    )


def extend(
    config: Config, noise: Noise, mapper: Mapper, motions: Array, scans: Scan
) -> tuple[Mapper, Part]:
    """Map the next scans.

    Args:
        config: As it began.
        noise: What the filter assumes.
        mapper: After the scans before.
        motions: (N, 3) odometry since the scan before, N at most `STRETCH`.
        scans: [N].

    Raises:
        ValueError: There is no scan, or there are too many.
    """
    return _learn(config, noise, mapper, _look(config, mapper.local, motions, scans))


def survey(
    config: Config,
    noise: Noise,
    start: Array,
    motions: Array,
    scans: Scan,
    *,
    aligned: bool = False,
    smooth: bool = False,
    watch: Callable[[Mapper, Part], Any] | None = None,
) -> Survey:
    """Map a whole drive.

    The filter tells each pose by what was seen up to it. If it is to be smoothed, all poses and
    places are told by all that was seen (`sparse.smooth`), and where scans are aligned, those of
    later visits to a place are laid on those of earlier ones (`closures.find`).

    Args:
        config: Of front end and filter; `landmarks` is how many the map may come to hold.
        noise: What the filter assumes.
        start: (3,) first pose.
        motions: (T, 3) odometry since the scan before, zero at the first.
        scans: [T].
        aligned: Whether scans are to be aligned and fused with the wheels.
        smooth: Whether the drive is to be smoothed at the end.
        watch: Called after each stretch with what is known by then, and what the stretch gave.
    """
    # Slices of JAX's own arrays would each be compiled.
    motions, scans = np.asarray(motions), jax.tree.map(np.asarray, scans)
    mapper, parts = begin(config, start, aligned=aligned), []

    def look(first: int, local: LocalMap | None) -> _Seen:
        some = slice(first, first + STRETCH)
        return _look(config, local, motions[some], jax.tree.map(lambda x: x[some], scans))

    # The next stretch is looked at while the filter works on the last.
    seen = look(0, mapper.local)
    for first in range(0, len(motions), STRETCH):
        now, after = seen, first + STRETCH
        seen = look(after, now.local) if after < len(motions) else None
        mapper, part = _learn(config, noise, mapper, now)
        parts.append(part)
        if watch is not None:
            watch(mapper, part)
    whole = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    info, poses, found = whole.info, np.asarray(whole.info.pose, np.float64), None
    if smooth:
        inputs = Inputs(motions.astype(info.pose.dtype), whole.nodes, aligned=whole.aligned)
        given = inputs, info, mapper.belief, scans if aligned else None
        poses, belief, found = smoothed(config, noise, start, *given)
        mapper = mapper._replace(belief=belief)
    told = graph(config, mapper, poses)
    return Survey(poses, mapper.belief, info, whole.nodes, told, whole.aligned, found)


_records = programs.jit(smoother.records, static_argnames="doubt")


def smoothed(
    config: Config,
    noise: Noise,
    start: Array,
    inputs: Inputs,
    info: Info,
    belief: Belief,
    scans: Scan | None = None,
) -> tuple[np.ndarray, Belief, Closures | None]:
    """A filtered drive by all that was seen on it.

    Args:
        config: Of the filter.
        noise: What it assumed.
        start: (3,) its first pose.
        inputs: [T] it was given, NumPy.
        info: [T] what it found, NumPy.
        belief: At the end.
        scans: [T] to close loops with, NumPy; None to close none but the filter's.

    Returns:
        Poses (T, 3) float64, the belief with the last of them and the places that go with them,
        whose covariances are still the filter's, and what loops were closed.

    Raises:
        ValueError: There are scans, and `noise.alignment` is None.
    """
    if scans is not None and noise.alignment is None:
        raise ValueError("noise.alignment is None, and there are scans to close loops with")
    steps, room = len(info.pose), lambda count: (count // LIKE + 1) * LIKE
    found = association.landmarks(
        info.id, info.pose, inputs.nodes, size=room(np.count_nonzero(np.unique(info.id) >= 0))
    )
    # The rest stands still and sees nothing.
    inputs, which, guess = pad((inputs, np.asarray(found.which), info.pose), to=room(steps))
    which[steps:] = -1
    for motion in jax.tree.leaves((inputs.motion, inputs.aligned and inputs.aligned.motion)):
        motion[steps:] = 0.0
    records = _records(noise, start, inputs, which, doubt=config.doubt)
    track, closed = sparse.smooth(records, guess, found.places), None
    for _ in range(0 if scans is None else ROUNDS):
        how = config.closures, config.alignment, config.lidar, track.poses[:steps], scans
        closed, before = closures.find(*how, scale=float(noise.alignment)), track.poses
        track = sparse.smooth(records, before, track.places, closures=closed)
        if np.max(np.abs(track.poses - before)[:, :2]) < STILL:
            break
    # The names are in order, and no landmark has the name that fills up the end.
    names = np.asarray(found.id)
    names = np.where(names < 0, np.iinfo(names.dtype).max, names)
    at = np.searchsorted(names, belief.id)
    same = (np.asarray(belief.seen) > 0) & (names[at] == np.asarray(belief.id))
    places = np.where(same[:, None], track.places[at], belief.places)
    poses = track.poses[:steps]
    mean = np.concatenate([poses[-1], places.ravel()])
    return poses, belief._replace(mean=jnp.asarray(mean, belief.mean.dtype)), closed


def graph(config: Config, mapper: Mapper, poses: np.ndarray) -> Graph:
    """The topological map as it stands, of a robot that was at poses (T, 3)."""
    return topomap.graph(
        mapper.belief,
        mapper.arcs,
        np.asarray(poses),
        confirm=config.confirm,
        apart=config.matching.apart,
        alike=config.matching.shape,
    )


def align(config: Config, scans: Scan, motions: Array) -> Aligned:
    """Motions [T] by scans [T] alone, NumPy, beginning at those of the wheels (T, 3)."""
    motions, scans = np.asarray(motions), jax.tree.map(np.asarray, scans)
    local, parts = alignment.empty(config.alignment, config.lidar), []
    for first in range(0, len(motions), STRETCH):
        some = jax.tree.map(lambda x: x[first : first + STRETCH], (scans, motions))  # noqa: B023
        local, part = alignment.follow(config.alignment, config.lidar, local, *_filled(*some))
        parts.append(part)
    return jax.tree.map(lambda *x: np.concatenate(x)[: len(motions)], *parts)


def _filled(scans: Scan, motions: np.ndarray) -> tuple[Scan, Array, Array]:
    """Scans and motions of a stretch, filled up, in JAX's precision, and how many () there are."""
    real = lambda x: jnp.asarray(x, float if x.dtype.kind == "f" else None)
    return *jax.tree.map(real, pad((scans, motions), to=STRETCH)), jnp.int32(len(motions))


def _look(config: Config, local: LocalMap | None, motions: np.ndarray, scans: Scan) -> _Seen:
    """Features, links and, with a local map of scans, aligned motions of a stretch."""
    if not 1 <= len(motions) <= STRETCH:
        raise ValueError(f"{len(motions)} scans; a stretch has 1 to {STRETCH}")
    scans, motions, count = _filled(scans, motions)
    aligned = None
    with ThreadPoolExecutor(1) as other:  # neither waits for the other, to be compiled or to run
        features = other.submit(slam.local_maps, config, scans)
        if local is not None:
            how = config.alignment, config.lidar
            local, aligned = alignment.follow(*how, local, scans, motions, count)
        nodes, links = features.result()
    return _Seen(count, scans, Inputs(motions, nodes, aligned=aligned), links, local)


def _learn(config: Config, noise: Noise, mapper: Mapper, seen: _Seen) -> tuple[Mapper, Part]:
    """Filter a stretch, and add its links to the map."""
    belief, arcs = _grown(config, mapper.belief, mapper.arcs)
    room = config._replace(landmarks=belief.seen.size)
    (belief, arcs), info = _steps(room, noise, (belief, arcs), seen._replace(local=None))
    part = Part(info, seen.inputs.nodes, seen.inputs.aligned)
    part = jax.tree.map(lambda x: np.asarray(x)[: seen.count], part)
    return Mapper(belief, arcs, seen.local), part


def _grown(config: Config, belief: Belief, arcs: Arcs) -> tuple[Belief, Arcs]:
    """Room for the landmarks of a stretch, and for two arcs of each that there is room for."""
    size = belief.seen.size
    to = min(size + ROOM, config.landmarks)
    if size == to or np.count_nonzero(belief.seen) <= size - SPARE:
        return belief, arcs
    return grown(belief, to), topomap.grown(arcs, 2 * to)


@partial(jax.jit, static_argnames="config")
def _step(
    config: Config, noise: Noise, now: tuple[Belief, Arcs], inputs: Inputs, links: Links, scan: Scan
) -> tuple[tuple[Belief, Arcs], Info]:
    """Filter one scan, and add its links."""
    cov = make_room(now[0].map_cov, 2 * config.matches + 2)  # and the two of a merge
    belief, info = slam.step(config, noise, now[0]._replace(map_cov=cov), inputs)
    arcs = topomap.add(now[1], info.id, info.pose, links, scan, config.lidar)
    return (belief, arcs), info


@partial(programs.jit, static_argnames="config")
def _steps(
    config: Config, noise: Noise, now: tuple[Belief, Arcs], seen: _Seen
) -> tuple[tuple[Belief, Arcs], Info]:
    """Filter the scans that there are; the info of the rest of the stretch is blank."""
    given = seen.inputs, seen.links, seen.scans
    at = lambda k: jax.tree.map(lambda x: x[k], given)

    def body(k: Array, all: tuple[tuple[Belief, Arcs], Info]) -> tuple[tuple[Belief, Arcs], Info]:
        now, info = _step(config, noise, all[0], *at(k))
        return now, jax.tree.map(lambda old, new: old.at[k].set(new), all[1], info)

    # Jitted, and closing over nothing, a step is traced once for its shapes and for the loop.
    shapes = jax.eval_shape(_step, config, noise, now, *at(0))[1]
    blank = jax.tree.map(lambda x: jnp.zeros((STRETCH, *x.shape), x.dtype), shapes)
    if config.linearisation != "invariant":  # which swings the whole map at each update
        now = now[0]._replace(map_cov=postpone(now[0].map_cov)), now[1]
    (belief, arcs), info = lax.fori_loop(0, seen.count, body, (now, blank))
    return (belief._replace(map_cov=settle(belief.map_cov)), arcs), info
