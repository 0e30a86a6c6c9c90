"""SLAM on a log as its scans come in: scan matching, filter, topological map.

Scans are processed in chunks of `STRETCH` by programs of fixed shape, which depend neither on the
length of the log nor, up to steps of `ROOM` slots, on the number of landmarks: what is compiled for
one log serves all logs of that scanner. Pose and map are available after each chunk.

Each chunk passes two stages. The front end (features, arcs, scan matching) needs the chunk's scans
and the last local map of the scan matcher, but not the filter; so the front end of chunk k + 1 is
started before the filter of chunk k, and the two overlap:

    time --->
    front end    | features 0 | features 1 | features 2 |
                 | matching 0 | matching 1 | matching 2 |
    filter                    | filter 0   | filter 1   | filter 2 |
    callback                               ^ 0          ^ 1        ^ 2

Features and matching of a chunk do not depend on each other: one is started by a worker thread, the
other by the main thread, so that neither waits for the other to be compiled or to run. JAX
dispatches asynchronously; the main thread waits only for the results of the filter.
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

STRETCH = 64  # scans of a chunk
ROOM = 384  # slots by which the capacity of the filter's map grows
SPARE = 128  # free slots at the beginning of a chunk, at least
ROUNDS = 2  # searches for loop closures at most, each from the trajectory smoothed before it;
STILL = 0.3  # [m] the search ends when no pose has moved further than this
LIKE = 512  # numbers of scans and landmarks are padded to multiples of this to be smoothed
MOST = 2048  # default capacity for landmarks: a building with some kilometres of corridors


class Mapper(NamedTuple):
    """State of incremental SLAM: the estimate after some scans, and what the next ones need.

    Attributes:
        belief: Of the filter.
        arcs: Of the topological map.
        local: Local map of the scan matcher; None where scans are not matched.
    """

    belief: Belief
    arcs: Arcs
    local: LocalMap | None


class Part(NamedTuple):
    """Result of a chunk of N scans; NumPy arrays that lead with N.

    Attributes:
        info: Diagnostics of the filter.
        nodes: Features.
        aligned: Motions by scan matching; None where scans are not matched.
    """

    info: Info
    nodes: Nodes
    aligned: Aligned | None


class Survey(NamedTuple):
    """Result of SLAM on a log of T scans.

    Attributes:
        poses: (T, 3) float64 [m, m, rad] estimated trajectory, map frame: filtered, or smoothed.
        belief: Of the filter after the last scan; if smoothed, with the smoothed last pose and
            landmark positions, and still the covariance of the filter.
        info: [T] diagnostics of the filter, with its estimates at the time.
        nodes: [T] features.
        graph: Topological map.
        aligned: [T] motions by scan matching, where scans were matched.
        closures: Loop closures that the trajectory was smoothed with, where there were any.
    """

    poses: np.ndarray
    belief: Belief
    info: Info
    nodes: Nodes
    graph: Graph
    aligned: Aligned | None = None
    closures: Closures | None = None


class _Chunk(NamedTuple):
    """Output of the front end for a chunk of scans, padded with its last scan.

    Attributes:
        count: () int32 number of scans without the padding.
        scans: [STRETCH].
        inputs: [STRETCH] measurements for the filter.
        links: [STRETCH] arcs of each scan.
        local: Local map of the scan matcher after the chunk; None where scans are not matched.
    """

    count: Array
    scans: Scan
    inputs: Inputs
    links: Links
    local: LocalMap | None


class _State(NamedTuple):
    """What the filter stage carries from scan to scan."""

    belief: Belief
    arcs: Arcs


@partial(programs.jit, static_argnames=("config", "aligned"))
def begin(config: Config, start: Array, *, aligned: bool) -> Mapper:
    """State before the first scan: a known pose and an empty map.

    Args:
        config: Of the filter; `landmarks` is the largest number of landmarks of the map.
        start: (3,) [m, m, rad] first pose, map frame.
        aligned: Whether scans are to be matched, and the motions fused with the odometry.
    """
    capacity = min(ROOM, config.landmarks)
    return Mapper(
        slam.init(config._replace(landmarks=capacity), start),
        topomap.empty(arcs=2 * capacity),
        alignment.empty(config.alignment, config.lidar) if aligned else None,
    )


def extend(
    config: Config, noise: Noise, mapper: Mapper, motions: Array, scans: Scan
) -> tuple[Mapper, Part]:
    """Update the state by the next scans.

    Args:
        config: The same as at the beginning.
        noise: Noise parameters of the filter.
        mapper: State after the scans before.
        motions: (N, 3) [m, m, rad] odometry since the scan before, N at most `STRETCH`.
        scans: [N].

    Raises:
        ValueError: There is no scan, or there are too many.
    """
    return _filter(config, noise, mapper, _front_end(config, mapper.local, motions, scans))


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
    """Run SLAM on a whole log.

    The filter estimates each pose from the measurements up to it. With `smooth`, all poses and
    landmarks are estimated from all measurements (`sparse.smooth`), and where scans are matched,
    loops are closed by matching scans of later visits with those of earlier ones (`closures.find`).

    Args:
        config: Of front end and filter; `landmarks` is the largest number of landmarks of the map.
        noise: Noise parameters of the filter.
        start: (3,) [m, m, rad] first pose, map frame.
        motions: (T, 3) [m, m, rad] odometry since the scan before, zero at the first.
        scans: [T].
        aligned: Whether scans are to be matched, and the motions fused with the odometry.
        smooth: Whether the trajectory is to be smoothed at the end.
        watch: Callback, called after each chunk with the state and the result of the chunk.

    Raises:
        ValueError: There is no scan; or scans are to be matched and `noise.alignment` is None.
    """
    # NumPy, as each slice of a JAX array would be compiled.
    motions, scans = np.asarray(motions), jax.tree.map(np.asarray, scans)
    mapper, parts = begin(config, start, aligned=aligned), []
    following = _front_end(config, mapper.local, *_chunk_at(0, motions, scans))
    for first in range(0, len(motions), STRETCH):
        chunk, after = following, first + STRETCH
        if after < len(motions):  # in the background while the filter works on this chunk
            following = _front_end(config, chunk.local, *_chunk_at(after, motions, scans))
        mapper, part = _filter(config, noise, mapper, chunk)
        parts.append(part)
        if watch is not None:
            watch(mapper, part)
    info, features, matched = jax.tree.map(lambda *chunks: np.concatenate(chunks), *parts)
    poses, found = np.asarray(info.pose, np.float64), None
    if smooth:
        inputs = Inputs(motions.astype(info.pose.dtype), features, aligned=matched)
        to_close = scans if aligned else None
        poses, belief, found = smoothed(config, noise, start, inputs, info, mapper.belief, to_close)
        mapper = mapper._replace(belief=belief)
    topological_map = graph(config, mapper, poses)
    return Survey(poses, mapper.belief, info, features, topological_map, matched, found)


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
    """Smooth a filtered trajectory by all its measurements.

        smooth with the filter's data association
        up to ROUNDS times:
            find loop closures from the smoothed trajectory, smooth again with them
            stop if no pose has moved by STILL or more

    Args:
        config: Of the filter.
        noise: Noise parameters of the filter.
        start: (3,) [m, m, rad] first pose, map frame.
        inputs: [T] measurements of the filter, NumPy.
        info: [T] its diagnostics, NumPy.
        belief: After the last scan.
        scans: [T] to find loop closures with, NumPy; None for none but the filter's own.

    Returns:
        Poses (T, 3) float64; the belief with the smoothed last pose and landmark positions, and the
        covariance of the filter; and the loop closures, None without scans.

    Raises:
        ValueError: There are scans, and `noise.alignment` is None.
    """
    if scans is not None and noise.alignment is None:
        raise ValueError("noise.alignment is None, and there are scans to close loops with")
    steps = len(info.pose)
    capacity = _padded(np.count_nonzero(np.unique(info.id) >= 0))
    found = association.landmarks(info.id, info.pose, inputs.nodes, size=capacity)
    records, guess = _padded_records(config, noise, start, inputs, found.which, info.pose)
    track, closed = sparse.smooth(records, guess, found.places), None
    for _ in range(0 if scans is None else ROUNDS):
        before = track.poses
        closed = closures.find(
            config.closures,
            config.alignment,
            config.lidar,
            before[:steps],
            scans,
            scale=float(noise.alignment),
        )
        track = sparse.smooth(records, before, track.places, closures=closed)
        if np.max(np.abs(track.poses - before)[:, :2]) < STILL:
            break
    poses = track.poses[:steps]
    positions = _positions_of(belief, np.asarray(found.id), track.places)
    mean = np.concatenate([poses[-1], positions.ravel()])
    return poses, belief._replace(mean=jnp.asarray(mean, belief.mean.dtype)), closed


def _padded(count: int) -> int:
    """The next larger multiple of `LIKE`."""
    return (count // LIKE + 1) * LIKE


def _padded_records(
    config: Config, noise: Noise, start: Array, inputs: Inputs, which: Array, guess: np.ndarray
) -> tuple[smoother.Records, np.ndarray]:
    """Smoothing problem and guess (P, 3), padded by steps without motion and measurements.

    Args:
        config: Of the filter.
        noise: Noise parameters of the filter.
        start: (3,) first pose.
        inputs: [T].
        which: (T, M) landmark of each feature.
        guess: (T, 3) poses.
    """
    steps = len(guess)
    inputs, which, guess = pad((inputs, np.asarray(which), guess), to=_padded(steps))
    which[steps:] = -1
    inputs.motion[steps:] = 0.0
    if inputs.aligned is not None:
        inputs.aligned.motion[steps:] = 0.0
    return _records(noise, start, inputs, which, doubt=config.doubt), guess


def _positions_of(belief: Belief, ids: np.ndarray, smoothed_positions: np.ndarray) -> np.ndarray:
    """Positions (L, 2) of the slots of a belief: smoothed where the landmark was, else as they are.

    Args:
        belief: The belief.
        ids: (S,) ids of the smoothed landmarks, ascending; then at least one -1, the padding.
        smoothed_positions: (S, 2).
    """
    ids = np.where(ids < 0, np.iinfo(ids.dtype).max, ids)  # sorts last, and is no landmark's id
    index = np.searchsorted(ids, belief.id)
    is_smoothed = (np.asarray(belief.seen) > 0) & (ids[index] == np.asarray(belief.id))
    return np.where(is_smoothed[:, None], smoothed_positions[index], belief.places)


def graph(config: Config, mapper: Mapper, poses: np.ndarray) -> Graph:
    """Topological map of a state.

    Args:
        config: Of the filter.
        mapper: The state.
        poses: (T, 3) [m, m, rad] trajectory up to it, map frame.
    """
    return topomap.graph(
        mapper.belief,
        mapper.arcs,
        np.asarray(poses),
        confirm=config.confirm,
        apart=config.matching.apart,
        alike=config.matching.shape,
    )


def align(config: Config, scans: Scan, motions: Array) -> Aligned:
    """Motions [T] by scan matching alone, NumPy.

    Args:
        config: Of the scan matcher.
        scans: [T].
        motions: (T, 3) [m, m, rad] odometry since the scan before, the first guess.
    """
    motions, scans = np.asarray(motions), jax.tree.map(np.asarray, scans)
    local, parts = alignment.empty(config.alignment, config.lidar), []
    for first in range(0, len(motions), STRETCH):
        padded_scans, odometry, count = _padded_chunk(*_chunk_at(first, motions, scans))
        local, part = alignment.follow(
            config.alignment, config.lidar, local, padded_scans, odometry, count
        )
        parts.append(part)
    return jax.tree.map(lambda *chunks: np.concatenate(chunks)[: len(motions)], *parts)


def _chunk_at(first: int, motions: np.ndarray, scans: Scan) -> tuple[np.ndarray, Scan]:
    """Odometry and scans of the chunk that begins at an index."""
    return jax.tree.map(lambda x: x[first : first + STRETCH], (motions, scans))


def _padded_chunk(motions: np.ndarray, scans: Scan) -> tuple[Scan, Array, Array]:
    """Scans and odometry of a chunk, padded, in JAX's precision, and its length () int32."""

    def as_jax(array: np.ndarray) -> Array:
        return jnp.asarray(array, float if array.dtype.kind == "f" else None)

    padded_scans, odometry = jax.tree.map(as_jax, pad((scans, motions), to=STRETCH))
    return padded_scans, odometry, jnp.int32(len(motions))


def _front_end(config: Config, local: LocalMap | None, motions: np.ndarray, scans: Scan) -> _Chunk:
    """Features, arcs and, with a local map of the scan matcher, matched motions of a chunk."""
    if not 1 <= len(motions) <= STRETCH:
        raise ValueError(f"{len(motions)} scans; a stretch has 1 to {STRETCH}")
    scans, odometry, count = _padded_chunk(motions, scans)
    aligned = None
    with ThreadPoolExecutor(1) as worker:  # beside the matching, see the module's diagram
        features_and_links = worker.submit(slam.local_maps, config, scans)
        if local is not None:
            local, aligned = alignment.follow(
                config.alignment, config.lidar, local, scans, odometry, count
            )
        features, links = features_and_links.result()
    return _Chunk(count, scans, Inputs(odometry, features, aligned=aligned), links, local)


def _filter(config: Config, noise: Noise, mapper: Mapper, chunk: _Chunk) -> tuple[Mapper, Part]:
    """Filter a chunk and merge its arcs into the map; waits for the results."""
    state = _with_capacity(config, _State(mapper.belief, mapper.arcs))
    sized = config._replace(landmarks=state.belief.seen.size)
    state, info = _steps(sized, noise, state, chunk._replace(local=None))
    part = Part(info, chunk.inputs.nodes, chunk.inputs.aligned)
    part = jax.tree.map(lambda x: np.asarray(x)[: chunk.count], part)
    return Mapper(state.belief, state.arcs, chunk.local), part


def _with_capacity(config: Config, state: _State) -> _State:
    """The map with `SPARE` free slots or more, up to `config.landmarks`; two arcs a landmark."""
    belief, arcs = state
    size = belief.seen.size
    larger = min(size + ROOM, config.landmarks)
    if size == larger or np.count_nonzero(belief.seen) <= size - SPARE:
        return state
    return _State(grown(belief, larger), topomap.grown(arcs, 2 * larger))


@partial(jax.jit, static_argnames="config")
def _step(
    config: Config, noise: Noise, state: _State, inputs: Inputs, links: Links, scan: Scan
) -> tuple[_State, Info]:
    """Filter one scan, and merge its arcs into the map."""
    cov = make_room(state.belief.map_cov, 2 * config.matches + 2)  # and two rows of a merge
    belief, info = slam.step(config, noise, state.belief._replace(map_cov=cov), inputs)
    arcs = topomap.add(state.arcs, info.id, info.pose, links, scan, config.lidar)
    return _State(belief, arcs), info


@partial(programs.jit, static_argnames="config")
def _steps(config: Config, noise: Noise, state: _State, chunk: _Chunk) -> tuple[_State, Info]:
    """Filter the scans of a chunk one after the other; the info of its padding is zero.

    Downdates of the map's covariance are deferred within a chunk, except for the right-invariant
    filter, whose updates move the whole map.
    """
    per_scan = chunk.inputs, chunk.links, chunk.scans

    def scan_at(k: Array | int) -> tuple[Inputs, Links, Scan]:
        return jax.tree.map(lambda x: x[k], per_scan)

    def body(k: Array, carry: tuple[_State, Info]) -> tuple[_State, Info]:
        state, infos = carry
        state, info = _step(config, noise, state, *scan_at(k))
        return state, jax.tree.map(lambda old, new: old.at[k].set(new), infos, info)

    # As `_step` is jitted and closes over nothing, it is traced once, for its shapes and the loop.
    shapes = jax.eval_shape(_step, config, noise, state, *scan_at(0))[1]
    blank = jax.tree.map(lambda x: jnp.zeros((STRETCH, *x.shape), x.dtype), shapes)
    belief = state.belief
    if config.linearisation != "invariant":
        belief = belief._replace(map_cov=postpone(belief.map_cov))
    carry = state._replace(belief=belief), blank
    (belief, arcs), info = lax.fori_loop(0, chunk.count, body, carry)
    return _State(belief._replace(map_cov=settle(belief.map_cov)), arcs), info
