"""Arcs of a topological map as polylines: split, merged, driven, open frontiers; NumPy, host."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxslam.core import polylines
from jaxslam.core.polylines import cumulative_lengths, project, resample
from jaxslam.mapping.routes import find_path

# [m] a drive this close to known arcs follows them; more where clearances are larger
FOLLOW_DISTANCE = 1.0
MAX_DETOUR = 1.5, 0.5  # [-, m] factor and offset by which followed arcs may be longer than a drive
# [m] the end of a frontier this close to an arc, or to another's end, is reached
FRONTIER_TOLERANCE = 0.5
# An arc passes through a node if closer than this fraction of the node-to-end distance.
PASS_FRACTION = 0.7
MIN_ARC_LENGTH = 0.1  # [m] no piece shorter than this is split off


class Arc(NamedTuple):
    """Arc from one node to another, to itself (loop), or to the end of the view (frontier).

    Attributes:
        start: Index of the first node.
        end: Index of the last node, -1 at a frontier.
        polyline: (n >= 2, 2) [m] from the first node to the last, map frame.
        length: [m].
        clearance: [m] smallest distance to an obstacle along the arc, NaN if not known.
        num_seen: Number of observations.
    """

    start: int
    end: int
    polyline: np.ndarray
    length: float
    clearance: float
    num_seen: int


def reverse(arc: Arc) -> Arc:
    """The same arc, from its last node to its first."""
    return arc._replace(start=arc.end, end=arc.start, polyline=arc.polyline[::-1])


def split_at_nodes(arc: Arc, xy: np.ndarray, radius: np.ndarray) -> list[Arc]:
    """Pieces of an arc between the nodes that it passes through.

                    c
        a o---.     o    .---o b             a o---.  c  .---o b
               '--------'             ->            '-o-'
            one arc (a, b)                   two arcs (a, c), (c, b)

    Args:
        arc: An arc or a frontier.
        xy: (N, 2) [m] positions of the nodes.
        radius: (N,) [m] the arc passes through a node if it comes closer than this.

    Returns:
        The pieces in order, each at least `MIN_ARC_LENGTH` long; the arc itself if it is not split.
        The length of the arc is shared in proportion.
    """
    nodes, at_node = _passed_nodes(arc, xy, radius)
    if not nodes.size:
        return [arc]
    at_point, whole = cumulative_lengths(arc.polyline), polylines.length(arc.polyline)
    cuts = [0.0, *at_node, whole]
    names = [arc.start, *map(int, nodes), arc.end]
    corners = [arc.polyline[0], *xy[nodes], arc.polyline[-1]]
    pieces = []
    for k in range(len(cuts) - 1):
        inner = arc.polyline[
            (at_point > cuts[k] + MIN_ARC_LENGTH) & (at_point < cuts[k + 1] - MIN_ARC_LENGTH)
        ]
        line = np.concatenate([corners[k][None], inner, corners[k + 1][None]])
        if polylines.length(line) > MIN_ARC_LENGTH:
            length = polylines.length(line) * arc.length / whole
            pieces.append(
                arc._replace(start=names[k], end=names[k + 1], polyline=line, length=length)
            )
    return pieces


def _passed_nodes(arc: Arc, xy: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inner nodes that an arc passes through, in order, and the lengths (P,) [m] at which it does.

    A node is passed if the arc comes closer to it than its radius and than `PASS_FRACTION` of its
    distance to the ends of the arc: a node beside an end is not on the arc. A node at the open end
    of a frontier is passed too.
    """
    whole, margin = polylines.length(arc.polyline), radius[:, None]
    in_box = (arc.polyline.min(axis=0) - margin < xy) & (xy < arc.polyline.max(axis=0) + margin)
    nodes = np.setdiff1d(np.flatnonzero(in_box.all(axis=1)), (arc.start, arc.end))
    distance, at_node = project(xy[nodes], arc.polyline)
    ends = arc.polyline[[0, -1]] if arc.end >= 0 else arc.polyline[:1]
    to_end = np.min(np.linalg.norm(xy[nodes, None] - ends, axis=2), axis=1)
    passed = (distance < np.minimum(radius[nodes], PASS_FRACTION * to_end)) & (
        at_node > MIN_ARC_LENGTH
    )
    passed &= (at_node < whole - MIN_ARC_LENGTH) | (arc.end < 0)
    order = np.flatnonzero(passed)[np.argsort(at_node[passed], kind="stable")]
    return nodes[order], at_node[order]


def merge_parallel(arcs: Sequence[Arc], max_distance: float) -> list[Arc]:
    """Merge duplicates: arcs with the same ends whose polylines are close to each other.

    Of duplicates the one observed most often is kept, with the smallest clearance and the number
    of observations of all.

    Args:
        arcs: The arcs.
        max_distance: [m] two arcs are duplicates if corresponding points are closer than this.
    """
    merged: list[Arc] = []
    with_ends: dict[tuple[int, int], list[int]] = {}  # indices into `merged`
    for arc in sorted(arcs, key=lambda arc: -arc.num_seen):
        rivals = with_ends.setdefault((min(arc.start, arc.end), max(arc.start, arc.end)), [])
        for k in rivals:
            if _are_duplicates(arc, merged[k], max_distance):
                clearance = float(np.fmin(merged[k].clearance, arc.clearance))
                count = merged[k].num_seen + arc.num_seen
                merged[k] = merged[k]._replace(clearance=clearance, num_seen=count)
                break
        else:
            rivals.append(len(merged))
            merged.append(arc)
    return merged


def _are_duplicates(arc: Arc, other: Arc, max_distance: float) -> bool:
    """Whether two arcs between the same nodes are less than `max_distance` [m] from each other.

    Arcs are compared in the direction in which their ends agree; loops, in both.
    """
    lines = [
        each.polyline
        for each in (arc, reverse(arc))
        if (each.start, each.end) == (other.start, other.end)
    ]
    gaps = [np.linalg.norm(resample(line) - resample(other.polyline), axis=1) for line in lines]
    return any(gap.max() < max_distance for gap in gaps)


def node_at(position: np.ndarray, xy: np.ndarray, clearance: np.ndarray) -> int:
    """Node whose circle contains a position, the nearest where circles overlap; -1 for none.

    Args:
        position: (2,) [m] the position.
        xy: (N, 2) [m] positions of the nodes.
        clearance: (N,) [m] radii of their circles.
    """
    distance = np.linalg.norm(xy - position, axis=1)
    inside = np.where(distance < clearance, distance, np.inf)
    return int(np.argmin(inside)) if np.isfinite(inside).any() else -1


def driven_arcs(xy: np.ndarray, clearance: np.ndarray, poses: np.ndarray) -> list[Arc]:
    """Driven arcs: pieces of the trajectory from node to node, and from a node back to itself.

    The robot is at a node while it is inside its circle (`node_at`). A piece begins at the last
    pose inside one circle and ends at the first pose inside the next.

    Args:
        xy: (N, 2) [m] positions of the nodes.
        clearance: (N,) [m] radii of their circles.
        poses: (T, 3) [m, m, rad] trajectory, map frame; across a row of NaN, no piece.

    Returns:
        The pieces in order, clearance NaN, each `DEFAULT_POINTS` points long.
    """
    positions = np.asarray(poses, float)[:, :2]
    driven, last_node, left_at = [], -1, 0
    for step, position in enumerate(positions):
        if not np.isfinite(position).all():
            last_node = -1
            continue
        node = node_at(position, xy, clearance)
        if node >= 0 and last_node >= 0 and (node != last_node or step > left_at + 1):
            line = np.concatenate([xy[[last_node]], positions[left_at : step + 1], xy[[node]]])
            driven.append(
                Arc(last_node, node, resample(line), float(polylines.length(line)), np.nan, 1)
            )
        if node >= 0:
            last_node, left_at = node, step
    return driven


class _KnownArcs(NamedTuple):
    """Known arcs as arrays, with capacity for those to come; written row by row.

    Attributes:
        pairs: (A, 2) int indices of the two ends.
        lengths: (A,) [m].
        boxes: (A, 4) [m] bounding boxes as `_box` gives them.
    """

    pairs: np.ndarray
    lengths: np.ndarray
    boxes: np.ndarray


def _box(line: np.ndarray) -> np.ndarray:
    """Bounding box (4,) [m] of a polyline: x_min, y_min, -x_max, -y_max.

    With these signs box A lies within box B, grown by r on all sides, if all of A >= B - r.
    """
    return np.concatenate([line.min(axis=0), -line.max(axis=0)])


def _write_row(table: _KnownArcs, row: int, arc: Arc) -> None:
    """Write an arc to a row of the table, in place."""
    table.pairs[row], table.lengths[row] = (arc.start, arc.end), arc.length
    table.boxes[row] = _box(arc.polyline)


def add_driven_arcs(
    known: Sequence[Arc], driven: Sequence[Arc], clearance: np.ndarray, min_distance: float
) -> list[Arc]:
    """Known arcs, and those driven arcs that follow none of them.

    A driven arc follows known arcs if these lead from its first node to its last, are about as
    short, and run beside it. A driven loop is an arc if it went around something and no known loop
    runs beside it.

             .----- known -----.
          a o                   o b       follows: beside the known arc, nothing is added
             '.... driven ....'

             .----- known -----.
          a o     ( pillar )    o b       does not follow: a second arc between a and b
             '.               .'
               '.. driven ..'

    Args:
        known: Observed arcs.
        driven: Driven arcs, as of `driven_arcs`.
        clearance: (N,) [m] of the nodes.
        min_distance: [m] a loop went around something if its outward and return parts are somewhere
            more than twice this from each other.
    """
    known, capacity = list(known), len(known) + len(driven)
    table = _KnownArcs(np.zeros((capacity, 2), int), np.zeros(capacity), np.zeros((capacity, 4)))
    for row, arc in enumerate(known):
        _write_row(table, row, arc)
    for drive in driven:
        radius = max(FOLLOW_DISTANCE, clearance[drive.start], clearance[drive.end])
        if drive.start == drive.end:
            is_new = _is_new_loop(drive, known, radius, min_distance)
        else:
            is_new = not _follows(drive, known, table, radius, len(clearance))
        if is_new:
            _write_row(table, len(known), drive)
            known.append(drive)
    return known


def _is_new_loop(drive: Arc, known: Sequence[Arc], radius: float, min_distance: float) -> bool:
    """Whether a driven loop encloses something and runs beside no known loop of its node."""
    if not np.linalg.norm(drive.polyline - drive.polyline[::-1], axis=1).max() > 2 * min_distance:
        return False
    loops = [arc.polyline for arc in known if arc.start == arc.end == drive.start]
    return all(project(drive.polyline, loop)[0].max() > radius for loop in loops)


def _follows(
    drive: Arc, known: Sequence[Arc], table: _KnownArcs, radius: float, num_nodes: int
) -> bool:
    """Whether a path over known arcs, all within `radius` [m] of a drive, replaces the drive."""
    count = len(known)
    close = np.all(table.boxes[:count] >= _box(drive.polyline) - radius, axis=1)
    for k in np.flatnonzero(close).tolist():
        close[k] = project(known[k].polyline, drive.polyline)[0].max() < radius
    usable = np.where(close, table.lengths[:count], np.inf)
    path = find_path(table.pairs[:count], usable, drive.start, drive.end, num_nodes=num_nodes)
    return (
        path is not None
        and not table.lengths[path].sum() > MAX_DETOUR[0] * drive.length + MAX_DETOUR[1]
    )


def open_frontiers(
    frontiers: Sequence[Arc], known: Sequence[Arc], xy: np.ndarray, clearance: np.ndarray
) -> list[Arc]:
    """Frontiers whose ends no arc and no other node has reached, without duplicates.

    Of frontiers whose ends are close to each other the shortest is kept.

    Args:
        frontiers: The frontiers.
        known: The arcs.
        xy: (N, 2) [m] positions of the nodes.
        clearance: (N,) [m] of the nodes.
    """
    kept: list[Arc] = []
    low = np.array([arc.polyline.min(axis=0) for arc in known]).reshape(-1, 2)
    high = np.array([arc.polyline.max(axis=0) for arc in known]).reshape(-1, 2)
    for frontier in sorted(frontiers, key=lambda frontier: frontier.length):
        end, radius = frontier.polyline[-1:], min(FRONTIER_TOLERANCE, frontier.length / 2)
        at_node = np.linalg.norm(xy - end, axis=1) < clearance / 2
        at_node[frontier.start] = False
        in_box = ((low - radius <= end) & (end <= high + radius)).all(axis=1)
        nearby = [known[k].polyline for k in np.flatnonzero(in_box).tolist()]
        on_arc = any(project(end, line)[0][0] < radius for line in nearby)
        duplicate = any(
            np.linalg.norm(other.polyline[-1] - end[0]) < FRONTIER_TOLERANCE for other in kept
        )
        if not (at_node.any() or on_arc or duplicate):
            kept.append(frontier)
    return kept
