"""The local topological map of one scan: which of its junctions the branches join, and how.

The ids of the junctions expand along the branches, by the same automaton as the fronts before.
Where two ids meet, there is a link; where an id comes to the end of what was seen, a frontier.
The arrival steps lead back from there to the junctions, and so give the link its line.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

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
    when: Array  # (H, W) int32 step of arrival, -1 where none arrived
    branch: Array  # (H, W) bool, cells of branches, one thick


def _some(mask: Array) -> Array:
    """Cells (MEETS,) int32 in which a mask (H, W) is True, H W for none."""
    # The first of them by the number of the cell; an exact float32, and half the time of `nonzero`.
    first = -jnp.arange(mask.size, dtype=jnp.float32)
    score, cell = lax.top_k(jnp.where(mask.reshape(-1), first, -jnp.inf), min(MEETS, mask.size))
    return jnp.where(score > -jnp.inf, cell, mask.size).astype(jnp.int32)


def _largest(cells: Array) -> Array:
    """Largest (H, W) of each cell and the eight around it."""
    p = jnp.pad(cells, ((1, 1), (0, 0)), mode="edge")
    cells = jnp.maximum(jnp.maximum(p[:-2], p[2:]), cells)
    p = jnp.pad(cells, ((0, 0), (1, 1)), mode="edge")
    return jnp.maximum(jnp.maximum(p[:, :-2], p[:, 2:]), cells)


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
    branch = branches(diagram, sources)
    thick = (block_union(branch.astype(jnp.uint8)) > 0) & (diagram.labels != 0) & ~sources
    met = expand(seeds, thick | (seeds != 0), steps=LINK_STEPS)
    ids = _Ids(met.labels, met.arrival, branch)

    unseen = (diagram.labels == 0) & ~sources & ~seen_free(scan, lidar, grid)
    wide = diagram.arrival > round(spec.least / grid.cell)  # steps, no fewer than cells to a wall
    reach = round(TWIN / grid.cell)
    some = [_meets(ids, place, grid, bit, reach), _ends(ids, unseen, wide, bit, reach)]
    pair, cell, good = (jnp.concatenate(x) for x in zip(*some, strict=True))
    line, length, clearance = jax.vmap(_measure, in_axes=(0, 0, None, None, None, None, None))(
        pair, cell, ids, bit, place, grid, jnp.where(scan.hit[:, None], points(scan, lidar), 1e3)
    )
    shape = jnp.append(found.shape[: spec.nodes], jnp.inf)
    clearance = jnp.minimum(clearance, jnp.min(shape[pair], axis=1))
    good &= (pair[:, 1] >= 0) | (clearance > spec.least)
    good &= ~repeated(pair, line, good)
    return Links(pair=pair, line=line, length=length, clearance=clearance, valid=good)


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


def _meets(
    ids: _Ids, place: Array, grid: GridSpec, bit: Array, reach: int
) -> tuple[Array, Array, Array]:
    """Where two ids meet: their pair (LINKS, 2), a cell (LINKS,), and whether there is one.

    Each pair may meet twice, in places that are far from each other.
    """
    # An even meet: one id here, another next door.
    beside = jnp.zeros_like(ids.own)
    for other in around(single(ids.own)):
        beside |= other
    both = ids.own | jnp.where(single(ids.own) != 0, beside, jnp.zeros_like(beside))
    # Few cells hold two: all that follows is done on these.
    where = _some((both & (both - 1)) != 0)
    take = lambda x, fill: x.reshape(-1).at[where].get(mode="fill", fill_value=fill)
    off_branch = jnp.where(take(ids.branch, False), 0.0, 2.5).astype(place.dtype)
    early = -take(ids.when, 0).astype(place.dtype) - off_branch
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


def _ends(
    ids: _Ids, unseen: Array, wide: Array, bit: Array, reach: int
) -> tuple[Array, Array, Array]:
    """Where branches leave the view: pairs (FRONTIERS, 2) of id and -1, cells, and whether.

    Such an end is farther from its junction than the cells around it, and next to unseen ones.
    """
    own = single(ids.own)
    around_it = block_union(block_union(ids.own))
    edge = block_union(block_union(jnp.pad(unseen, 1, constant_values=True).astype(jnp.uint8)))
    far = jnp.where(ids.when >= 0, 2 * ids.when + ids.branch.astype(jnp.int32), -1)
    far = far.astype(jnp.int16)
    farthest = far
    for _ in range(3):
        farthest = _largest(farthest)
    end = (own != 0) & (around_it == own) & (ids.when > 0) & (far == farthest)
    end &= (edge[1:-1, 1:-1] > 0) & wide
    where = _some(end)
    score = far.reshape(-1).at[where].get(mode="fill", fill_value=-1).astype(float)
    score = jnp.where(where < far.size, score, -jnp.inf)
    cell, valid = _top(score, where, FRONTIERS, reach, far.shape[1])
    node = jnp.argmax(own.reshape(-1)[cell][:, None] == bit[None, :-1], axis=1).astype(jnp.int32)
    return jnp.stack([node, jnp.full_like(node, -1)], axis=1), cell, valid


def _back(cell: Array, own: Array, ids: _Ids) -> tuple[Array, Array]:
    """Cells (S,) from `cell` back to where the id with the bit `own` came from, and if it moved.

    Each step goes to a cell that the id reached earlier: on the branch where one is.
    """
    w = ids.when.shape[1] + 2  # a ring of cells around
    own_at = jnp.pad(ids.own, 1).reshape(-1)
    when = jnp.pad(ids.when, 1, constant_values=-1).reshape(-1)
    price = when * 2 - 5 * jnp.pad(ids.branch, 1).reshape(-1).astype(jnp.int32)
    beside = jnp.array([-w - 1, -w, -w + 1, -1, 1, w - 1, w, w + 1], jnp.int32)

    def step(now: tuple[Array, Array], _: None):
        at, limit = now
        near = at + beside
        good = (own_at[near] == own) & (when[near] < limit)
        best = near[jnp.argmin(jnp.where(good, price[near], jnp.iinfo(jnp.int32).max))]
        moved = jnp.any(good)
        at = jnp.where(moved, best, at)
        return (at, jnp.where(moved, when[at], limit)), (at, moved)

    start = (cell // (w - 2) + 1) * w + cell % (w - 2) + 1
    # The first step may go to a cell that was reached as early: an even meet.
    _, (at, moved) = lax.scan(step, (start, when[start] + 1), length=LINK_STEPS)
    return (at // w - 1) * (w - 2) + at % w - 1, moved


def _measure(
    pair: Array, cell: Array, ids: _Ids, bit: Array, place: Array, grid: GridSpec, hits: Array
) -> tuple[Array, Array, Array]:
    """Line (K, 2), length and clearance of the link of a `pair` (2,) that met in a `cell`."""
    at = lambda flat: centre_of(
        jnp.stack([flat // grid.shape[1], flat % grid.shape[1]], axis=-1), grid
    ).astype(place.dtype)
    middle = at(cell)
    sides = []
    for end in (pair[0], pair[1]):
        # The last bit is nobody's: from a frontier, nothing leads back to a second end.
        cells, moved = _back(cell, bit[jnp.where(end < 0, len(bit) - 1, end)], ids)
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
