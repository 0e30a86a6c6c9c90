"""Local topological map of one scan: which junctions the Voronoi branches join, and how.

The ids of the junctions propagate along the branches, by the same automaton as the fronts that grew
the diagram. Where two ids meet there is a link; where an id comes to the end of the visible region,
a frontier. The arrival steps lead back from there to the junctions, which gives the polyline:

    junction 1                                          junction 2
        o 1 1 1 1 1 1 1 1 1 1 1 # 2 2 2 2 2 2 2 2 2 2 2 2 o        ids; # holds both: they met
        0 1 2 3 4 5 6 7 8 9 ... 12 ...  9 8 7 6 5 4 3 2 1 0        steps of arrival
        <------- back ------------ # ------------- back -->        `_back`

Stages: `_seeds` and `_propagate` (ids), `_meets` and `_ends` (where to start back-tracing),
`_back` (cells), `_measure` (polyline, length, clearance).
"""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.batches import one_by_one
from jaxslam.grid import GridSpec, cell_of, centre_of, seen_free
from jaxslam.lidar import Lidar, Scan, points
from jaxslam.nodes import Nodes, NodeSpec
from jaxslam.types import Array
from jaxslam.voronoi import Diagram, around, block_union, branches, expand, single

LINK_STEPS = 96  # [cells] along a branch that an id propagates at most
LINKS, FRONTIERS = 12, 6  # capacities of a scan
MEETS = 512  # capacity for cells in which ids meet, or branches end
LINE = 9  # points K of a polyline
FINE = 4  # segments, per segment of the polyline, with which a link is measured
TWIN = 0.6  # [m] links with the same ends, farther apart than this somewhere, are two links
SMOOTH = 4  # passes of smoothing over the staircase of cells
BRANCH_BONUS = 5  # by which a cell on a branch is preferred in `_back`, in half steps


class Links(NamedTuple):
    """Branches of one diagram that leave its junctions, padded to P; robot frame.

    Attributes:
        pair: (P, 2) int32 features that they join, the smaller index first; the second is -1 for a
            frontier.
        line: (P, K, 2) [m] points at equal distances, from the first end to the second.
        length: (P,) [m] along the branch.
        clearance: (P,) [m] smallest along the branch, both ends included.
        valid: (P,) bool, False marks padding.
    """

    pair: Array
    line: Array
    length: Array
    clearance: Array
    valid: Array


def gap(one: Array, other: Array) -> Array:
    """Largest distance (...) [m] between two polylines (..., K, 2), point by point."""
    return jnp.max(jnp.linalg.norm(one - other, axis=-1), axis=-1)


def repeated(pair: Array, line: Array, valid: Array) -> Array:
    """Whether links are duplicates of an earlier one: same ends, and less than `TWIN` apart.

    Args:
        pair: (P, 2) int32 ends.
        line: (P, K, 2) [m] polylines.
        valid: (P,) bool.

    Returns:
        (P,) bool.
    """
    same = jnp.all(pair[:, None] == pair[None], axis=2) & (gap(line[:, None], line[None]) < TWIN)
    earlier = jnp.tril(jnp.ones(same.shape, bool), -1)
    return jnp.any(same & earlier & valid[None], axis=1)


def id_bits(count: int) -> Array:
    """One bit (N + 1,) for each of N ids and one that no cell holds, in the smallest type.

    Raises:
        ValueError: There are more than 31 ids.
    """
    for bits in (8, 16, 32):
        if count < bits:
            return jnp.asarray(2 ** np.arange(count + 1, dtype=np.int64), f"uint{bits}")
    raise ValueError(f"spec.nodes is {count}: at most 31 junctions can be linked")


def _check(
    found: Nodes,
    diagram: Diagram,
    sources: Array,
    scan: Scan,
    lidar: Lidar,
    grid: GridSpec,
    spec: NodeSpec,
) -> None:
    """Raise ValueError if shapes or types do not match."""
    if scan.ranges.shape != (lidar.beams,):
        raise ValueError(f"scan.ranges is {scan.ranges.shape}, not {(lidar.beams,)}")
    if found.xy.ndim != 2 or found.xy.shape[0] < spec.nodes or found.xy.shape[1] != 2:
        raise ValueError(f"found.xy is {found.xy.shape}, not (M >= {spec.nodes}, 2)")
    for name, cells in (("diagram.labels", diagram.labels), ("sources", sources)):
        if cells.shape != grid.shape:
            raise ValueError(f"{name} is {cells.shape}, not as the grid {grid.shape}")
    if sources.dtype != bool:
        raise ValueError(f"sources is {sources.dtype}, not bool")


class _Ids(NamedTuple):
    """Ids of the junctions, propagated along the branches.

    A cell keeps its step of arrival and whether it lies on the branch itself (which is propagated
    on in a band of three cells) in one small integer, so that both are gathered at once:

        packed = 2 * step + on_branch        step = packed // 2        on_branch = packed % 2

    Attributes:
        ids: (H, W) bit sets of ids: none, one, or those that met.
        packed: (H, W) int16 step of arrival and on-branch bit; -1 where no id arrived.
    """

    ids: Array
    packed: Array


def _marked(mask: Array) -> Array:
    """Flat index (MEETS,) int32 of the first True cells of a mask (H, W); H W is padding."""
    # Flat indices are exact in float32. `top_k` takes half the time of `nonzero`.
    first = -jnp.arange(mask.size, dtype=jnp.float32)
    score, cell = lax.top_k(jnp.where(mask.reshape(-1), first, -jnp.inf), min(MEETS, mask.size))
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


def _best_apart(
    score: Array, cells: Array, count: int, apart: int, width: int
) -> tuple[Array, Array]:
    """The best cells that are at least `apart` cells from each other, taken greedily.

    Args:
        score: (C,) larger is better; -inf excludes a cell.
        cells: (C,) int32 flat index.
        count: Number of cells wanted.
        apart: [cells]
        width: Columns of the grid.

    Returns:
        Cells (count,) int32, best first, and whether there is one: (count,) bool.
    """

    def take_best(left: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        # The first of the largest: two plain reductions are many times as fast as `argmax`.
        best = jnp.min(jnp.where(left == jnp.max(left), index, index.size - 1))
        square = (rows - rows[best]) ** 2 + (columns - columns[best]) ** 2
        return jnp.where(square < apart**2, -jnp.inf, left), (cells[best], left[best] > -jnp.inf)

    rows, columns = cells // width, cells % width
    index = jnp.arange(cells.size, dtype=jnp.int32)
    return lax.scan(take_best, score, length=count)[1]


def find_links(
    found: Nodes,
    diagram: Diagram,
    sources: Array,
    scan: Scan,
    lidar: Lidar,
    grid: GridSpec,
    spec: NodeSpec,
) -> Links:
    """Which junctions the branches of a diagram join, and which branches leave the visible region.

    Two junctions may have two links, if these are `TWIN` apart somewhere. A frontier is the end of
    a branch at which it borders on unseen cells, not in a corner, before it meets another junction.

    Args:
        found: Features of the scan, junctions first.
        diagram: Its Voronoi diagram.
        sources: (H, W) bool, the cells the fronts came from.
        scan: The scan.
        lidar: The scanner.
        grid: The grid of the diagram.
        spec: Capacities; at most 31 junctions.

    Returns:
        `LINKS` links, then `FRONTIERS` frontiers; robot frame.

    Raises:
        ValueError: Shapes do not match, or there are too many junctions; while tracing.
    """
    _check(found, diagram, sources, scan, lidar, grid, spec)
    xy, valid = found.xy[: spec.nodes], found.valid[: spec.nodes]
    xy = jnp.where(valid[:, None], xy, 0.0)
    bit = id_bits(spec.nodes)
    seeds = _seeds(xy, valid, bit, grid)
    ids = one_by_one(_propagate)(seeds, diagram, sources)
    free = one_by_one(lambda scan: seen_free(scan, lidar, grid))(scan)
    unseen = (diagram.labels == 0) & ~sources & ~free
    wide = diagram.arrival > round(spec.least / grid.cell)  # steps <= cells to the nearest wall
    apart = round(TWIN / grid.cell)
    ends = [_meets(ids, xy, grid, bit, apart), _ends(ids, unseen, wide, bit, apart)]
    pair, cell, good = (jnp.concatenate(x) for x in zip(*ends, strict=True))
    hits = jnp.where(scan.hit[:, None], points(scan, lidar), 1e3)
    line, length, clearance = jax.vmap(_measure, in_axes=(0, 0, 0, None, None, None))(
        pair, cell, one_by_one(_back)(pair, cell, ids, bit), xy, grid, hits
    )
    radius = jnp.append(found.shape[: spec.nodes], jnp.inf)  # index -1, a frontier, has none
    clearance = jnp.minimum(clearance, jnp.min(radius[pair], axis=1))
    good &= (pair[:, 1] >= 0) | (clearance > spec.least)
    good &= ~repeated(pair, line, good)
    return Links(pair=pair, line=line, length=length, clearance=clearance, valid=good)


def _propagate(seeds: Array, diagram: Diagram, sources: Array) -> _Ids:
    """Propagate ids from their seeds (H, W) along the branches of a diagram.

    The branches are widened to three cells, so that a gap of one cell does not cut them.
    """
    branch = branches(diagram, sources)
    band = (block_union(branch.astype(jnp.uint8)) > 0) & (diagram.labels != 0) & ~sources
    met = expand(seeds, band | (seeds != 0), steps=LINK_STEPS)
    packed = 2 * met.arrival.astype(jnp.int16) + branch.astype(jnp.int16)
    return _Ids(met.labels, jnp.where(met.arrival >= 0, packed, jnp.int16(-1)))


def _seeds(xy: Array, valid: Array, bit: Array, grid: GridSpec) -> Array:
    """Bit sets (H, W) of ids: each junction (N, 2) marks the cells within 2.5 cells of it."""
    block = jnp.asarray(np.indices((7, 7)).reshape(2, -1).T - 3, jnp.int32)
    cell = cell_of(xy, grid)[:, None] + block[None]  # (N, 49, 2)
    distance = jnp.linalg.norm(centre_of(cell, grid).astype(xy.dtype) - xy[:, None], axis=-1)
    near = (distance < 2.5 * grid.cell) & valid[:, None] & jnp.all(cell >= 0, axis=-1)
    row = jnp.where(near, cell[..., 0], grid.shape[0])
    # No id marks a cell twice: the sum of bits is their union.
    own = jnp.broadcast_to(bit[:-1, None], row.shape)
    return jnp.zeros(grid.shape, bit.dtype).at[row, cell[..., 1]].add(own, mode="drop")


def _meeting_ids(ids: Array) -> Array:
    """Bit sets (H, W) of the ids that meet at a cell: in it, or between it and a neighbour.

    Between two junctions an even number of steps apart no cell holds both ids: one holds the first,
    its neighbour the second.
    """
    alone = single(ids)
    beside = reduce(jnp.bitwise_or, around(alone))
    return ids | jnp.where(alone != 0, beside, jnp.zeros_like(beside))


def _meets(
    ids: _Ids, xy: Array, grid: GridSpec, bit: Array, apart: int
) -> tuple[Array, Array, Array]:
    """Where two ids meet first; each pair in two cells at most, `apart` cells from each other.

    Of the cells that hold both ids of a pair those with the earliest step are taken, which a cell
    off the branch is 2.5 steps behind; the distances to both junctions break ties.

    Returns:
        Pairs (LINKS, 2) of ids, cells (LINKS,), and whether there is one: (LINKS,) bool.
    """
    meeting = _meeting_ids(ids.ids)
    # Few cells hold two ids: all that follows is computed for these only.
    cells = _marked((meeting & (meeting - 1)) != 0)

    def take(image: Array) -> Array:
        return image.reshape(-1).at[cells].get(mode="fill", fill_value=0)

    packed = take(ids.packed)
    off_branch = jnp.where(packed % 2 == 1, 0.0, 2.5).astype(xy.dtype)
    earliness = -(packed // 2).astype(xy.dtype) - off_branch
    held, width = take(meeting), grid.shape[1]
    centre = centre_of(jnp.stack([cells // width, cells % width], axis=-1), grid)
    distance = jnp.linalg.norm(centre.astype(xy.dtype)[None] - xy[:, None], axis=-1)  # (N, MEETS)
    first, second = (jnp.asarray(k, jnp.int32) for k in np.triu_indices(len(bit) - 1, 1))

    def best_of_pair(i: Array, j: Array) -> tuple[Array, Array]:
        both = bit[i] | bit[j]
        score = earliness - 1e-3 * (distance[i] + distance[j])
        score = jnp.where(held & both == both, score, -jnp.inf)
        return _best_apart(score, cells, 2, apart, width)

    cell, valid = (x.reshape(-1) for x in jax.vmap(best_of_pair)(first, second))
    order = jnp.argsort(~valid, stable=True)
    order = jnp.resize(order, LINKS) if len(order) < LINKS else order[:LINKS]
    pair = jnp.repeat(jnp.stack([first, second], axis=1), 2, axis=0)
    return pair[order], cell[order], valid[order]


def _is_branch_end(ids: _Ids, unseen: Array, wide: Array) -> Array:
    """Cells (H, W) bool in which one id alone ends next to unseen cells.

    Within 2 cells there is no other id but an unseen cell, no cell within 3 was reached later, and
    the cell is not at its seeds; `wide` (H, W) bool keeps branches into corners out.
    """
    ids_around = _window(jnp.pad(ids.ids, 2), jnp.bitwise_or, 2)
    by_unseen = _window(jnp.pad(unseen, 2, constant_values=True), jnp.logical_or, 2)
    latest = _window(jnp.pad(ids.packed, 3, constant_values=-1), jnp.maximum, 3)
    alone = (single(ids.ids) != 0) & (ids_around == ids.ids)
    return alone & (ids.packed > 1) & (ids.packed == latest) & by_unseen & wide


def _ends(
    ids: _Ids, unseen: Array, wide: Array, bit: Array, apart: int
) -> tuple[Array, Array, Array]:
    """Where branches leave the visible region, those reached last first, `apart` cells apart.

    Returns:
        Pairs (FRONTIERS, 2) of an id and -1, cells (FRONTIERS,), and whether there is one.
    """
    own, packed = single(ids.ids), ids.packed
    cells = _marked(one_by_one(_is_branch_end)(ids, unseen, wide))
    score = packed.reshape(-1).at[cells].get(mode="fill", fill_value=-1).astype(float)
    score = jnp.where(cells < packed.size, score, -jnp.inf)
    cell, valid = _best_apart(score, cells, FRONTIERS, apart, packed.shape[1])
    junction = jnp.argmax(own.reshape(-1)[cell][:, None] == bit[None, :-1], axis=1)
    junction = junction.astype(jnp.int32)
    return jnp.stack([junction, jnp.full_like(junction, -1)], axis=1), cell, valid


def _back(pair: Array, cell: Array, ids: _Ids, bit: Array) -> tuple[Array, Array]:
    """Trace both ids of each pair back from the cell where they met to their junctions.

        for each id of a pair:
            at, limit = cell, step[cell] + 1
            repeat:
                candidates = the 8 neighbours of `at` that hold this id alone, with step < limit
                if there are none: stop, at the seeds of the junction
                at = the candidate of smallest 2 * step - `BRANCH_BONUS` * on_branch
                limit = step[at]

    The first limit admits a neighbour reached as early as the cell itself, since ids may have met
    between two cells. The grid is padded by one cell, so that every cell has 8 neighbours. All P
    pairs are traced together, until none moves.

    Args:
        pair: (P, 2) int32 ids; -1, the second of a frontier, is traced nowhere.
        cell: (P,) int32 flat index of the cell to start from.
        ids: Ids and steps of all cells.
        bit: (N + 1,) bit of each id; the last is held by no cell.

    Returns:
        Flat index (P, 2, `LINK_STEPS`) of the cells, without the first, and whether (of the same
        shape) each is a step; False after the last one.
    """
    width = ids.packed.shape[1] + 2
    ids_at = jnp.pad(ids.ids, 1).reshape(-1)
    packed_at = jnp.pad(ids.packed, 1, constant_values=-1).reshape(-1)
    neighbours = [-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1]
    neighbours = jnp.array(neighbours, jnp.int32)
    own = bit[jnp.where(pair < 0, len(bit) - 1, pair)][..., None]  # (P, 2, 1)

    def step(now: tuple[Array, ...]) -> tuple[Array, ...]:
        k, at, limit, cells, moved = now
        near = at[..., None] + neighbours[None, None]  # (P, 2, 8)
        packed = packed_at[near]
        good = (ids_at[near] == own) & (packed // 2 < limit[..., None])
        # 2 * step - bonus * on_branch, of 2 * step + on_branch
        cost = packed - (BRANCH_BONUS + 1) * (packed % 2)
        cost = jnp.where(good, cost, jnp.iinfo(packed.dtype).max)
        best = jnp.argmin(cost, axis=-1, keepdims=True)
        moves = jnp.any(good, axis=-1)
        best_near = jnp.take_along_axis(near, best, axis=-1)[..., 0]
        at = jnp.where(moves, best_near, at)
        best_packed = jnp.take_along_axis(packed, best, axis=-1)[..., 0]
        limit = jnp.where(moves, best_packed // 2, limit)
        return k + 1, at, limit, cells.at[k].set(at), moved.at[k].set(moves)

    def unfinished(now: tuple[Array, ...]) -> Array:
        k, _, _, _, moved = now
        return (k < LINK_STEPS) & ((k == 0) | jnp.any(moved[k - 1]))

    start = (cell // (width - 2) + 1) * width + cell % (width - 2) + 1  # in the padded grid
    start = jnp.broadcast_to(start[:, None], pair.shape)
    begin = jnp.int32(0), start, packed_at[start] // 2 + 1
    blank = jnp.zeros((LINK_STEPS, *pair.shape), jnp.int32)
    _, _, _, cells, moved = lax.while_loop(unfinished, step, (*begin, blank, blank.astype(bool)))
    cells, moved = (jnp.moveaxis(x, 0, -1) for x in (cells, moved))
    return (cells // width - 1) * (width - 2) + cells % width - 1, moved


def _measure(
    pair: Array,
    cell: Array,
    back: tuple[Array, Array],
    xy: Array,
    grid: GridSpec,
    hits: Array,
) -> tuple[Array, Array, Array]:
    """Polyline, length and clearance of one link.

    The polyline runs from the first junction through the cells traced back from the meeting cell,
    in reverse, through that cell, and through the cells of the other side to the second junction.
    Unused steps repeat the junction, so the number of points is static. The inner points are
    smoothed by (1, 2, 1) / 4; the polyline of a frontier ends at its cell.

    Args:
        pair: (2,) int32 junctions; the second is -1 for a frontier.
        cell: () int32 flat index of the cell in which the ids met.
        back: Cells (2, S) and whether each is a step, (2, S), as of `_back`.
        xy: (N, 2) [m] of the junctions.
        grid: The grid.
        hits: (R, 2) [m] ends of the beams, robot frame.

    Returns:
        Points (K, 2) [m], length and clearance [m].
    """

    def centre(flat: Array) -> Array:
        index = jnp.stack([flat // grid.shape[1], flat % grid.shape[1]], axis=-1)
        return centre_of(index, grid).astype(xy.dtype)

    middle = centre(cell)
    sides = []
    for end, cells, moved in zip(pair, *back, strict=True):
        junction = jnp.where(end < 0, middle, xy[end])
        side = jnp.where(moved[:, None], centre(cells), junction[None])
        sides.append((jnp.concatenate([side, junction[None]]), jnp.append(~moved, True)))
    (first, first_fixed), (second, second_fixed) = sides
    polyline = jnp.concatenate([first[::-1], middle[None], second])
    fixed = jnp.concatenate([first_fixed[::-1], pair[1:] < 0, second_fixed])
    for _ in range(SMOOTH):
        mean = (polyline[:-2] + 2.0 * polyline[1:-1] + polyline[2:]) / 4.0
        polyline = polyline.at[1:-1].set(jnp.where(fixed[1:-1, None], polyline[1:-1], mean))
    fine = resample(polyline, FINE * (LINE - 1) + 1)
    length = jnp.sum(jnp.linalg.norm(jnp.diff(fine, axis=0), axis=1))
    x, y = (fine[:, None, k] - hits[None, :, k] for k in range(2))
    return fine[::FINE], length, jnp.sqrt(jnp.min(x * x + y * y))


def resample(way: Array, count: int) -> Array:
    """Points (count, 2) [m] at equal distances along a polyline (n, 2) [m], its ends included."""
    size = jnp.sqrt(jnp.sum(jnp.diff(way, axis=0) ** 2, axis=1))
    along = jnp.concatenate([jnp.zeros(1, size.dtype), jnp.cumsum(size)])
    wanted = along[-1] * jnp.linspace(0.0, 1.0, count, dtype=size.dtype)
    return jnp.stack([jnp.interp(wanted, along, way[:, k]) for k in range(2)], axis=1)
