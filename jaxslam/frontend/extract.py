"""The front end as a whole: from a scan to features, and to the local topological map."""

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.core import trace_cache
from jaxslam.core.batching import BatchSize, map_batches
from jaxslam.core.features import Features, concatenate_features
from jaxslam.core.scan import Lidar, Scan, as_scan
from jaxslam.core.types import Array
from jaxslam.frontend import automaton, edge_codes, junctions, segmentation, voronoi
from jaxslam.frontend.automaton import Diagram, EncodedDiagram
from jaxslam.frontend.config import FrontendConfig, check_config
from jaxslam.frontend.dropouts import FilledScan, fill_dropouts
from jaxslam.frontend.features import find_corners, find_wall_directions
from jaxslam.frontend.grid import rasterise, seen_free
from jaxslam.frontend.lidar import begin_behind
from jaxslam.frontend.local_graph import LocalArcs
from jaxslam.frontend.local_pyramid import find_pyramid_arcs
from jaxslam.frontend.pyramid import Level, beyond_finer
from jaxslam.frontend.segments import POINTS_PER_GAP, Segments, segment_bits, segment_cells

SCAN_BATCH = BatchSize(cpu=32, accelerator=1024)  # scans whose features are extracted together


def extract_features(config: FrontendConfig, scan: Scan) -> Features:
    """Extract the features of one scan.

    Args:
        config: Static configuration of the front end.
        scan: One scan of `config.lidar`, as of `to_scan`; NumPy arrays, lists or JAX arrays.

    Returns:
        `config.features.max_features` features, padded: junctions, then corners, then wall
        directions; robot frame.

    Raises:
        ValueError: The configuration is impossible, or the scan is not one of its scanner; while
            tracing.
    """
    features, _, _ = extract_diagram(config, scan)
    return features


def encode_segments(segment: Array, free: Array) -> Array:
    """Initial cells (H, W) int8 of the automaton, as `automaton.expand_encoded` takes them.

    Args:
        segment: (H, W) int8 wall segment of each source cell, -1 elsewhere.
        free: (H, W) bool, cells that fronts may enter.
    """
    empty = jnp.where(free, automaton.EMPTY, automaton.FROZEN).astype(jnp.int8)
    return jnp.where(segment >= 0, segment, empty)


class LevelDiagram(NamedTuple):
    """Voronoi diagram of one level of the pyramid.

    Attributes:
        diagram: The diagram, (H, W).
        sources: (H, W) bool, the cells that fronts started from.
    """

    diagram: Diagram
    sources: Array


def extract_diagram(config: FrontendConfig, scan: Scan) -> tuple[Features, Diagram, Array]:
    """Extract the features of one scan, and the diagram of the finest level.

    Args:
        config: As of `extract_features`.
        scan: As of `extract_features`.

    Returns:
        The features (robot frame), the Voronoi diagram that the junctions of the finest level come
        from, and its source cells (H, W) bool.

    Raises:
        ValueError: As of `extract_features`.
    """
    features, (finest, *_) = extract_levels(config, scan)
    return features, *finest


def level_segments(lidar: Lidar, level: Level, scan: Scan, segments: Segments) -> Array:
    """`segment_cells` on the grid of a level; larger cells need fewer points."""
    points = max(3, round(POINTS_PER_GAP / level.scale))
    return segment_cells(lidar, level.grid, scan, segments, points_per_gap=points)


def junction_cells(
    levels: Sequence[Level], encoded: Sequence[EncodedDiagram], sources: Sequence[Array]
) -> list[Array]:
    """Junction cells (H, W) bool of each level; of a coarser one, those that no finer one holds.

    Args:
        levels: The levels, the finest first.
        encoded: The diagram of each.
        sources: (H, W) bool of each, the cells that fronts started from.
    """
    cells = [
        voronoi.encoded_junction_cells(own, start)
        for own, start in zip(encoded, sources, strict=True)
    ]
    for k, (finer, level) in enumerate(pairwise(levels), 1):
        cells[k] &= beyond_finer(encoded[k].arrival, level, finer)
    return cells


def grow(
    config: FrontendConfig, level: Level, scan: Scan, segments: Segments
) -> tuple[LevelDiagram, EncodedDiagram]:
    """The diagram of one level, as sets of labels and in the encoding of the automaton."""
    lidar, spec = config.lidar, level.grid
    if config.labels == "codes":
        grid = rasterise(lidar, spec, scan)
        labels = edge_codes.edge_code_bits(edge_codes.edge_codes(spec, grid))
        start = automaton.encode_sources(labels, grid.free)
        sources = grid.occupied
    else:
        segment = level_segments(lidar, level, scan, segments)
        sources = segment >= 0
        labels = segment_bits(segment)
        start = encode_segments(segment, seen_free(lidar, spec, scan))
    octagon = config.labels == "segments"
    encoded = automaton.expand_encoded(start, steps=config.automaton_steps, octagon=octagon)
    diagram = automaton.decode(labels, encoded, octagon=octagon)
    return LevelDiagram(diagram, sources), encoded


def extract_levels(config: FrontendConfig, scan: Scan) -> tuple[Features, tuple[LevelDiagram, ...]]:
    """Extract the features of one scan, and the diagrams that they come from.

    Args:
        config: As of `extract_features`.
        scan: As of `extract_features`.

    Returns:
        The features (robot frame), and the diagram of each of `config.pyramid()`.

    Raises:
        ValueError: As of `extract_features`.

    References:
        Paper, section 2; `labels="codes"` is its method, with fronts that are diamonds.
    """
    check_config(config)
    return _extract_filled(config, *_fill(config, scan))


def _fill(config: FrontendConfig, scan: Scan) -> tuple[Lidar, FilledScan]:
    """The scanner with beam 0 behind the robot, and its scan with drop-outs filled."""
    lidar, scan = begin_behind(config.lidar, as_scan(config.lidar, scan))
    return lidar, fill_dropouts(lidar, config.segments, scan)


def _extract_filled(
    config: FrontendConfig, lidar: Lidar, filled: FilledScan
) -> tuple[Features, tuple[LevelDiagram, ...]]:
    """`extract_levels` of what `_fill` returns."""
    levels, scan = config.pyramid(), filled.scan
    segments = segmentation.segment_filled(lidar, config.segments, filled)
    grown = [grow(config._replace(lidar=lidar), level, scan, segments) for level in levels]
    cells = junction_cells(levels, [own for _, own in grown], [found.sources for found, _ in grown])
    features = concatenate_features(
        junctions.find_junctions(lidar, levels, config.features, cells, scan, segments),
        find_corners(config.features, segments),
        find_wall_directions(config.features, segments),
    )
    return features, tuple(found for found, _ in grown)


def extract_local_graph(config: FrontendConfig, scan: Scan) -> tuple[Features, LocalArcs]:
    """Local topological map of one scan: its features, and the arcs between its junctions.

    Args:
        config: As of `extract_features`; at most 31 junctions.
        scan: As of `extract_features`.

    Raises:
        ValueError: As of `extract_features`, or there may be more than 31 junctions.
    """
    check_config(config)
    lidar, filled = _fill(config, scan)
    features, diagrams = _extract_filled(config, lidar, filled)
    levels = config.pyramid()
    arcs = find_pyramid_arcs(lidar, levels, config.features, features, diagrams, filled.scan)
    return features, arcs


@partial(trace_cache.jit, static_argnames="config", compile_quickly=True)
def extract_local_graphs(config: FrontendConfig, scans: Scan) -> tuple[Features, LocalArcs]:
    """`extract_local_graph` of scans [T], `SCAN_BATCH` at a time to bound memory."""
    return map_batches(partial(extract_local_graph, config), scans, batch_size=SCAN_BATCH)
