"""A graph of polylines in the plane that grows: arcs split, lines added; changed in place."""

from typing import NamedTuple

import numpy as np

from jaxslam.core.polylines import cumulative_lengths, points_along, project

MIN_PIECE = 0.05
"""[m] An arc is not split nearer to its ends than this: its end is taken."""


class Line(NamedTuple):
    """An arc of a `PlaneGraph`.

    Attributes:
        start: Number of its first node.
        end: Number of its last node.
        points: (n >= 2, 2) [m] from the first node to the last.
        is_branch: Whether it is a branch of the Voronoi diagram; else it was filled in.
    """

    start: int
    end: int
    points: np.ndarray
    is_branch: bool


class PlaneGraph:
    """A planar graph, numbered in the order in which they came.

    Attributes:
        xy: Positions (2,) [m] of the nodes.
        arcs: The arcs by number.
    """

    def __init__(self, xy: np.ndarray, arcs: list[Line]) -> None:
        """A graph of nodes (N, 2) [m] and arcs between them."""
        self.xy = list(np.asarray(xy, float).reshape(-1, 2))
        self.arcs: dict[int, Line] = {}
        self._boxes: dict[int, tuple[float, float, float, float]] = {}
        self._next = 0
        for line in arcs:
            self.add_arc(line)

    def add_node(self, xy: np.ndarray) -> int:
        """Number of a new node at (2,) [m]."""
        self.xy.append(np.asarray(xy, float))
        return len(self.xy) - 1

    def add_arc(self, line: Line) -> int:
        """Number of a new arc; its polyline is made to begin and end at its nodes."""
        self._put(self._next, line)
        self._next += 1
        return self._next - 1

    def split(self, arc: int, along: float, xy: np.ndarray | None = None) -> int:
        """Node on an arc, which is split there; one of its ends if that is nearer than `MIN_PIECE`.

        Args:
            arc: Its number; its two pieces get new ones.
            along: [m] from its first node.
            xy: (2,) [m] of the new node; None for the point on the arc.
        """
        line = self.arcs[arc]
        at_point = cumulative_lengths(line.points)
        if along < MIN_PIECE or along > at_point[-1] - MIN_PIECE:
            return line.start if 2 * along < at_point[-1] else line.end
        here = points_along(line.points, np.array([along]))[0]
        node = self.add_node(here if xy is None else xy)
        first, last = at_point < along - 1e-9, at_point > along + 1e-9
        del self.arcs[arc], self._boxes[arc]
        self.add_arc(line._replace(end=node, points=np.vstack([line.points[first], here])))
        self.add_arc(line._replace(start=node, points=np.vstack([here, line.points[last]])))
        return node

    def degrees(self) -> np.ndarray:
        """Number of arc ends (N,) at each node."""
        ends = [node for line in self.arcs.values() for node in (line.start, line.end)]
        return np.bincount(np.array(ends, int), minlength=len(self.xy))

    def move(self, node: int, xy: np.ndarray) -> None:
        """Move a node to (2,) [m], and the ends of its arcs with it."""
        self.xy[node] = np.asarray(xy, float)
        for arc, line in self.arcs.items():
            if node in (line.start, line.end):
                self._put(arc, line)

    def _put(self, arc: int, line: Line) -> None:
        """Write an arc, its ends at its nodes."""
        points = np.concatenate([[self.xy[line.start]], line.points[1:-1], [self.xy[line.end]]])
        self.arcs[arc] = line._replace(points=points)
        self._boxes[arc] = (*points.min(axis=0).tolist(), *points.max(axis=0).tolist())

    def nearest(self, point: np.ndarray, radius: float = np.inf) -> tuple[int, float, float]:
        """The arc nearest to a point (2,) [m].

        Returns:
            Its number, the distance [m], and how far along the arc [m]; -1 and infinity without an
            arc within `radius` [m].
        """
        best = -1, np.inf, 0.0
        x, y = point.tolist()
        for arc, (left, low, right, high) in self._boxes.items():
            aside = max(left - x, x - right, low - y, y - high)
            if aside < min(best[1], radius):
                distance, along = project(point[None], self.arcs[arc].points)
                if distance[0] < min(best[1], radius):
                    best = arc, float(distance[0]), float(along[0])
        return best

    def node_on(self, point: np.ndarray) -> int:
        """Node at the point of the arcs nearest to (2,) [m]; an arc is split for it if need be."""
        arc, _, along = self.nearest(point)
        return self.split(arc, along)

    def add_segment(self, first: np.ndarray, last: np.ndarray) -> None:
        """Add a straight line between two points (2,) [m] on arcs, with a node where it crosses.

              |                     |
        o-----+-----o         o-----o-----o       + crosses: both are split
              |                     |
        """
        nodes = [self.node_on(first), self.node_on(last)]
        start, end = (self.xy[node] for node in nodes)
        crossings = [0.0, 1.0]
        lower, upper = np.minimum(start, end).tolist(), np.maximum(start, end).tolist()
        beside = [
            k
            for k, (left, low, right, high) in self._boxes.items()
            if left <= upper[0] and right >= lower[0] and low <= upper[1] and high >= lower[1]
        ]
        for arc in beside:
            line = self.arcs[arc]
            share, along = _crossings(start, end, line.points)
            # From the far end, as each split leaves the part before it.
            for s, at in sorted(zip(share, along, strict=True), key=lambda pair: -pair[1]):
                before = self._next
                node = self.split(arc, float(at))
                if node not in nodes:
                    nodes.append(node)
                    crossings.append(float(s))
                if self._next > before:
                    arc = before  # the piece from its first node to here
        order = np.argsort(crossings, kind="stable")
        chain = [nodes[k] for k in order]
        for a, b in zip(chain, chain[1:], strict=False):
            pair = {a, b}
            known = any({x.start, x.end} == pair and not x.is_branch for x in self.arcs.values())
            if a != b and not known:
                self.add_arc(Line(a, b, np.array([self.xy[a], self.xy[b]]), False))


def _crossings(
    start: np.ndarray, end: np.ndarray, line: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where a straight line crosses a polyline (n, 2), away from its own ends.

    Returns:
        Share (C,) of the straight line before each crossing, and length (C,) [m] of the polyline.
    """
    step, edge = end - start, np.diff(line, axis=0)
    offset = line[:-1] - start
    cross = step[0] * edge[:, 1] - step[1] * edge[:, 0]
    safe = np.where(np.abs(cross) > 1e-12, cross, np.inf)
    share = (offset[:, 0] * edge[:, 1] - offset[:, 1] * edge[:, 0]) / safe
    part = (offset[:, 0] * step[1] - offset[:, 1] * step[0]) / safe
    margin = MIN_PIECE / max(float(np.hypot(*step)), MIN_PIECE)
    hit = (np.isfinite(safe)) & (share > margin) & (share < 1 - margin) & (part >= 0) & (part < 1)
    before = cumulative_lengths(line)[:-1]
    return share[hit], (before + part * np.hypot(*edge.T))[hit]
