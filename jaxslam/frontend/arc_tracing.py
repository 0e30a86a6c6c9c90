"""Arcs traced back from where two ids meet to their junctions, smoothed and measured."""

import jax.numpy as jnp
from jax import lax

from jaxslam.core.polylines import resample
from jaxslam.core.types import Array
from jaxslam.frontend.grid import GridSpec, centre_of
from jaxslam.frontend.id_propagation import MAX_ARC_STEPS, PropagatedIds

POLYLINE_POINTS = 9  # points K of a polyline
POLYLINE_SUBSAMPLES = 4  # pieces, per piece of the polyline, with which an arc is measured
SMOOTHING_PASSES = 4  # passes of smoothing over the staircase of cells
BRANCH_BONUS = 5  # by which a cell on a branch is preferred in `trace_back`, in half steps


_Trace = tuple[Array, Array, Array, Array, Array]
"""Number of steps, cell and limit (P, 2) of each, and cells and moves so far (S, P, 2)."""


def trace_back(pair: Array, cell: Array, ids: PropagatedIds, bit: Array) -> tuple[Array, Array]:
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
        Flat index (P, 2, `MAX_ARC_STEPS`) of the cells, without the first, and whether (of the same
        shape) each is a step; False after the last one.
    """
    width = ids.packed.shape[1] + 2
    ids_at = jnp.pad(ids.ids, 1).reshape(-1)
    packed_at = jnp.pad(ids.packed, 1, constant_values=-1).reshape(-1)
    offsets = [-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1]
    neighbours = jnp.array(offsets, jnp.int32)
    own = bit[jnp.where(pair < 0, len(bit) - 1, pair)][..., None]  # (P, 2, 1)

    def step(now: _Trace) -> _Trace:
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

    def unfinished(now: _Trace) -> Array:
        k, _, _, _, moved = now
        return (k < MAX_ARC_STEPS) & ((k == 0) | jnp.any(moved[k - 1]))

    start = (cell // (width - 2) + 1) * width + cell % (width - 2) + 1  # in the padded grid
    start = jnp.broadcast_to(start[:, None], pair.shape)
    begin = jnp.int32(0), start, packed_at[start] // 2 + 1
    blank = jnp.zeros((MAX_ARC_STEPS, *pair.shape), jnp.int32)
    _, _, _, cells, moved = lax.while_loop(unfinished, step, (*begin, blank, blank.astype(bool)))
    cells, moved = (jnp.moveaxis(x, 0, -1) for x in (cells, moved))
    return (cells // width - 1) * (width - 2) + cells % width - 1, moved


def measure_arc(
    pair: Array,
    cell: Array,
    back: tuple[Array, Array],
    xy: Array,
    grid: GridSpec,
    hits: Array,
) -> tuple[Array, Array, Array]:
    """Polyline, length and clearance of one arc or frontier.

    The polyline runs from the first junction through the cells traced back from the meeting cell,
    in reverse, through that cell, and through the cells of the other side to the second junction.
    Unused steps repeat the junction, so the number of points is static. The inner points are
    smoothed by (1, 2, 1) / 4; the polyline of a frontier ends at its cell.

    Args:
        pair: (2,) int32 junctions; the second is -1 for a frontier.
        cell: () int32 flat index of the cell in which the ids met.
        back: Cells (2, S) and whether each is a step, (2, S), as of `trace_back`.
        xy: (N, 2) [m] of the junctions.
        grid: The grid.
        hits: (R, 2) [m] ends of the beams, robot frame.

    Returns:
        Points (K, 2) [m], length and clearance [m].
    """

    def centre(flat: Array) -> Array:
        index = jnp.stack([flat // grid.shape[1], flat % grid.shape[1]], axis=-1)
        return centre_of(grid, index).astype(xy.dtype)

    middle = centre(cell)
    sides = []
    for end, cells, moved in zip(pair, *back, strict=True):
        junction = jnp.where(end < 0, middle, xy[end])
        side = jnp.where(moved[:, None], centre(cells), junction[None])
        sides.append((jnp.concatenate([side, junction[None]]), jnp.append(~moved, True)))
    (first, first_fixed), (second, second_fixed) = sides
    polyline = jnp.concatenate([first[::-1], middle[None], second])
    fixed = jnp.concatenate([first_fixed[::-1], pair[1:] < 0, second_fixed])
    for _ in range(SMOOTHING_PASSES):
        mean = (polyline[:-2] + 2.0 * polyline[1:-1] + polyline[2:]) / 4.0
        polyline = polyline.at[1:-1].set(jnp.where(fixed[1:-1, None], polyline[1:-1], mean))
    fine = resample(polyline, POLYLINE_SUBSAMPLES * (POLYLINE_POINTS - 1) + 1)
    length = jnp.sum(jnp.linalg.norm(jnp.diff(fine, axis=0), axis=1))
    x, y = (fine[:, None, k] - hits[None, :, k] for k in range(2))
    return fine[::POLYLINE_SUBSAMPLES], length, jnp.sqrt(jnp.min(x * x + y * y))
