"""The local topological map of one scan: which of its junctions the branches join, and how.

The ids of the junctions expand along the branches, by the same automaton as the fronts before.
Where two ids meet, there is a link; where an id comes to the end of what was seen, a frontier.
The arrival steps lead back from there to the junctions, and so give the link its line.
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

LINK_STEPS = 96  # cells that an id goes along a branch at most
LINKS, FRONTIERS = 12, 6  # of a scan at most
MEETS = 512  # cells at most in which ids meet, or branches end
LINE = 9  # points K of a line
FINE = 4  # finer than the points of its line is a link measured
TWIN = 0.6  # [m] lines that are somewhere this far apart are two links, not one
SMOOTH = 4  # times that the staircase of cells is smoothed


class Links(NamedTuple):
    """Branches of one diagram that leave its junctions, padded to P; robot frame."""

    pair: Array  # (P, 2) int32 features they join, the smaller first; -1 second at a frontier
    line: Array  # (P, K, 2) [m] points at equal distances, from the first end to the second
    length: Array  # (P,) [m] along the branch
    clearance: Array  # (P,) [m] smallest along it, both ends included
    valid: Array  # (P,) bool


def gap(one: Array, other: Array) -> Array:
    """Largest distance (...) [m] between two lines (..., K, 2), point by point."""
    return jnp.max(jnp.linalg.norm(one - other, axis=-1), axis=-1)


def repeated(pair: Array, line: Array, valid: Array) -> Array:
    """Links (P,) bool that have the ends (P, 2) and about the line (P, K, 2) of an earlier one."""
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
    """Raise ValueError if shapes or types do not fit."""
    if scan.ranges.shape != (lidar.beams,):
        raise ValueError(f"scan.ranges is {scan.ranges.shape}, not {(lidar.beams,)}")
    if found.xy.ndim != 2 or found.xy.shape[0] < spec.nodes or found.xy.shape[1] != 2:
        raise ValueError(f"found.xy is {found.xy.shape}, not (M >= {spec.nodes}, 2)")
    whole = (("diagram.labels", diagram.labels), ("sources", sources))
    for name, cells in whole:
        if cells.shape != grid.shape:
            raise ValueError(f"{name} is {cells.shape}, not as the grid {grid.shape}")
    if sources.dtype != bool:
        raise ValueError(f"sources is {sources.dtype}, not bool")


class _Ids(NamedTuple):
    """The ids of the junctions, expanded along the branches."""

    own: Array  # (H, W) bit sets of ids
    far: Array  # (H, W) int16 twice the step of arrival, and one in a cell of a branch; -1 for none


def _some(mask: Array) -> Array:
    """Cells (MEETS,) int32 in which a mask (H, W) is True, H W for none."""
    # The first of them by the number of the cell; an exact float32, and half the time of `nonzero`.
    first = -jnp.arange(mask.size, dtype=jnp.float32)
    score, cell = lax.top_k(jnp.where(mask.reshape(-1), first, -jnp.inf), min(MEETS, mask.size))
    return jnp.where(score > -jnp.inf, cell, mask.size).astype(jnp.int32)


def _over(cells: Array, how: Callable, reach: int) -> Array:
    """`how` over the square of `reach` cells about each (H, W), of cells with so many around."""
    for axis in range(2):
        size = cells.shape[axis] - 2 * reach
        some = (lax.slice_in_dim(cells, k, k + size, axis=axis) for k in range(2 * reach + 1))
        cells = reduce(how, some)
    return cells


def _top(score: Array, cells: Array, count: int, reach: int, width: int) -> tuple[Array, Array]:
    """Of some cells (C,) the `count` with the highest scores (C,), and which are finite.

    They are `reach` cells apart, in a grid of `width` columns.
    """

    def step(left: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        # The first of the largest: two plain reductions are many times as fast as `argmax`.
        at = jnp.min(jnp.where(left == jnp.max(left), index, index.size - 1))
        square = (rows - rows[at]) ** 2 + (columns - columns[at]) ** 2
        return jnp.where(square < reach**2, -jnp.inf, left), (cells[at], left[at] > -jnp.inf)

    rows, columns = cells // width, cells % width
    index = jnp.arange(cells.size, dtype=jnp.int32)
    return lax.scan(step, score, length=count)[1]


def find_links(
    found: Nodes,
    diagram: Diagram,
    sources: Array,
    scan: Scan,
    lidar: Lidar,
    grid: GridSpec,
    spec: NodeSpec,
) -> Links:
    """Which junctions the branches of a diagram join, and which branches lead out of the view.

    Two junctions may have two links, if their branches part. A frontier is the end of a branch
    that meets no other junction before what the scan did not see, and is not in a corner.

    Args:
        found: Features of the scan, junctions first.
        diagram: Its diagram.
        sources: (H, W) bool, the cells the fronts came from.
        scan: The scan.
        lidar: The scanner.
        grid: The grid of the diagram.
        spec: Capacities; at most 31 junctions.

    Returns:
        `LINKS` links, then `FRONTIERS` frontiers.

    Raises:
        ValueError: Shapes do not fit, or there are too many junctions; while tracing.
    """
    _check(found, diagram, sources, scan, lidar, grid, spec)
    place, valid = found.xy[: spec.nodes], found.valid[: spec.nodes]
    place = jnp.where(valid[:, None], place, 0.0)
    bit = id_bits(spec.nodes)
    seeds = _seeds(place, valid, bit, grid)
    ids = one_by_one(_spread)(seeds, diagram, sources)
    free = one_by_one(lambda scan: seen_free(scan, lidar, grid))(scan)
    unseen = (diagram.labels == 0) & ~sources & ~free
    wide = diagram.arrival > round(spec.least / grid.cell)  # steps, no fewer than cells to a wall
    reach = round(TWIN / grid.cell)
    some = [_meets(ids, place, grid, bit, reach), _ends(ids, unseen, wide, bit, reach)]
    pair, cell, good = (jnp.concatenate(x) for x in zip(*some, strict=True))
    hits = jnp.where(scan.hit[:, None], points(scan, lidar), 1e3)
    line, length, clearance = jax.vmap(_measure, in_axes=(0, 0, 0, None, None, None))(
        pair, cell, one_by_one(_back)(pair, cell, ids, bit), place, grid, hits
    )
    shape = jnp.append(found.shape[: spec.nodes], jnp.inf)
    clearance = jnp.minimum(clearance, jnp.min(shape[pair], axis=1))
    good &= (pair[:, 1] >= 0) | (clearance > spec.least)
    good &= ~repeated(pair, line, good)
    return Links(pair=pair, line=line, length=length, clearance=clearance, valid=good)


def _spread(seeds: Array, diagram: Diagram, sources: Array) -> _Ids:
    """Ids from their seeds (H, W) along the branches of a diagram, which are three cells wide."""
    branch = branches(diagram, sources)
    thick = (block_union(branch.astype(jnp.uint8)) > 0) & (diagram.labels != 0) & ~sources
    met = expand(seeds, thick | (seeds != 0), steps=LINK_STEPS)
    far = 2 * met.arrival.astype(jnp.int16) + branch.astype(jnp.int16)
    return _Ids(met.labels, jnp.where(met.arrival >= 0, far, jnp.int16(-1)))


def _seeds(place: Array, valid: Array, bit: Array, grid: GridSpec) -> Array:
    """Bit sets (H, W) of the ids of those junctions (N, 2) whose place is 2.5 cells off or less."""
    beside = jnp.asarray(np.indices((7, 7)).reshape(2, -1).T - 3, jnp.int32)
    cell = cell_of(place, grid)[:, None] + beside[None]  # (N, 49, 2)
    away = jnp.linalg.norm(centre_of(cell, grid).astype(place.dtype) - place[:, None], axis=-1)
    near = (away < 2.5 * grid.cell) & valid[:, None] & jnp.all(cell >= 0, axis=-1)
    row = jnp.where(near, cell[..., 0], grid.shape[0])
    # No id comes twice to a cell: the sum of bits is their set.
    own = jnp.broadcast_to(bit[:-1, None], row.shape)
    return jnp.zeros(grid.shape, bit.dtype).at[row, cell[..., 1]].add(own, mode="drop")


def _shared(own: Array) -> Array:
    """Bit sets (H, W) of ids that meet: in a cell, or evenly, one here and another next door."""
    beside = reduce(jnp.bitwise_or, around(single(own)))
    return own | jnp.where(single(own) != 0, beside, jnp.zeros_like(beside))


def _meets(
    ids: _Ids, place: Array, grid: GridSpec, bit: Array, reach: int
) -> tuple[Array, Array, Array]:
    """Where two ids meet: their pair (LINKS, 2), a cell (LINKS,), and whether there is one.

    Each pair may meet twice, in places that are far from each other.
    """
    both = _shared(ids.own)
    # Few cells hold two: all that follows is done on these.
    where = _some((both & (both - 1)) != 0)
    take = lambda x, fill: x.reshape(-1).at[where].get(mode="fill", fill_value=fill)
    far = take(ids.far, 0)
    off_branch = jnp.where(far % 2 == 1, 0.0, 2.5).astype(place.dtype)
    early = -(far // 2).astype(place.dtype) - off_branch
    held, width = take(both, 0), grid.shape[1]
    middle = centre_of(jnp.stack([where // width, where % width], axis=-1), grid)
    from_ids = jnp.linalg.norm(middle.astype(place.dtype)[None] - place[:, None], axis=-1)
    first, second = (jnp.asarray(k, jnp.int32) for k in np.triu_indices(len(bit) - 1, 1))

    def meet(i: Array, j: Array) -> tuple[Array, Array]:
        want = bit[i] | bit[j]
        score = early - 1e-3 * (from_ids[i] + from_ids[j])
        return _top(jnp.where(held & want == want, score, -jnp.inf), where, 2, reach, width)

    cell, valid = (x.reshape(-1) for x in jax.vmap(meet)(first, second))
    order = jnp.argsort(~valid, stable=True)
    order = jnp.resize(order, LINKS) if len(order) < LINKS else order[:LINKS]
    pair = jnp.repeat(jnp.stack([first, second], axis=1), 2, axis=0)
    return pair[order], cell[order], valid[order]


def _outermost(ids: _Ids, unseen: Array, wide: Array) -> Array:
    """Cells (H, W) of one id, farther from its junction than all near them, next to unseen ones."""
    around_it = _over(jnp.pad(ids.own, 2), jnp.bitwise_or, 2)
    edge = _over(jnp.pad(unseen, 2, constant_values=True), jnp.logical_or, 2)
    farthest = _over(jnp.pad(ids.far, 3, constant_values=-1), jnp.maximum, 3)
    alone = (single(ids.own) != 0) & (around_it == ids.own)
    return alone & (ids.far > 1) & (ids.far == farthest) & edge & wide


def _ends(
    ids: _Ids, unseen: Array, wide: Array, bit: Array, reach: int
) -> tuple[Array, Array, Array]:
    """Where branches leave the view: pairs (FRONTIERS, 2) of id and -1, cells, and whether."""
    own, far = single(ids.own), ids.far
    where = _some(one_by_one(_outermost)(ids, unseen, wide))
    score = far.reshape(-1).at[where].get(mode="fill", fill_value=-1).astype(float)
    score = jnp.where(where < far.size, score, -jnp.inf)
    cell, valid = _top(score, where, FRONTIERS, reach, far.shape[1])
    node = jnp.argmax(own.reshape(-1)[cell][:, None] == bit[None, :-1], axis=1).astype(jnp.int32)
    return jnp.stack([node, jnp.full_like(node, -1)], axis=1), cell, valid


def _back(pair: Array, cell: Array, ids: _Ids, bit: Array) -> tuple[Array, Array]:
    """Cells (P, 2, S) from those (P,) in which ids met back to where both of them came from.

    Each step goes to a cell that the id reached earlier: on the branch where one is. And whether
    (P, 2, S) it is a step: none is from where an id came from, nor back to the -1 of a frontier.
    """
    w = ids.far.shape[1] + 2  # a ring of cells around
    own_at = jnp.pad(ids.own, 1).reshape(-1)
    far_at = jnp.pad(ids.far, 1, constant_values=-1).reshape(-1)
    beside = jnp.array([-w - 1, -w, -w + 1, -1, 1, w - 1, w, w + 1], jnp.int32)
    own = bit[jnp.where(pair < 0, len(bit) - 1, pair)][..., None]  # the last is nobody's

    def step(now: tuple[Array, ...]) -> tuple[Array, ...]:
        k, at, limit, cells, moved = now
        near = at[..., None] + beside[None, None]
        far = far_at[near]
        good = (own_at[near] == own) & (far // 2 < limit[..., None])
        # A cell of a branch is worth two steps and a half.
        price = jnp.where(good, far - 6 * (far % 2), jnp.iinfo(far.dtype).max)
        best = jnp.argmin(price, axis=-1, keepdims=True)
        can = jnp.any(good, axis=-1)
        take = lambda x: jnp.take_along_axis(x, best, axis=-1)[..., 0]
        at = jnp.where(can, take(near), at)
        limit = jnp.where(can, take(far) // 2, limit)
        return k + 1, at, limit, cells.at[k].set(at), moved.at[k].set(can)

    start = (cell // (w - 2) + 1) * w + cell % (w - 2) + 1
    start = jnp.broadcast_to(start[:, None], pair.shape)
    # The first step may go to a cell that was reached as early: an even meet.
    begin = jnp.int32(0), start, far_at[start] // 2 + 1
    blank = jnp.zeros((LINK_STEPS, *pair.shape), jnp.int32)
    go_on = lambda now: (now[0] < LINK_STEPS) & ((now[0] == 0) | jnp.any(now[4][now[0] - 1]))
    _, _, _, at, moved = lax.while_loop(go_on, step, (*begin, blank, blank.astype(bool)))
    at, moved = (jnp.moveaxis(x, 0, -1) for x in (at, moved))
    return (at // w - 1) * (w - 2) + at % w - 1, moved


def _measure(
    pair: Array,
    cell: Array,
    back: tuple[Array, Array],
    place: Array,
    grid: GridSpec,
    hits: Array,
) -> tuple[Array, Array, Array]:
    """Line (K, 2), length and clearance of a link of a `pair` (2,) that met in a `cell`.

    `back` are the cells (2, S) from there, and whether they are steps.
    """
    at = lambda flat: centre_of(
        jnp.stack([flat // grid.shape[1], flat % grid.shape[1]], axis=-1), grid
    ).astype(place.dtype)
    middle = at(cell)
    sides = []
    for end, cells, moved in zip(pair, *back, strict=True):
        last = jnp.where(end < 0, middle, place[end])
        way = jnp.where(moved[:, None], at(cells), last[None])
        sides.append((jnp.concatenate([way, last[None]]), jnp.append(~moved, True)))
    (there, there_fixed), (back, back_fixed) = sides
    way = jnp.concatenate([there[::-1], middle[None], back])
    fixed = jnp.concatenate([there_fixed[::-1], pair[1:] < 0, back_fixed])
    for _ in range(SMOOTH):
        mean = (way[:-2] + 2.0 * way[1:-1] + way[2:]) / 4.0
        way = way.at[1:-1].set(jnp.where(fixed[1:-1, None], way[1:-1], mean))
    fine = resample(way, FINE * (LINE - 1) + 1)
    length = jnp.sum(jnp.linalg.norm(jnp.diff(fine, axis=0), axis=1))
    x, y = (fine[:, None, k] - hits[None, :, k] for k in range(2))
    return fine[::FINE], length, jnp.sqrt(jnp.min(x * x + y * y))


def resample(way: Array, count: int) -> Array:
    """Points (count, 2) at equal distances along a polyline (n, 2) [m], its ends included."""
    size = jnp.sqrt(jnp.sum(jnp.diff(way, axis=0) ** 2, axis=1))
    along = jnp.concatenate([jnp.zeros(1, size.dtype), jnp.cumsum(size)])
    want = along[-1] * jnp.linspace(0.0, 1.0, count, dtype=size.dtype)
    return jnp.stack([jnp.interp(want, along, way[:, k]) for k in range(2)], axis=1)
