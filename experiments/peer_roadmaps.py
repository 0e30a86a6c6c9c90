"""Graphs of an occupancy map as others make them: of the same cells where the robot fits.

`thinning` is scikit-image's skeleton, traced by sknw, with short dead ends pruned. `brushfire` is
the generalised Voronoi diagram: waves start at all obstacles, each cell keeps the obstacle whose
wave came first, and cells where waves of obstacles meet that are further apart than the robot is
wide belong to the diagram; its cells are thinned and traced likewise.

References:
    Lau, Sprunk, Burgard (2013), Efficient grid-based spatial representations for robot navigation
    in dynamic environments.
"""

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from experiments import thinning
from experiments.roadmaps import Ground, Roadmap

Peer = Callable[[Ground, float], Roadmap]


def largest_region(ground: Ground) -> np.ndarray:
    """Cells (H, W) bool of the largest region where the robot fits."""
    region, _ = ndimage.label(ground.fits, np.ones((3, 3)))
    size = np.bincount(region.ravel())
    size[0] = 0
    return region == size.argmax()


def wave_fronts(cells: np.ndarray, apart: float) -> np.ndarray:
    """Cells (H, W) bool where waves from what is not in `cells` meet.

    Args:
        cells: (H, W) bool, free.
        apart: [cells] between the sources of two waves, at least; else they are of one obstacle.
    """
    away, source = ndimage.distance_transform_edt(np.pad(cells, 1), return_indices=True)
    meets = np.zeros(away.shape, bool)
    for low, high in (np.s_[:-1, :], np.s_[1:, :]), (np.s_[:, :-1], np.s_[:, 1:]):
        gap = np.hypot(*(source[:, *low] - source[:, *high]))
        front = gap > apart
        farther = away[low] >= away[high]
        meets[low] |= front & farther
        meets[high] |= front & ~farther
    return meets[1:-1, 1:-1] & cells


def of_thin_graph(ground: Ground, cells: np.ndarray) -> Roadmap:
    """The roadmap that sknw traces in thinned cells (H, W) bool."""
    graph, _ = thinning.pruned_graph(cells)
    names = {node: k for k, node in enumerate(graph.nodes)}
    centre = np.array([graph.nodes[node]["o"] for node in graph.nodes], float).reshape(-1, 2)
    ends, lines = [], []
    for a, b, arc in graph.edges(data=True):
        inner = np.asarray(arc["pts"], float)
        first, last = centre[names[a]], centre[names[b]]
        if np.hypot(*(inner[0] - first)) > np.hypot(*(inner[-1] - first)):
            inner = inner[::-1]
        ends.append((names[a], names[b]))
        lines.append(ground.points(np.vstack([first, inner, last])))
    is_open = np.zeros(len(centre), bool)
    return Roadmap(ground.points(centre), np.array(ends, int).reshape(-1, 2), tuple(lines), is_open)


def thinned(ground: Ground, robot_radius: float) -> Roadmap:
    """The skeleton of the largest region where the robot fits."""
    return of_thin_graph(ground, largest_region(ground))


def brushfire(ground: Ground, robot_radius: float) -> Roadmap:
    """The generalised Voronoi diagram of known free space, where the robot fits."""
    fronts = wave_fronts(ground.known_free, 2 * robot_radius / ground.resolution)
    return of_thin_graph(ground, fronts & largest_region(ground))


PEERS: dict[str, Peer] = {"thinning": thinned, "brushfire": brushfire}


def available() -> dict[str, Peer]:
    """The peers whose packages are installed; the others are named in one line."""
    missing = thinning.missing()
    if missing:
        print(f"left out: {', '.join(PEERS)}, for want of {', '.join(missing)}")
    return {} if missing else PEERS
