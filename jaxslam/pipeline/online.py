"""SLAM on a log as its scans come in: scan matching, filter, topological map.

Scans are processed in chunks of `CHUNK` by programs of fixed shape, which depend neither on the
length of the log nor, up to steps of `SLOT_BLOCK` slots, on the number of landmarks: what is compiled for
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

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core import trace_cache
from jaxslam.core.batching import pad_to
from jaxslam.core.features import Features
from jaxslam.core.maps import TopologicalMap
from jaxslam.core.measurement import Measurement, ScanMatch
from jaxslam.core.scan import Scan
from jaxslam.core.types import Array
from jaxslam.filtering import config as config_module
from jaxslam.filtering import slam_filter
from jaxslam.filtering.belief import Belief, grow_belief
from jaxslam.filtering.covariance import defer, flush, flush_if_full
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.frontend import extract
from jaxslam.frontend.local_graph import LocalArcs
from jaxslam.mapping import arc_table
from jaxslam.mapping.arc_table import ArcTable
from jaxslam.mapping.topological_map import build_map
from jaxslam.matching import scan_matching
from jaxslam.matching.icp import Submap
from jaxslam.pipeline.config import Config

CHUNK = 64  # scans of a chunk
SLOT_BLOCK = 384  # slots by which the capacity of the filter's map grows
MIN_FREE_SLOTS = 128  # free slots at the beginning of a chunk, at least


class SlamState(NamedTuple):
    """State of incremental SLAM: the estimate after some scans, and what the next ones need.

    Attributes:
        belief: Of the filter.
        arcs: Of the topological map.
        submap: Local map of the scan matcher; None where scans are not matched.
    """

    belief: Belief
    arcs: ArcTable
    submap: Submap | None


class ChunkResult(NamedTuple):
    """Result of a chunk of N scans; NumPy arrays that lead with N.

    Attributes:
        info: Diagnostics of the filter.
        features: Features.
        scan_matches: Motions by scan matching; None where scans are not matched.
    """

    info: StepInfo
    features: Features
    scan_matches: ScanMatch | None


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
    inputs: Measurement
    links: LocalArcs
    local: Submap | None


class _State(NamedTuple):
    """What the filter stage carries from scan to scan."""

    belief: Belief
    arcs: ArcTable


@partial(trace_cache.jit, static_argnames=("config", "match_scans"))
def init(config: Config, pose: Array, *, match_scans: bool) -> SlamState:
    """State before the first scan: a known pose and an empty map.

    Args:
        config: Of the filter; `landmarks` is the largest number of landmarks of the map.
        pose: (3,) [m, m, rad] first pose, map frame.
        match_scans: Whether scans are to be matched, and the motions fused with the odometry.
    """
    capacity = min(SLOT_BLOCK, config.filter.max_landmarks)
    return SlamState(
        config_module.init(
            config._replace(
                filter=config.filter._replace(
                    max_landmarks=capacity,
                ),
            ).filter,
            pose,
        ),
        arc_table.empty_arcs(capacity=2 * capacity),
        scan_matching.empty_submap(config.scan_matching, config.frontend.lidar)
        if match_scans
        else None,
    )


def update(
    config: Config, params: NoiseParams, state: SlamState, odometry: Array, scans: Scan
) -> tuple[SlamState, ChunkResult]:
    """Update the state by the next scans.

    Args:
        config: The same as at the beginning.
        params: Noise parameters of the filter.
        state: State after the scans before.
        odometry: (N, 3) [m, m, rad] odometry since the scan before, N at most `CHUNK`.
        scans: [N].

    Raises:
        ValueError: There is no scan, or there are too many.
    """
    return _filter(config, params, state, _front_end(config, state.submap, odometry, scans))


def topological_map(config: Config, state: SlamState, poses: np.ndarray) -> TopologicalMap:
    """Topological map of a state.

    Args:
        config: Of the filter.
        state: The state.
        poses: (T, 3) [m, m, rad] trajectory up to it, map frame.
    """
    return build_map(
        state.belief,
        state.arcs,
        np.asarray(poses),
        confirm_count=config.filter.confirm_count,
        min_separation=config.filter.association.min_separation,
        max_log_clearance_ratio=config.filter.association.max_log_clearance_ratio,
    )


def match_log(config: Config, scans: Scan, increments: Array) -> ScanMatch:
    """Motions [T] by scan matching alone, NumPy.

    Args:
        config: Of the scan matcher.
        scans: [T].
        increments: (T, 3) [m, m, rad] odometry since the scan before, the first guess.
    """
    increments, scans = np.asarray(increments), jax.tree.map(np.asarray, scans)
    local, parts = scan_matching.empty_submap(config.scan_matching, config.frontend.lidar), []
    for first in range(0, len(increments), CHUNK):
        padded_scans, odometry, count = _padded_chunk(*_chunk_at(first, increments, scans))
        local, part = scan_matching.match_scans(
            config.scan_matching, config.frontend.lidar, local, padded_scans, odometry, count
        )
        parts.append(part)
    return jax.tree.map(lambda *chunks: np.concatenate(chunks)[: len(increments)], *parts)


def _chunk_at(first: int, motions: np.ndarray, scans: Scan) -> tuple[np.ndarray, Scan]:
    """Odometry and scans of the chunk that begins at an index."""
    return jax.tree.map(lambda x: x[first : first + CHUNK], (motions, scans))


def _padded_chunk(motions: np.ndarray, scans: Scan) -> tuple[Scan, Array, Array]:
    """Scans and odometry of a chunk, padded, in JAX's precision, and its length () int32."""

    def as_jax(array: np.ndarray) -> Array:
        return jnp.asarray(array, float if array.dtype.kind == "f" else None)

    padded_scans, odometry = jax.tree.map(as_jax, pad_to((scans, motions), to=CHUNK))
    return padded_scans, odometry, jnp.int32(len(motions))


def _front_end(config: Config, local: Submap | None, motions: np.ndarray, scans: Scan) -> _Chunk:
    """Features, arcs and, with a local map of the scan matcher, matched motions of a chunk."""
    if not 1 <= len(motions) <= CHUNK:
        raise ValueError(f"{len(motions)} scans; a stretch has 1 to {CHUNK}")
    scans, odometry, count = _padded_chunk(motions, scans)
    aligned = None
    with ThreadPoolExecutor(1) as worker:  # beside the matching, see the module's diagram
        features_and_links = worker.submit(extract.extract_local_graphs, config, scans)
        if local is not None:
            local, aligned = scan_matching.match_scans(
                config.scan_matching, config.frontend.lidar, local, scans, odometry, count
            )
        features, links = features_and_links.result()
    return _Chunk(count, scans, Measurement(odometry, features, scan_match=aligned), links, local)


def _filter(
    config: Config, noise: NoiseParams, mapper: SlamState, chunk: _Chunk
) -> tuple[SlamState, ChunkResult]:
    """Filter a chunk and merge its arcs into the map; waits for the results."""
    state = _with_capacity(config, _State(mapper.belief, mapper.arcs))
    sized = config._replace(
        filter=config.filter._replace(
            max_landmarks=state.belief.num_seen.size,
        ),
    )
    state, info = _steps(sized, noise, state, chunk._replace(local=None))
    part = ChunkResult(info, chunk.inputs.features, chunk.inputs.scan_match)
    part = jax.tree.map(lambda x: np.asarray(x)[: chunk.count], part)
    return SlamState(state.belief, state.arcs, chunk.local), part


def _with_capacity(config: Config, state: _State) -> _State:
    """The map with `MIN_FREE_SLOTS` free slots or more, up to `config.landmarks`; two arcs a landmark."""
    belief, arcs = state
    size = belief.num_seen.size
    larger = min(size + SLOT_BLOCK, config.filter.max_landmarks)
    if size == larger or np.count_nonzero(belief.num_seen) <= size - MIN_FREE_SLOTS:
        return state
    return _State(grow_belief(belief, larger), arc_table.grow_arcs(arcs, 2 * larger))


@partial(jax.jit, static_argnames="config")
def _step(
    config: Config,
    noise: NoiseParams,
    state: _State,
    inputs: Measurement,
    links: LocalArcs,
    scan: Scan,
) -> tuple[_State, StepInfo]:
    """Filter one scan, and merge its arcs into the map."""
    cov = flush_if_full(
        state.belief.map_cov, 2 * config.filter.max_updates + 2
    )  # and two rows of a merge
    belief, info = slam_filter.step(
        config.filter, noise, state.belief._replace(map_cov=cov), inputs
    )
    arcs = arc_table.add_scan_arcs(
        config.frontend.lidar, state.arcs, info.id, info.pose, links, scan
    )
    return _State(belief, arcs), info


@partial(trace_cache.jit, static_argnames="config")
def _steps(
    config: Config, noise: NoiseParams, state: _State, chunk: _Chunk
) -> tuple[_State, StepInfo]:
    """Filter the scans of a chunk one after the other; the info of its padding is zero.

    Downdates of the map's covariance are deferred within a chunk, except for the right-invariant
    filter, whose updates move the whole map.
    """
    per_scan = chunk.inputs, chunk.links, chunk.scans

    def scan_at(k: Array | int) -> tuple[Measurement, LocalArcs, Scan]:
        return jax.tree.map(lambda x: x[k], per_scan)

    def body(k: Array, carry: tuple[_State, StepInfo]) -> tuple[_State, StepInfo]:
        state, infos = carry
        state, info = _step(config, noise, state, *scan_at(k))
        return state, jax.tree.map(lambda old, new: old.at[k].set(new), infos, info)

    # As `_step` is jitted and closes over nothing, it is traced once, for its shapes and the loop.
    shapes = jax.eval_shape(_step, config, noise, state, *scan_at(0))[1]
    blank = jax.tree.map(lambda x: jnp.zeros((CHUNK, *x.shape), x.dtype), shapes)
    belief = state.belief
    if config.filter.linearisation != "invariant":
        belief = belief._replace(map_cov=defer(belief.map_cov))
    carry = state._replace(belief=belief), blank
    (belief, arcs), info = lax.fori_loop(0, chunk.count, body, carry)
    return _State(belief._replace(map_cov=flush(belief.map_cov)), arcs), info
