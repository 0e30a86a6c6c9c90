"""A topological map as a graph of the points of its arcs, which a route may enter anywhere."""

from typing import NamedTuple

import numpy as np

from jaxslam.core import polylines
from jaxslam.core.maps import TopologicalMap
from jaxslam.mapping.clearance import ClearanceField, widest_near

SPACING = 0.1  # [m] between two points of an arc, at most


class ArcPoints(NamedTuple):
    """Points of arcs, and the edges between points that follow each other.

    Attributes:
        xy: (P, 2) [m] map frame; first the N nodes, then the points of the arcs between them.
        edges: (E, 2) int indices of two points, in the direction of the arc's polyline.
        length: (E,) [m].
        width: (E,) [m] largest radius of a robot that passes; NaN where it is not known.
        arc: (E,) int index of the arc.
        directed: (E,) bool, driven in the direction of the polyline alone.
    """

    xy: np.ndarray
    edges: np.ndarray
    length: np.ndarray
    width: np.ndarray
    arc: np.ndarray
    directed: np.ndarray

    def passable(self, robot_radius: float) -> np.ndarray:
        """Edges (E,) bool wide enough for a robot; at radius 0 all, also those not known."""
        return (robot_radius <= 0.0) | (self.width >= robot_radius)


def arc_points(
    graph: TopologicalMap, field: ClearanceField | None = None, directed: np.ndarray | None = None
) -> ArcPoints:
    """The points of all arcs of a map.

    Args:
        graph: The map.
        field: Distances to obstacles; without it, and beyond it, the width is `arc_clearance`.
        directed: (A,) bool arcs driven in the direction of their polylines alone.
    """
    count = len(graph.arc_lines)
    # At least two points between the ends: so no two arcs share an edge, whatever they join.
    dense = [polylines.refine(line, SPACING, 3) for line in graph.arc_lines]
    inner = [len(line) - 2 for line in dense]
    xy = np.concatenate([graph.xy, *(line[1:-1] for line in dense)])
    first = len(graph.xy) + np.append(0, np.cumsum(inner, dtype=int))[:-1]
    chains = [
        np.concatenate([[a], np.arange(start, start + k), [b]])
        for (a, b), start, k in zip(graph.arc_ends, first, inner, strict=False)
    ]
    empty = np.zeros((0, 2), int)
    edges = np.concatenate([empty, *(np.column_stack([c[:-1], c[1:]]) for c in chains)])
    arc = np.repeat(np.arange(count), [len(chain) - 1 for chain in chains])
    width = graph.arc_clearance[arc]
    if field is not None:
        here = widest_near(field, xy)[edges].min(axis=1)
        width = np.where(np.isnan(here), width, here)
    return ArcPoints(
        xy=xy,
        edges=edges,
        length=np.hypot(*(xy[edges[:, 1]] - xy[edges[:, 0]]).T),
        width=width,
        arc=arc,
        directed=(np.zeros(count, bool) if directed is None else directed)[arc],
    )
