"""One chunk of scans: front end and filter, as programs of fixed shape.

Scans are processed in chunks of `CHUNK` by programs that depend neither on the length of the log
nor, up to steps of `SLOT_BLOCK` slots, on the number of landmarks: what is compiled for one log
serves all logs of that scanner. Each stage is compiled for its own part of the configuration.

Each chunk passes two stages. The front end (features, arcs, scan matching) needs the chunk's scans
and the last submap of the scan matcher, but not the filter; so the front end of chunk k + 1 is
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
from contextlib import ExitStack
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core import trace_cache
from jaxslam.core.batching import on_device, pad_to
from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement, ScanMatch
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import Array
from jaxslam.filtering import slam_filter
from jaxslam.filtering.belief import Belief, grow_belief
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.covariance import DeferredCovariance, defer, flush, flush_if_full
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import StepInfo
from jaxslam.frontend import extract
from jaxslam.frontend.local_graph import LocalArcs
from jaxslam.mapping import arc_table
from jaxslam.mapping.arc_table import ArcTable
from jaxslam.matching import scan_matching
from jaxslam.matching.icp import Submap
from jaxslam.pipeline.config import Config

CHUNK = 64  # scans of a chunk
SLOT_BLOCK = 384  # slots by which the capacity of the filter's map grows
MIN_FREE_SLOTS = 128  # free slots at the beginning of a chunk, at least
SETTINGS: dict[str, Callable] = {  # of JAX, that a program depends on, and their context managers
    "jax_enable_x64": jax.enable_x64,
    "jax_numpy_dtype_promotion": jax.numpy_dtype_promotion,
    "jax_numpy_rank_promotion": jax.numpy_rank_promotion,
    "jax_default_matmul_precision": jax.default_matmul_precision,
    "jax_default_device": jax.default_device,
}


class FilterState(NamedTuple):
    """What the filter stage carries from scan to scan.

    Attributes:
        belief: Of the filter.
        arcs: Of the topological map.
    """

    belief: Belief
    arcs: ArcTable


class ChunkResult(NamedTuple):
    """Result of a chunk of N scans; NumPy arrays that lead with N.

    Attributes:
        info: Diagnostics of the filter.
        features: Features.
        scan_matches: Increments by scan matching; None where scans are not matched.
        keyframes: (N,) int numbers in the log, of keyframes of a whole log; else None.
    """

    info: StepInfo
    features: Features
    scan_matches: ScanMatch | None
    keyframes: np.ndarray | None = None


class Chunk(NamedTuple):
    """Output of the front end for a chunk of scans, padded with its last scan.

    Attributes:
        num_scans: () int32 number of scans without the padding.
        scans: [CHUNK].
        measurements: [CHUNK] for the filter.
        local_arcs: [CHUNK] arcs of each scan.
        submap: Of the scan matcher after the chunk; None where scans are not matched.
    """

    num_scans: Array
    scans: Scan
    measurements: Measurement
    local_arcs: LocalArcs
    submap: Submap | None


def with_settings(function: Callable) -> Callable:
    """The function with the settings of JAX that this thread has, for calls in another one.

    Settings by context managers, such as `with jax.enable_x64(True)`, are those of one thread.
    """
    settings = {name: getattr(jax.config, name) for name in SETTINGS}

    def call(*args: Any) -> Any:
        with ExitStack() as stack:
            for name, value in settings.items():
                if getattr(jax.config, name) != value:
                    stack.enter_context(SETTINGS[name](value))
            return function(*args)

    return call


def chunk_at(first: int, odometry: np.ndarray, scans: Scan) -> tuple[np.ndarray, Scan]:
    """Odometry (N, 3) and scans [N] of the chunk that begins at index `first` of a log, NumPy."""
    some = slice(first, first + CHUNK)
    return odometry[some], jax.tree.map(lambda x: x[some], scans)


def padded_chunk(odometry: np.ndarray, scans: Scan) -> tuple[Scan, Array, Array]:
    """Scans and odometry of a chunk, padded, in JAX's precision, and its length () int32."""
    padded_scans, increments = on_device(pad_to((scans, odometry), to=CHUNK))
    return padded_scans, increments, on_device(np.int32(len(odometry)))


def match_chunk(
    config: Config, submap: Submap, odometry: np.ndarray, scans: Scan, guessed: np.ndarray
) -> tuple[Submap, ScanMatch]:
    """Submap after a chunk, and its increments [N] by scan matching, NumPy; waits for them.

    Args:
        config: Of the scanner and of scan matching.
        submap: After the chunk before.
        odometry: (N, 3) [m, m, rad] increments, NumPy.
        scans: [N], NumPy.
        guessed: (N,) bool, which increments are guesses of the reader.
    """
    lidar, given = config.frontend.lidar, padded_chunk(odometry, scans)
    submap, matches = scan_matching.match_scans(
        config.scan_matching, lidar, submap, *given, guessed=pad_to(guessed, to=CHUNK)
    )
    return submap, jax.tree.map(lambda x: np.asarray(x)[: len(odometry)], matches)


def extract_matched(
    config: Config,
    submap: Submap | None,
    odometry: np.ndarray,
    scans: Scan,
    matches: ScanMatch | None,
) -> Chunk:
    """Features and arcs of a chunk whose scans are matched, or are not to be; does not wait.

    Args:
        config: Of the front end.
        submap: After the chunk; None if scans are not matched.
        odometry: (N, 3) [m, m, rad] increments, NumPy.
        scans: [N], NumPy.
        matches: [N] increments by scan matching, NumPy; None if there are none.
    """
    padded_scans, increments, count = padded_chunk(odometry, scans)
    features, local_arcs = extract.extract_local_graphs(config.frontend, padded_scans)
    matches = on_device(pad_to(matches, to=CHUNK))
    measurements = Measurement(increments, features, scan_match=matches)
    return Chunk(count, padded_scans, measurements, local_arcs, submap)


def extract_chunk(
    config: Config,
    submap: Submap | None,
    odometry: np.ndarray,
    scans: Scan,
) -> Chunk:
    """Features, arcs and, with a submap of the scan matcher, matched increments of a chunk.

    Args:
        config: Of front end and scan matching.
        submap: After the chunk before; None if scans are not matched.
        odometry: (N, 3) [m, m, rad] increments, NumPy.
        scans: [N], NumPy.
    """
    padded_scans, increments, count = padded_chunk(odometry, scans)
    matches = None
    with ThreadPoolExecutor(1) as worker:  # beside the matching, see the module's diagram
        run = with_settings(extract.extract_local_graphs)
        extracted = worker.submit(run, config.frontend, padded_scans)
        if submap is not None:
            submap, matches = scan_matching.match_scans(
                config.scan_matching,
                config.frontend.lidar,
                submap,
                padded_scans,
                increments,
                count,
            )
        features, local_arcs = extracted.result()
    measurements = Measurement(increments, features, scan_match=matches)
    return Chunk(count, padded_scans, measurements, local_arcs, submap)


def filter_chunk(
    config: Config, params: NoiseParams, state: FilterState, chunk: Chunk
) -> tuple[FilterState, ChunkResult]:
    """Filter a chunk and merge its arcs into the map; waits for the results.

    Args:
        config: Of the filter, and the scanner.
        params: Q and R of the filter.
        state: After the chunk before.
        chunk: Output of the front end.
    """
    state = _with_capacity(config.filter, state)
    sized = config.filter._replace(max_landmarks=state.belief.num_seen.size)
    state, info = _steps(sized, config.frontend.lidar, params, state, chunk._replace(submap=None))
    result = ChunkResult(info, chunk.measurements.features, chunk.measurements.scan_match)
    return state, jax.tree.map(lambda x: np.asarray(x)[: chunk.num_scans], result)


def _with_capacity(config: FilterConfig, state: FilterState) -> FilterState:
    """The map with `MIN_FREE_SLOTS` free slots or more, up to `max_landmarks`; two arcs a slot."""
    belief, arcs = state
    size = belief.num_seen.size
    larger = min(size + SLOT_BLOCK, config.max_landmarks)
    if size == larger or np.count_nonzero(belief.num_seen) <= size - MIN_FREE_SLOTS:
        return state
    return FilterState(grow_belief(belief, larger), arc_table.grow_arcs(arcs, 2 * larger))


@partial(jax.jit, static_argnames=("config", "lidar"))
def _step(
    config: FilterConfig,
    lidar: Lidar,
    params: NoiseParams,
    state: FilterState,
    measurement: Measurement,
    local_arcs: LocalArcs,
    scan: Scan,
) -> tuple[FilterState, StepInfo]:
    """Filter one scan, and merge its arcs into the map."""
    # At most two rows for each update, and two for a merge.
    cov = flush_if_full(state.belief.map_cov, 2 * config.max_updates + 2)
    belief, info = slam_filter.step(config, params, state.belief._replace(map_cov=cov), measurement)
    arcs = arc_table.add_scan_arcs(lidar, state.arcs, info.id, info.pose, local_arcs, scan)
    return FilterState(belief, arcs), info


@partial(trace_cache.jit, static_argnames=("config", "lidar"), compile_quickly=True)
def _steps(
    config: FilterConfig, lidar: Lidar, params: NoiseParams, state: FilterState, chunk: Chunk
) -> tuple[FilterState, StepInfo]:
    """Filter the scans of a chunk one after the other; the info of its padding is zero.

    Downdates of the map's covariance are deferred within a chunk, except for the right-invariant
    filter, whose updates move the whole map.
    """
    per_scan = chunk.measurements, chunk.local_arcs, chunk.scans

    def scan_at(k: Array | int) -> tuple[Measurement, LocalArcs, Scan]:
        return jax.tree.map(lambda x: x[k], per_scan)

    def body(k: Array, carry: tuple[FilterState, StepInfo]) -> tuple[FilterState, StepInfo]:
        state, infos = carry
        state, info = _step(config, lidar, params, state, *scan_at(k))
        return state, jax.tree.map(lambda old, new: old.at[k].set(new), infos, info)

    # As `_step` is jitted and closes over nothing, it is traced once, for its shapes and the loop.
    shapes = jax.eval_shape(partial(_step, config, lidar), params, state, *scan_at(0))[1]
    blank = jax.tree.map(lambda x: jnp.zeros((CHUNK, *x.shape), x.dtype), shapes)
    belief, cov = state.belief, state.belief.map_cov
    if config.linearisation != "invariant" and not isinstance(cov, DeferredCovariance):
        belief = belief._replace(map_cov=defer(cov))
    carry = state._replace(belief=belief), blank
    (belief, arcs), info = lax.fori_loop(0, chunk.num_scans, body, carry)
    return FilterState(belief._replace(map_cov=flush(belief.map_cov)), arcs), info
