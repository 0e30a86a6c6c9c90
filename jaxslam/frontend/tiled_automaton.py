"""The Voronoi automaton on a large map, tile by tile.

A front advances one cell per step, so `HALO` steps of a tile depend on nothing further away than
`HALO` cells. Each round advances all tiles that may still change by `HALO` steps, each with a halo
of that width. Then the tiles exchange their new cells:

    +--------------------+     window of (tile + 2 halo)^2 cells: what one tile reads
    |  halo              |
    |    +----------+    |
    |    |   tile   |    |     only these cells are written back after the round
    |    +----------+    |
    |                    |
    +--------------------+

The result equals that of `automaton.expand`, cell for cell, without a pass over the whole map for
every step.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.arguments import as_bool
from jaxslam.core.types import AnyArray, Array
from jaxslam.frontend.automaton import Diagram, as_labels, expand

TILE = 64  # [cells] side of a tile
HALO = 16  # [cells] width of the halo, and number of steps in a round
TILE_BATCH = 16  # tiles that are expanded together


@partial(jax.jit, static_argnames="steps")
def _expand_windows(labels: Array, is_free: Array, *, steps: int) -> Diagram:
    """`automaton.expand` of a batch of windows (B, H, W)."""
    return jax.vmap(partial(expand, steps=steps))(labels, is_free)


def expand_tiled(
    labels: AnyArray,
    free: AnyArray,
    *,
    steps: int | None = None,
    tile: int = TILE,
    halo: int = HALO,
) -> Diagram:
    """Expand all sources of a map together, as `automaton.expand` does.

    For maps in files: the rounds are counted in Python, so it can be neither jitted nor batched.

    Args:
        labels: (H, W) bit sets as for `automaton.expand`; non-zero cells are the sources.
        free: (H, W) bool, the cells that fronts may enter.
        steps: Number of steps; None: until nothing changes any more.
        tile: Side of a tile [cells].
        halo: Width [cells] of the halo around a tile, at most `tile`; as many steps make a round.

    Raises:
        ValueError: An array has another shape or type, `halo` is not from 1 to `tile`, or `steps`
            is negative.
    """
    sources = np.asarray(as_labels("labels", labels))
    is_free = np.asarray(as_bool("free", free, sources.shape))
    if not 1 <= halo <= tile:
        raise ValueError(f"halo {halo} is not between 1 and the tile's {tile} cells")
    if steps is not None and steps < 0:
        raise ValueError(f"steps is {steps}, not 0 or more")
    height, width = sources.shape
    rows, columns = -(-height // tile), -(-width // tile)
    # Whole tiles and a halo around them; the padding is not free.
    margins = ((halo, halo + rows * tile - height), (halo, halo + columns * tile - width))
    cells, is_free = np.pad(sources, margins), np.pad(is_free, margins)
    arrival = np.where(cells != 0, 0, -1).astype(np.int32)
    all_tiles = np.s_[halo : halo + rows * tile, halo : halo + columns * tile]
    empty = (is_free & (cells == 0))[all_tiles].reshape(rows, tile, columns, tile)
    has_empty = empty.any(axis=(1, 3))
    changed, done = np.ones((rows, columns), bool), 0
    while changed.any() and (steps is None or done < steps):
        steps_left = halo if steps is None else min(halo, steps - done)
        active = np.argwhere(_dilate(changed) & has_empty)
        changed, results = np.zeros_like(changed), _advance(cells, is_free, active, tile, halo)
        for index, tile_labels, step in results:
            i, j = index * tile + halo
            window = np.s_[i : i + tile, j : j + tile]
            new = (step > 0) & (step <= steps_left)
            cells[window] = np.where(new, tile_labels, cells[window])
            arrival[window] = np.where(new, done + step, arrival[window])
            changed[tuple(index)] = new.any()
            has_empty[tuple(index)] = (is_free[window] & (cells[window] == 0)).any()
        done += steps_left
    inner = np.s_[halo : halo + height, halo : halo + width]
    return Diagram(labels=jnp.asarray(cells[inner]), arrival=jnp.asarray(arrival[inner]))


def _advance(
    cells: np.ndarray, is_free: np.ndarray, active: np.ndarray, tile: int, halo: int
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Advance tiles by one round of `halo` steps.

    Nothing is written to `cells`: each tile starts from what the others were before the round.

    Args:
        cells: Labels of the padded map.
        is_free: Its free cells.
        active: (A, 2) index of each tile to advance.
        tile: Side of a tile [cells].
        halo: Width of the halo [cells].

    Returns:
        Of each tile its index (2,), and labels and step of arrival in this round (tile, tile).
    """
    side = tile + 2 * halo
    results: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    inner = np.s_[:, halo : halo + tile, halo : halo + tile]
    for first in range(0, len(active), TILE_BATCH):
        batch = active[first : first + TILE_BATCH]
        # Always TILE_BATCH of them, so that there is one compiled program.
        corners = np.resize(batch, (TILE_BATCH, 2)) * tile
        diagram = _expand_windows(
            np.stack([cells[i : i + side, j : j + side] for i, j in corners]),
            np.stack([is_free[i : i + side, j : j + side] for i, j in corners]),
            steps=halo,
        )
        results += zip(batch, *(np.asarray(x)[inner] for x in diagram), strict=False)
    return results


def _dilate(tiles: np.ndarray) -> np.ndarray:
    """The tiles (rows, columns) bool that are set or have one that is set around them."""
    padded = np.pad(tiles, 1)
    rows = padded[:-2] | padded[1:-1] | padded[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
