"""The automaton on a whole map, tile by tile.

A front advances one cell a step, so `HALO` steps of a tile depend on nothing further than `HALO`
cells around it. Each round takes every tile that may still change, with that halo, `HALO` steps
on; then the tiles see each other's new cells. The result is that of `voronoi.expand`, cell for
cell, without a scan over the whole map for every step.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.types import Array
from jaxslam.voronoi import Diagram
from jaxslam.voronoi import expand as expand_at_once

TILE = 64  # [cells] side of a tile
HALO = 16  # [cells] around it, and steps of a round
BATCH = 16  # tiles worked on together


@partial(jax.jit, static_argnames="steps")
def _expand_tiles(labels: Array, open: Array, *, steps: int) -> Diagram:
    """`voronoi.expand` of a batch of windows [B]."""
    return jax.vmap(lambda own, may: expand_at_once(own, may, steps=steps))(labels, open)


def expand(
    labels: Array, open: Array, *, steps: int | None = None, tile: int = TILE, halo: int = HALO
) -> Diagram:
    """Expand all sources of a map together, as `voronoi.expand` does.

    A tool for maps as they lie on disk: the rounds are counted in Python, so it can be neither
    jitted nor batched.

    Args:
        labels: (H, W) unsigned bit sets as for `voronoi.expand`; non-zero cells are the sources.
        open: (H, W) bool, the cells that fronts may enter.
        steps: Number of steps; without it, until nothing changes any more.
        tile: Side of a tile [cells].
        halo: Cells seen around a tile, at most `tile`; as many steps make a round.

    Raises:
        ValueError: The arrays differ in shape, `halo` is not from 1 to `tile`, or `steps` is
            negative.
    """
    sources, may = np.asarray(labels), np.asarray(open, bool)
    if sources.ndim != 2 or sources.shape != may.shape:
        raise ValueError(f"labels {sources.shape} and open {may.shape} are not both (H, W)")
    if not 1 <= halo <= tile:
        raise ValueError(f"halo {halo} is not between 1 and the tile's {tile} cells")
    if steps is not None and steps < 0:
        raise ValueError(f"{steps} steps are fewer than none")
    height, width = sources.shape
    rows, columns = -(-height // tile), -(-width // tile)
    # Beyond the map all is closed.
    around = ((halo, halo + rows * tile - height), (halo, halo + columns * tile - width))
    cells, may = np.pad(sources, around), np.pad(may, around)
    arrival = np.where(cells != 0, 0, -1).astype(np.int32)
    inner = np.s_[halo : halo + rows * tile, halo : halo + columns * tile]
    empty = (may & (cells == 0))[inner].reshape(rows, tile, columns, tile).any(axis=(1, 3))
    changed, done = np.ones((rows, columns), bool), 0
    while changed.any() and (steps is None or done < steps):
        left = halo if steps is None else min(halo, steps - done)
        active = np.argwhere(_beside(changed) & empty)
        changed, found = np.zeros_like(changed), _advance(cells, may, active, tile, halo)
        for at, labels_of, step in found:
            i, j = at * tile + halo
            place = np.s_[i : i + tile, j : j + tile]
            fresh = (step > 0) & (step <= left)
            cells[place] = np.where(fresh, labels_of, cells[place])
            arrival[place] = np.where(fresh, done + step, arrival[place])
            changed[tuple(at)] = fresh.any()
            empty[tuple(at)] = (may[place] & (cells[place] == 0)).any()
        done += left
    inner = np.s_[halo : halo + height, halo : halo + width]
    return Diagram(labels=jnp.asarray(cells[inner]), arrival=jnp.asarray(arrival[inner]))


def _advance(
    cells: np.ndarray, may: np.ndarray, active: np.ndarray, tile: int, halo: int
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Tiles (A, 2) after a round: index, labels and step of arrival (tile, tile) of each.

    Nothing is written to `cells`: every tile starts from what the others were before the round.
    """
    span, found = tile + 2 * halo, []
    inner = np.s_[:, halo : halo + tile, halo : halo + tile]
    for first in range(0, len(active), BATCH):
        part = active[first : first + BATCH]
        places = np.resize(part, (BATCH, 2)) * tile  # one shape, so one compiled program
        windows = lambda x, at=places: np.stack([x[i : i + span, j : j + span] for i, j in at])
        diagram = _expand_tiles(windows(cells), windows(may), steps=halo)
        found += zip(part, *(np.asarray(x)[inner] for x in diagram), strict=False)
    return found


def _beside(tiles: np.ndarray) -> np.ndarray:
    """The tiles (rows, columns) bool that are set or have one that is set around them."""
    p = np.pad(tiles, 1)
    rows = p[:-2] | p[1:-1] | p[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
