"""Local topological map of one scan: which junctions the Voronoi branches join, and how.

The ids of the junctions propagate along the branches, by the same automaton that grew the diagram.
Where two ids meet there is an arc; where an id comes to the end of the visible region, a frontier.
The arrival steps lead back from there to the junctions, which gives the polyline:

    junction 1                                          junction 2
        o 1 1 1 1 1 1 1 1 1 1 1 # 2 2 2 2 2 2 2 2 2 2 2 2 o        ids; # holds both: they met
        0 1 2 3 4 5 6 7 8 9 ... 12 ...  9 8 7 6 5 4 3 2 1 0        steps of arrival
        <------- back ------------ # ------------- back -->        `trace_back`

Stages: `seed_cells` and `propagate_ids` (ids), `_meeting_cells` and `_end_cells` (where to start
back-tracing), `trace_back` (cells), `measure_arc` (polyline, length, clearance).
"""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.batching import sequential_vmap_on_cpu
from jaxslam.core.features import Features
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import AnyArray, Array, check_array
from jaxslam.frontend import automaton
from jaxslam.frontend.arc_tracing import measure_arc, trace_back
from jaxslam.frontend.automaton import Diagram, single_labels
from jaxslam.frontend.features import FeatureSpec
from jaxslam.frontend.grid import GridSpec, centre_of, seen_free
from jaxslam.frontend.id_propagation import PropagatedIds, id_bits, propagate_ids, seed_cells
from jaxslam.frontend.lidar import beam_ends

MAX_LOCAL_ARCS, MAX_LOCAL_FRONTIERS = 12, 6  # capacities of a scan
MAX_MEETING_CELLS = 512  # capacity for cells in which ids meet, or branches end

SAME_ARC_DISTANCE = 0.6
"""[m] Arcs with the same ends are two arcs if they are farther apart than this somewhere."""


class LocalArcs(NamedTuple):
    """Branches of one diagram that leave its junctions, padded to P; robot frame.

    Attributes:
        pair: (P, 2) int32 features that they join, the smaller index first; the second is -1 for a
            frontier.
        polyline: (P, `POLYLINE_POINTS`, 2) [m] points at equal distances, from the first end to
            the second.
        length: (P,) [m] along the branch.
        clearance: (P,) [m] smallest along the branch, both ends included.
        valid: (P,) bool, False marks padding.
    """

    pair: Array
    polyline: Array
    length: Array
    clearance: Array
    valid: Array


class CoarseOnly(NamedTuple):
    """What a coarser level of the pyramid adds to the local map.

    Attributes:
        cells: (H, W) bool, cells whose largest empty circle the finer levels cannot hold.
        junctions: (N,) bool, junctions whose circle they cannot hold.
    """

    cells: Array
    junctions: Array


def polyline_gap(one: Array, other: Array) -> Array:
    """Largest distance (...) [m] between two polylines (..., K, 2), point by point."""
    return jnp.max(jnp.linalg.norm(one - other, axis=-1), axis=-1)


def repeats_earlier(
    pair: Array, line: Array, valid: Array, distance: AnyArray | float = SAME_ARC_DISTANCE
) -> Array:
    """Whether arcs are duplicates of an earlier one.

    They have the same ends and are nowhere `distance` apart.

    Args:
        pair: (P, 2) int32 ends.
        line: (P, K, 2) [m] polylines.
        valid: (P,) bool.
        distance: (P, 1) or () [m].

    Returns:
        (P,) bool.
    """
    same = jnp.all(pair[:, None] == pair[None], axis=2) & (
        polyline_gap(line[:, None], line[None]) < distance
    )
    earlier = jnp.tril(jnp.ones(same.shape, bool), -1)
    return jnp.any(same & earlier & valid[None], axis=1)


def _check(
    lidar: Lidar,
    grid: GridSpec,
    spec: FeatureSpec,
    features: Features,
    diagram: Diagram,
    sources: Array,
    scan: Scan,
) -> None:
    """Raise ValueError if shapes or types do not match."""
    check_array("scan.ranges", scan.ranges, (lidar.num_beams,), jnp.floating)
    check_array("features.xy", features.xy, ("M", 2), jnp.floating)
    if len(features.xy) < spec.max_junctions:
        raise ValueError(f"features.xy is {features.xy.shape}, not (M >= {spec.max_junctions}, 2)")
    check_array("diagram.labels", diagram.labels, grid.shape, jnp.unsignedinteger)
    check_array("sources", sources, grid.shape, jnp.bool_)


def _marked(mask: Array) -> Array:
    """Flat index (C,) int32 of the first True cells of a mask (H, W); H W is padding.

    C is `MAX_MEETING_CELLS`, or H W if that is less.
    """
    # Flat indices are exact in float32. `top_k` takes half the time of `nonzero`.
    first = -jnp.arange(mask.size, dtype=jnp.float32)
    count = min(MAX_MEETING_CELLS, mask.size)
    score, cell = lax.top_k(jnp.where(mask.reshape(-1), first, -jnp.inf), count)
    return jnp.where(score > -jnp.inf, cell, mask.size).astype(jnp.int32)


def _window(padded: Array, combine: Callable, radius: int) -> Array:
    """Reduce the square of `radius` cells around each cell by `combine`, one axis at a time.

    Args:
        padded: Cells (H, W) with a border of `radius` cells.
        combine: Associative function of two arrays.
        radius: [cells]

    Returns:
        (H, W).
    """
    for axis in range(2):
        size = padded.shape[axis] - 2 * radius
        shifted = (lax.slice_in_dim(padded, k, k + size, axis=axis) for k in range(2 * radius + 1))
        padded = reduce(combine, shifted)
    return padded


def _best_cells(
    score: Array, cells: Array, count: int, min_distance: int, width: int
) -> tuple[Array, Array]:
    """The best cells that are at least `min_distance` cells from each other, taken greedily.

    Args:
        score: (C,) larger is better; -inf excludes a cell.
        cells: (C,) int32 flat index.
        count: Number of cells wanted.
        min_distance: [cells]
        width: Columns of the grid.

    Returns:
        Cells (count,) int32, best first, and whether there is one: (count,) bool.
    """

    def take_best(left: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        # The first of the largest: two plain reductions are many times as fast as `argmax`.
        best = jnp.min(jnp.where(left == jnp.max(left), index, index.size - 1))
        square = (rows - rows[best]) ** 2 + (columns - columns[best]) ** 2
        return jnp.where(square < min_distance**2, -jnp.inf, left), (
            cells[best],
            left[best] > -jnp.inf,
        )

    rows, columns = cells // width, cells % width
    index = jnp.arange(cells.size, dtype=jnp.int32)
    return lax.scan(take_best, score, length=count)[1]


def find_local_arcs(
    lidar: Lidar,
    grid: GridSpec,
    spec: FeatureSpec,
    features: Features,
    diagram: Diagram,
    sources: Array,
    scan: Scan,
    coarse: CoarseOnly | None = None,
) -> LocalArcs:
    """Which junctions the branches of a diagram join, and which branches leave the visible region.

    Two junctions may have two arcs, if these are `SAME_ARC_DISTANCE` apart somewhere. A frontier is
    the end of a branch at which it borders on unseen cells, not in a corner, before it meets
    another junction.

    Args:
        lidar: The scanner.
        grid: The grid of the diagram.
        spec: Capacities; at most 31 junctions.
        features: Features of the scan, junctions first.
        diagram: Its Voronoi diagram.
        sources: (H, W) bool, the cells that fronts started from.
        scan: The scan.
        coarse: For a coarser level of the pyramid: what the finer ones do not hold, and nothing
            else is wanted.

    Returns:
        `MAX_LOCAL_ARCS` arcs, then `MAX_LOCAL_FRONTIERS` frontiers; robot frame.

    Raises:
        ValueError: Shapes do not match, or there are too many junctions; while tracing.
    """
    _check(lidar, grid, spec, features, diagram, sources, scan)
    xy, valid = features.xy[: spec.max_junctions], features.valid[: spec.max_junctions]
    xy = jnp.where(valid[:, None], xy, 0.0)
    bit = id_bits(spec.max_junctions)
    seeds = seed_cells(xy, valid, bit, grid)
    if coarse is not None:  # cells of the other side of a wall may be within 2.5 cells
        seeds = jnp.where((diagram.labels != 0) & ~sources, seeds, jnp.zeros_like(seeds))
    ids = sequential_vmap_on_cpu(propagate_ids)(seeds, diagram, sources)
    free = sequential_vmap_on_cpu(lambda scan: seen_free(lidar, grid, scan))(scan)
    unseen = (diagram.labels == 0) & ~sources & ~free
    # The step of arrival is at most the distance to the nearest wall in cells.
    wide = diagram.arrival > round(spec.min_clearance / grid.cell_size)
    apart = round(SAME_ARC_DISTANCE / grid.cell_size)
    met = _meeting_ids(ids.ids)
    meets = (met & (met - 1)) != 0
    if coarse is not None:
        far_ids = jnp.bitwise_or.reduce(jnp.where(coarse.junctions, bit[:-1], 0))
        wide, meets = wide & coarse.cells, meets & (coarse.cells | ((met & far_ids) != 0))
    ends = [
        _meeting_cells(ids, met, meets, xy, grid, bit, apart),
        _end_cells(ids, unseen, wide, bit, apart),
    ]
    pair, cell, good = (jnp.concatenate(x) for x in zip(*ends, strict=True))
    hits = jnp.where(scan.hit[:, None], beam_ends(lidar, scan), 1e3)
    line, length, clearance = jax.vmap(measure_arc, in_axes=(0, 0, 0, None, None, None))(
        pair, cell, sequential_vmap_on_cpu(trace_back)(pair, cell, ids, bit), xy, grid, hits
    )
    # The last entry is for index -1: a frontier, which has no radius.
    radius = jnp.append(features.descriptor[: spec.max_junctions], jnp.inf)
    clearance = jnp.minimum(clearance, jnp.min(radius[pair], axis=1))
    good &= (pair[:, 1] >= 0) | (clearance > spec.min_clearance)
    good &= ~repeats_earlier(pair, line, good)
    return LocalArcs(pair=pair, polyline=line, length=length, clearance=clearance, valid=good)


def _meeting_ids(ids: Array) -> Array:
    """Bit sets (H, W) of the ids that meet at a cell: in it, or between it and a neighbour.

    Between two junctions an even number of steps apart no cell holds both ids: one holds the first,
    its neighbour the second.
    """
    alone = single_labels(ids)
    beside = reduce(jnp.bitwise_or, automaton.neighbours(alone))
    return ids | jnp.where(alone != 0, beside, jnp.zeros_like(beside))


def _meeting_cells(
    ids: PropagatedIds,
    meeting: Array,
    meets: Array,
    xy: Array,
    grid: GridSpec,
    bit: Array,
    min_distance: int,
) -> tuple[Array, Array, Array]:
    """Where two ids meet first; each pair in two cells at most, `min_distance` cells apart.

    Of the cells that hold both ids of a pair those with the earliest step are taken, which a cell
    off the branch is 2.5 steps behind; the distances to both junctions break ties.

    Args:
        ids: Ids and steps of all cells.
        meeting: (H, W) bit sets of `_meeting_ids`.
        meets: (H, W) bool, the cells that count; they hold two ids or more.
        xy: (N, 2) [m] of the junctions.
        grid: The grid.
        bit: (N + 1,) bit of each id.
        min_distance: [cells]

    Returns:
        Pairs (P, 2) of ids, cells (P,) and whether there is one (P,) bool, P = `MAX_LOCAL_ARCS`.
    """
    # Few cells hold two ids: all that follows is computed for these only.
    cells = _marked(meets)

    def take(image: Array) -> Array:
        return image.reshape(-1).at[cells].get(mode="fill", fill_value=0)

    packed = take(ids.packed)
    off_branch = jnp.where(packed % 2 == 1, 0.0, 2.5).astype(xy.dtype)
    earliness = -(packed // 2).astype(xy.dtype) - off_branch
    held, width = take(meeting), grid.shape[1]
    centre = centre_of(grid, jnp.stack([cells // width, cells % width], axis=-1))
    distance = jnp.linalg.norm(centre.astype(xy.dtype)[None] - xy[:, None], axis=-1)  # (N, C)
    first, second = (jnp.asarray(k, jnp.int32) for k in np.triu_indices(len(bit) - 1, 1))

    def best_of_pair(i: Array, j: Array) -> tuple[Array, Array]:
        both = bit[i] | bit[j]
        score = earliness - 1e-3 * (distance[i] + distance[j])
        score = jnp.where(held & both == both, score, -jnp.inf)
        return _best_cells(score, cells, 2, min_distance, width)

    cell, valid = (x.reshape(-1) for x in jax.vmap(best_of_pair)(first, second))
    order = jnp.argsort(~valid, stable=True)
    few = len(order) < MAX_LOCAL_ARCS
    order = jnp.resize(order, (MAX_LOCAL_ARCS,)) if few else order[:MAX_LOCAL_ARCS]
    pair = jnp.repeat(jnp.stack([first, second], axis=1), 2, axis=0)
    return pair[order], cell[order], valid[order]


def _is_branch_end(ids: PropagatedIds, unseen: Array, wide: Array) -> Array:
    """Cells (H, W) bool in which one id alone ends next to unseen cells.

    Within 2 cells there is no other id but an unseen cell, no cell within 3 was reached later, and
    the cell is not at its seeds; `wide` (H, W) bool keeps branches into corners out.
    """
    ids_around = _window(jnp.pad(ids.ids, 2), jnp.bitwise_or, 2)
    by_unseen = _window(jnp.pad(unseen, 2, constant_values=True), jnp.logical_or, 2)
    latest = _window(jnp.pad(ids.packed, 3, constant_values=-1), jnp.maximum, 3)
    alone = (single_labels(ids.ids) != 0) & (ids_around == ids.ids)
    return alone & (ids.packed > 1) & (ids.packed == latest) & by_unseen & wide


def _end_cells(
    ids: PropagatedIds, unseen: Array, wide: Array, bit: Array, min_distance: int
) -> tuple[Array, Array, Array]:
    """Where branches leave the visible region, those reached last first, `min_distance` apart.

    Returns:
        Pairs (P, 2) of an id and -1, cells (P,) and whether there is one (P,) bool, with
        P = `MAX_LOCAL_FRONTIERS`.
    """
    own, packed = single_labels(ids.ids), ids.packed
    cells = _marked(sequential_vmap_on_cpu(_is_branch_end)(ids, unseen, wide))
    score = packed.reshape(-1).at[cells].get(mode="fill", fill_value=-1).astype(float)
    score = jnp.where(cells < packed.size, score, -jnp.inf)
    cell, valid = _best_cells(score, cells, MAX_LOCAL_FRONTIERS, min_distance, packed.shape[1])
    junction = jnp.argmax(own.reshape(-1)[cell][:, None] == bit[None, :-1], axis=1)
    junction = junction.astype(jnp.int32)
    return jnp.stack([junction, jnp.full_like(junction, -1)], axis=1), cell, valid
