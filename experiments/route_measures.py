"""How good a graph is for going places: is it whole, free, near, and how far does it lead around.

The judge is the occupancy map. Between two places the graph route leads through free space to the
nearest point of the graph, along it, and through free space to the goal; its length is compared
with that of the shortest path over the free cells.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage
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
    return Places(candidates[chosen], np.column_stack([starts, rng.integers(len(chosen), size=num_pairs)]))


def free_places(rng: np.random.Generator, ground: Ground, num_pairs: int) -> Places:
    """Random places in the largest region where the robot fits."""
    region, _ = ndimage.label(ground.fits, np.ones((3, 3)))
    size = np.bincount(region.ravel())
    size[0] = 0
    return choose_places(rng, ground.points(np.argwhere(region == size.argmax())), num_pairs)


def measure(ground: Ground, roadmap: Roadmap, places: Places) -> Numbers:
    """Structure of a graph, how much of its arcs is blocked, and routes between places.

    Returns:
        Numbers by name. `parts`: components with arcs. `lonely`: nodes without arcs, open ends
        apart. `blocked`: share of the length of arcs that is in obstacles or unknown space.
        `reach`: share of the places from which the largest part is within `NEAR` of free path.
        `covered`: share of the cells where the robot fits that have the largest part within
        `COVERED` of free path, of their region. `routed`: share of the pairs further apart than
        `MIN_APART` that the graph joins; `detour`: length of their routes by that of the shortest
        path.
    """
    roadmap = without_repeats(roadmap)
    chains = Chains.of_roadmap(roadmap)
    matrix = chains.matrix()
    part = csgraph.connected_components(matrix, directed=False)[1]
    with_arcs = np.unique(roadmap.ends)
    sizes = np.bincount(part[with_arcs], minlength=part.max(initial=0) + 1)
    free = ground.at(ground.known_free, chains.middles())
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
    return structure | _routes(ground, chains, matrix, part == sizes.argmax(), places)


def _routes(ground: Ground, chains: Chains, matrix, largest: np.ndarray, places: Places) -> Numbers:
    """The numbers of `measure` that need paths; `largest` (P,) bool is the largest part."""
    number, grid = grid_graph(ground.fits, ground.resolution)
    if not len(chains.edges) or not grid.shape[0]:
        return {"reach": 0.0, "covered": 0.0, "routed": 0.0, **_detours(np.zeros(0))}
    nearest = ndimage.distance_transform_edt(~ground.fits, return_indices=True)[1]

    def cell_of(points: np.ndarray) -> np.ndarray:
        """Number (P,) of the free cell that is nearest to each point."""
        return number[tuple(nearest[:, *ground.cells(points)[0].T])]

    points = np.flatnonzero(largest)
    sources, first = np.unique(cell_of(chains.xy[points]), return_index=True)
    to_graph, _, source = csgraph.dijkstra(
        grid,
        directed=False,
        indices=sources,
        min_only=True,
        limit=NEAR,
        return_predecessors=True,
    )
    entry_at = np.full(grid.shape[0], -1)
    entry_at[sources] = points[first]
    at = cell_of(places.xy)
    entry = np.where(np.isfinite(to_graph[at]), entry_at[source[at]], -1)
    region = csgraph.connected_components(grid, directed=False)[1]
    same = np.isin(region, region[sources])
    ratios, possible = [], 0
    for start in np.unique(places.pairs[:, 0]).tolist():
        goals = places.pairs[places.pairs[:, 0] == start, 1]
        direct = csgraph.dijkstra(grid, directed=False, indices=at[start])[at[goals]]
        wanted = np.isfinite(direct) & (direct >= MIN_APART)
        possible += int(wanted.sum())
        if entry[start] < 0:
            continue
        along = csgraph.dijkstra(matrix, directed=False, indices=entry[start])
        goals, direct = goals[wanted], direct[wanted]
        route = to_graph[at[start]] + along[entry[goals]] + to_graph[at[goals]]
        joined = (entry[goals] >= 0) & np.isfinite(route)
        ratios += (route[joined] / direct[joined]).tolist()
    return {
        "reach": float(np.isfinite(to_graph[at]).mean()),
        "covered": float((to_graph[same] <= COVERED).mean()),
        "routed": len(ratios) / max(possible, 1),
        "pairs": possible,
        **_detours(np.array(ratios)),
    }


def _detours(ratios: np.ndarray) -> Numbers:
    some = len(ratios) > 0
    return {
        "detour_median": float(np.median(ratios)) if some else None,
        "detour_p90": float(np.percentile(ratios, 90)) if some else None,
    }
