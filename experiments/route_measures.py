"""How good a graph is for going places: is it whole, free, near, and how far does it lead around.

The occupancy map decides. Between two places the graph route leads through free space to the
nearest point of the graph, along it, and through free space to the goal; its length is compared
with that of the shortest path over the free cells.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from experiments.common import Numbers
from experiments.roadmaps import Chains, Ground, Roadmap, grid_graph, without_repeats

NEAR = 3.0  # [m] of free path to the graph, for a place from which it is reached
COVERED = 2.0  # [m] of free path to the graph, for space that it covers
MIN_APART = 3.0  # [m] of free path between two places, for a detour
STARTS = 40  # different places from which routes begin


class Places(NamedTuple):
    """Places between which routes are wanted.

    Attributes:
        xy: (K, 2) [m] map frame.
        pairs: (M, 2) int indices of start and goal.
    """

    xy: np.ndarray
    pairs: np.ndarray


def choose_places(
    rng: np.random.Generator, candidates: np.ndarray, num_pairs: int, num_places: int = 200
) -> Places:
    """Random places among candidates (C, 2) [m], and pairs of them from `STARTS` of them."""
    chosen = rng.choice(len(candidates), min(num_places, len(candidates)), replace=False)
    starts = rng.integers(min(STARTS, len(chosen)), size=num_pairs)
    return Places(
        candidates[chosen], np.column_stack([starts, rng.integers(len(chosen), size=num_pairs)])
    )


def free_places(rng: np.random.Generator, ground: Ground, num_pairs: int) -> Places:
    """Random places in the largest region where the robot fits."""
    region, _ = ndimage.label(ground.fits, np.ones((3, 3)))
    size = np.bincount(region.ravel())
    size[0] = 0
    return choose_places(rng, ground.points(np.argwhere(region == size.argmax())), num_pairs)


class ShortestPaths(NamedTuple):
    """The shortest paths over the free cells, with which routes over a graph are compared.

    Attributes:
        ground: The free space.
        number: (H, W) int of each cell where the robot fits, -1 elsewhere.
        grid: (C, C) [m] adjacency of these cells.
        nearest: (2, H, W) int the cell where the robot fits that is nearest to each.
        places: (K,) int cells of the places.
        pairs: (M, 2) int start and goal among the places, ordered by start.
        direct: (M,) [m] shortest path between them; infinite where there is none.
    """

    ground: Ground
    number: np.ndarray
    grid: sparse.csr_array
    nearest: np.ndarray
    places: np.ndarray
    pairs: np.ndarray
    direct: np.ndarray

    def cells(self, points: np.ndarray) -> np.ndarray:
        """Number (P,) of the cell where the robot fits that is nearest to points (P, 2) [m]."""
        return self.number[tuple(self.nearest[:, *self.ground.cells(points)[0].T])]


def shortest_paths(ground: Ground, places: Places) -> ShortestPaths:
    """The shortest paths between some places."""
    number, grid = grid_graph(ground.fits, ground.resolution)
    nearest = ndimage.distance_transform_edt(~ground.fits, return_indices=True)[1]
    pairs = places.pairs[np.argsort(places.pairs[:, 0], kind="stable")]
    new = ShortestPaths(ground, number, grid, nearest, np.zeros(0, int), pairs, np.zeros(0))
    at, direct = new.cells(places.xy), []
    for start in np.unique(pairs[:, 0]).tolist():
        away = csgraph.dijkstra(grid, directed=False, indices=at[start])
        direct.append(away[at[pairs[pairs[:, 0] == start, 1]]])
    return new._replace(places=at, direct=np.concatenate(direct))


def measure(by: ShortestPaths, roadmap: Roadmap) -> Numbers:
    """Structure of a graph, how much of its arcs is blocked, and routes between places.

    Returns:
        Numbers by name. `parts`: components with arcs. `lonely`: nodes without arcs, open ends
        apart. `blocked`: share of the length of arcs that is in obstacles or unknown space.
        `reach`: share of the places from which the largest part is within `NEAR` of free path.
        `covered`: share of the cells where the robot fits that have the largest part within
        `COVERED` of free path, of its region. `routed`: share of the pairs further apart than
        `MIN_APART` that the graph joins; `detour`: length of their routes by that of the shortest
        path.
    """
    roadmap = without_repeats(roadmap)
    chains = Chains.of_roadmap(roadmap)
    matrix = chains.matrix()
    part = csgraph.connected_components(matrix, directed=False)[1]
    with_arcs = np.unique(roadmap.ends)
    sizes = np.bincount(part[with_arcs], minlength=part.max(initial=0) + 1)
    free = by.ground.at(by.ground.known_free, chains.middles())
    total = float(chains.length.sum())
    lonely = ~np.isin(np.arange(len(roadmap.xy)), with_arcs) & ~roadmap.is_open
    structure: Numbers = {
        "nodes": len(roadmap.xy),
        "arcs": len(roadmap.lines),
        "parts": int(np.count_nonzero(sizes)),
        "lonely": int(lonely.sum()),
        "length_m": total,
        "blocked": float(chains.length[~free].sum()) / max(total, 1e-9),
    }
    if not len(chains.edges):
        return structure | {"reach": 0.0, "covered": 0.0, "routed": 0.0} | _detours(np.zeros(0))
    return structure | _routes(by, chains, matrix, np.flatnonzero(part == sizes.argmax()))


def _routes(
    by: ShortestPaths, chains: Chains, matrix: sparse.csr_array, largest: np.ndarray
) -> Numbers:
    """The numbers of `measure` that need paths; `largest` holds the points of the largest part."""
    sources, first = np.unique(by.cells(chains.xy[largest]), return_index=True)
    to_graph, _, source = csgraph.dijkstra(
        by.grid,
        directed=False,
        indices=sources,
        min_only=True,
        limit=NEAR,
        return_predecessors=True,
    )
    entry_at = np.full(by.grid.shape[0], -1)
    entry_at[sources] = largest[first]
    reached = np.isfinite(to_graph[by.places])
    entry = np.where(reached, entry_at[np.maximum(source[by.places], 0)], -1)
    to_graph_of = to_graph[by.places]
    region = csgraph.connected_components(by.grid, directed=False)[1]
    wanted = np.isfinite(by.direct) & (by.direct >= MIN_APART)
    possible = wanted & reached[by.pairs].all(axis=1)
    starts, goals = by.pairs[possible].T
    entries, back = np.unique(entry[starts], return_inverse=True)
    along = csgraph.dijkstra(matrix, directed=False, indices=entries)[back, entry[goals]]
    route = to_graph_of[starts] + along + to_graph_of[goals]
    joined = np.isfinite(route)
    return {
        "reach": float(reached.mean()),
        "covered": float((to_graph <= COVERED)[np.isin(region, region[sources])].mean()),
        "routed": float(joined.sum() / max(wanted.sum(), 1)),
        "pairs": int(wanted.sum()),
        **_detours(route[joined] / by.direct[possible][joined]),
    }


def _detours(ratios: np.ndarray) -> Numbers:
    some = len(ratios) > 0
    return {
        "detour_median": float(np.median(ratios)) if some else None,
        "detour_p90": float(np.percentile(ratios, 90)) if some else None,
    }
