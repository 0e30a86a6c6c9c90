"""Arcs of a topological map as polylines: split, merge, shortest path, driven arcs; NumPy."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

POINTS = 9  # points to which a polyline is resampled to be compared, and of a driven arc
BESIDE = 1.0  # [m] a drive this close to known arcs follows them; more where clearances are larger
DETOUR = 1.5, 0.5  # [-, m] factor and offset by which followed arcs may be longer than a drive
LYING = 0.5  # [m] the end of a frontier this close to an arc, or to another's end, is reached
ASIDE = 0.7  # an arc passes through a node if closer than this fraction of the node-to-end distance
STUB = 0.1  # [m] no piece shorter than this is split off


class Way(NamedTuple):
    """Arc from one node to another, to itself (loop), or to the end of the view (frontier).

    Attributes:
        a: Index of the first node.
        b: Index of the last node, -1 at a frontier.
        line: (n >= 2, 2) [m] polyline from `a` to `b`, map frame.
        length: [m].
        clearance: [m] smallest distance to an obstacle along the arc, NaN if not known.
        seen: Number of observations.
    """

    a: int
    b: int
    line: np.ndarray
    length: float
    clearance: float
    seen: int


def size(line: np.ndarray) -> np.ndarray:
    """Length (...) [m] of polylines (..., n, 2)."""
    return np.linalg.norm(np.diff(line, axis=-2), axis=-1).sum(axis=-1)


def _arc_lengths(line: np.ndarray) -> np.ndarray:
    """Length (n,) [m] along a polyline (n, 2) from its first point to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def evenly(line: np.ndarray, count: int = POINTS) -> np.ndarray:
    """Points (count, 2) at equal distances along a polyline (n, 2) [m], its ends included."""
    at_point = _arc_lengths(line)
    wanted = np.linspace(0.0, at_point[-1], count)
    return np.stack([np.interp(wanted, at_point, line[:, axis]) for axis in range(2)], axis=1)


def beside(points: np.ndarray, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest points on a polyline.

    Args:
        points: (M, 2) [m].
        line: (n >= 2, 2) [m].

    Returns:
        Distance (M,) [m] of each point from the polyline, and the length (M,) [m] along the
        polyline at which the nearest point lies.
    """
    start, step = line[:-1], np.diff(line, axis=0)
    squared_length = np.maximum(np.sum(step**2, axis=1), 1e-12)
    fraction = np.sum((points[:, None] - start) * step, axis=2) / squared_length
    fraction = np.clip(fraction, 0.0, 1.0)  # (M, n - 1) of each segment, to the foot of the normal
    distance = np.linalg.norm(start + fraction[..., None] * step - points[:, None], axis=2)
    nearest = np.argmin(distance, axis=1)
    segment_length = np.sqrt(np.sum(step**2, axis=1))
    before = np.concatenate([[0.0], np.cumsum(segment_length)])
    rows = np.arange(len(points))
    along_line = before[nearest] + fraction[rows, nearest] * segment_length[nearest]
    return distance[rows, nearest], along_line


def reverse(way: Way) -> Way:
    """The same arc, from its last node to its first."""
    return way._replace(a=way.b, b=way.a, line=way.line[::-1])


def split(way: Way, xy: np.ndarray, near: np.ndarray) -> list[Way]:
    """Pieces of an arc between the nodes that it passes through.

                    c
        a o---.     o    .---o b             a o---.  c  .---o b
               '--------'             ->            '-o-'
            one arc (a, b)                   two arcs (a, c), (c, b)

    Args:
        way: An arc or a frontier.
        xy: (N, 2) [m] positions of the nodes.
        near: (N,) [m] the arc passes through a node if it comes closer than this.

    Returns:
        The pieces in order, each at least `STUB` long; the arc itself if it is not split. The
        length of the arc is shared in proportion.
    """
    nodes, at_node = _passed_nodes(way, xy, near)
    if not nodes.size:
        return [way]
    at_point, whole = _arc_lengths(way.line), size(way.line)
    cuts = [0.0, *at_node, whole]
    names = [way.a, *map(int, nodes), way.b]
    corners = [way.line[0], *xy[nodes], way.line[-1]]
    pieces = []
    for k in range(len(cuts) - 1):
        inner = way.line[(at_point > cuts[k] + STUB) & (at_point < cuts[k + 1] - STUB)]
        line = np.concatenate([corners[k][None], inner, corners[k + 1][None]])
        if size(line) > STUB:
            length = size(line) * way.length / whole
            pieces.append(way._replace(a=names[k], b=names[k + 1], line=line, length=length))
    return pieces


def _passed_nodes(arc: Way, xy: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inner nodes that an arc passes through, in order, and the lengths (P,) [m] at which it does.

    A node is passed if the arc comes closer to it than its radius and than `ASIDE` of its distance
    to the ends of the arc: a node beside an end is not on the arc. A node at the open end of a
    frontier is passed too.
    """
    whole, margin = size(arc.line), radius[:, None]
    in_box = (arc.line.min(axis=0) - margin < xy) & (xy < arc.line.max(axis=0) + margin)
    nodes = np.setdiff1d(np.flatnonzero(in_box.all(axis=1)), (arc.a, arc.b))
    distance, at_node = beside(xy[nodes], arc.line)
    ends = arc.line[[0, -1]] if arc.b >= 0 else arc.line[:1]
    to_end = np.min(np.linalg.norm(xy[nodes, None] - ends, axis=2), axis=1)
    passed = (distance < np.minimum(radius[nodes], ASIDE * to_end)) & (at_node > STUB)
    passed &= (at_node < whole - STUB) | (arc.b < 0)
    order = np.flatnonzero(passed)[np.argsort(at_node[passed], kind="stable")]
    return nodes[order], at_node[order]


def merge(ways: Sequence[Way], apart: float) -> list[Way]:
    """Merge duplicates: arcs with the same ends whose polylines are close to each other.

    Of duplicates the one observed most often is kept, with the smallest clearance and the number
    of observations of all.

    Args:
        ways: Arcs.
        apart: [m] two arcs are duplicates if corresponding points are closer than this.
    """
    merged: list[Way] = []
    with_ends: dict[tuple[int, int], list[int]] = {}  # indices into `merged`
    for arc in sorted(ways, key=lambda arc: -arc.seen):
        rivals = with_ends.setdefault((min(arc.a, arc.b), max(arc.a, arc.b)), [])
        for k in rivals:
            if _are_duplicates(arc, merged[k], apart):
                clearance = float(np.fmin(merged[k].clearance, arc.clearance))
                count = merged[k].seen + arc.seen
                merged[k] = merged[k]._replace(clearance=clearance, seen=count)
                break
        else:
            rivals.append(len(merged))
            merged.append(arc)
    return merged


def _are_duplicates(arc: Way, other: Way, apart: float) -> bool:
    """Whether two arcs between the same nodes are less than `apart` [m] from each other.

    Arcs are compared in the direction in which their ends agree; loops, in both.
    """
    lines = [each.line for each in (arc, reverse(arc)) if (each.a, each.b) == (other.a, other.b)]
    gaps = [np.linalg.norm(evenly(line) - evenly(other.line), axis=1) for line in lines]
    return any(gap.max() < apart for gap in gaps)


def shortest(
    pairs: np.ndarray, lengths: np.ndarray, start: int, goal: int, *, places: int
) -> list[int]:
    """Arcs of the shortest path from node `start` to node `goal`, in order (Dijkstra).

    Args:
        pairs: (A, 2) int, the two nodes that each arc joins; undirected, loops and parallel arcs
            are allowed.
        lengths: (A,) [m], not negative; infinite for arcs that must not be used.
        start: Index of the first node.
        goal: Index of the last node.
        places: Number of nodes.

    Returns:
        Indices of the arcs; empty if `start` is `goal`.

    Raises:
        ValueError: No arcs lead from `start` to `goal`, there is no such node, or a length is
            negative, NaN or missing.
    """
    for node in (start, goal):
        if not 0 <= node < places:
            raise ValueError(f"no node {node}: the map has the nodes 0 to {places - 1}")
    pairs, lengths = np.asarray(pairs, int).reshape(-1, 2), np.asarray(lengths, float)
    if lengths.shape != (len(pairs),) or np.any(lengths < 0) or np.any(np.isnan(lengths)):
        raise ValueError(f"lengths {lengths.shape} must be numbers >= 0, one of {len(pairs)} arcs")
    # The shortest of parallel arcs; the sparse matrix would add them up.
    ends = np.sort(pairs, axis=1)
    order = np.argsort(lengths, kind="stable")[: np.count_nonzero(lengths < np.inf)]
    order = order[np.unique(ends[order] @ [places, 1], return_index=True)[1]]
    adjacency = sparse.csr_array((lengths[order], ends[order].T), shape=(places, places))
    predecessor = csgraph.dijkstra(
        adjacency, directed=False, indices=start, return_predecessors=True
    )[1]
    path, node = [], int(goal)
    while node != start:
        previous = int(predecessor[node])
        if previous < 0:
            raise ValueError(f"no route leads from place {start} to place {goal}")
        parallel = np.flatnonzero(np.all(ends == sorted((previous, node)), axis=1))
        path.append(int(parallel[np.argmin(lengths[parallel])]))
        node = previous
    return path[::-1]


def along(
    lines: Sequence[np.ndarray], pairs: np.ndarray, arcs: Sequence[int], start: int
) -> tuple[list[int], np.ndarray]:
    """Nodes and polyline of a path.

    Args:
        lines: A polylines (n >= 2, 2) [m] of all arcs.
        pairs: (A, 2) int, the two nodes that each arc joins, in the direction of its polyline.
        arcs: Indices of the arcs of the path, in order.
        start: Index of the first node.

    Returns:
        Indices of the nodes in order, and the polyline (n, 2) [m]; (0, 2) without arcs.
    """
    node, nodes, pieces = start, [start], []
    for k in arcs:
        a, b = (int(end) for end in pairs[k])
        pieces.append(lines[k] if a == node else lines[k][::-1])
        node = b if a == node else a
        nodes.append(node)
    return nodes, np.concatenate(pieces) if pieces else np.zeros((0, 2))


def node_at(place: np.ndarray, xy: np.ndarray, clearance: np.ndarray) -> int:
    """Node whose circle contains a position, the nearest where circles overlap; -1 for none.

    Args:
        place: (2,) [m] the position.
        xy: (N, 2) [m] positions of the nodes.
        clearance: (N,) [m] radii of their circles.
    """
    distance = np.linalg.norm(xy - place, axis=1)
    inside = np.where(distance < clearance, distance, np.inf)
    return int(np.argmin(inside)) if np.isfinite(inside).any() else -1


def trail(xy: np.ndarray, clearance: np.ndarray, poses: np.ndarray) -> list[Way]:
    """Driven arcs: pieces of the trajectory from node to node, and from a node back to itself.

    The robot is at a node while it is inside its circle (`node_at`). A piece begins at the last
    pose inside one circle and ends at the first pose inside the next.

    Args:
        xy: (N, 2) [m] positions of the nodes.
        clearance: (N,) [m] radii of their circles.
        poses: (T, 3) [m, m, rad] trajectory, map frame.

    Returns:
        The pieces in order, clearance NaN, each `POINTS` points long.
    """
    positions = np.asarray(poses, float)[:, :2]
    driven, last_node, left_at = [], -1, 0
    for step, position in enumerate(positions):
        node = node_at(position, xy, clearance)
        if node >= 0 and last_node >= 0 and (node != last_node or step > left_at + 1):
            line = np.concatenate([xy[[last_node]], positions[left_at : step + 1], xy[[node]]])
            driven.append(Way(last_node, node, evenly(line), float(size(line)), np.nan, 1))
        if node >= 0:
            last_node, left_at = node, step
    return driven


class _ArcTable(NamedTuple):
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


def _write_row(table: _ArcTable, row: int, arc: Way) -> None:
    """Write an arc to a row of the table, in place."""
    table.pairs[row], table.lengths[row] = (arc.a, arc.b), arc.length
    table.boxes[row] = _box(arc.line)


def add_driven(
    known: Sequence[Way], driven: Sequence[Way], clearance: np.ndarray, apart: float
) -> list[Way]:
    """Known arcs, and those driven arcs that follow none of them.

    A driven arc follows known arcs if these lead from its first node to its last, are about as
    short, and lie beside it. A driven loop is an arc if it went around something and no known loop
    lies beside it.

             .----- known -----.
          a o                   o b       follows: beside the known arc, nothing is added
             '.... driven ....'

             .----- known -----.
          a o     ( pillar )    o b       does not follow: a second arc between a and b
             '.               .'
               '.. driven ..'

    Args:
        known: Observed arcs.
        driven: Driven arcs, as of `trail`.
        clearance: (N,) [m] of the nodes.
        apart: [m] a loop went around something if its outward and return parts are somewhere more
            than twice this apart.
    """
    known, capacity = list(known), len(known) + len(driven)
    table = _ArcTable(np.zeros((capacity, 2), int), np.zeros(capacity), np.zeros((capacity, 4)))
    for row, arc in enumerate(known):
        _write_row(table, row, arc)
    for drive in driven:
        radius = max(BESIDE, clearance[drive.a], clearance[drive.b])
        if drive.a == drive.b:
            is_new = _is_new_loop(drive, known, radius, apart)
        else:
            is_new = not _follows(drive, known, table, radius, len(clearance))
        if is_new:
            _write_row(table, len(known), drive)
            known.append(drive)
    return known


def _is_new_loop(drive: Way, known: Sequence[Way], radius: float, apart: float) -> bool:
    """Whether a driven loop encloses something and lies beside no known loop of its node."""
    if not np.linalg.norm(drive.line - drive.line[::-1], axis=1).max() > 2 * apart:
        return False
    loops = [arc.line for arc in known if arc.a == arc.b == drive.a]
    return all(beside(drive.line, loop)[0].max() > radius for loop in loops)


def _follows(
    drive: Way, known: Sequence[Way], table: _ArcTable, radius: float, num_nodes: int
) -> bool:
    """Whether a path over known arcs, all within `radius` [m] of a drive, replaces the drive."""
    count = len(known)
    close = np.all(table.boxes[:count] >= _box(drive.line) - radius, axis=1)
    for k in np.flatnonzero(close):
        close[k] = beside(known[k].line, drive.line)[0].max() < radius
    usable = np.where(close, table.lengths[:count], np.inf)
    try:
        path = shortest(table.pairs[:count], usable, drive.a, drive.b, places=num_nodes)
    except ValueError:
        return False
    return not table.lengths[path].sum() > DETOUR[0] * drive.length + DETOUR[1]


def still_open(
    frontiers: Sequence[Way], known: Sequence[Way], xy: np.ndarray, clearance: np.ndarray
) -> list[Way]:
    """Frontiers whose ends no arc and no other node has reached, without duplicates.

    Of frontiers whose ends are close to each other the shortest is kept.

    Args:
        frontiers: The frontiers.
        known: The arcs.
        xy: (N, 2) [m] positions of the nodes.
        clearance: (N,) [m] of the nodes.
    """
    kept: list[Way] = []
    low = np.array([arc.line.min(axis=0) for arc in known]).reshape(-1, 2)
    high = np.array([arc.line.max(axis=0) for arc in known]).reshape(-1, 2)
    for frontier in sorted(frontiers, key=lambda frontier: frontier.length):
        end, radius = frontier.line[-1:], min(LYING, frontier.length / 2)
        at_node = np.linalg.norm(xy - end, axis=1) < clearance / 2
        at_node[frontier.a] = False
        in_box = ((low - radius <= end) & (end <= high + radius)).all(axis=1)
        nearby = [known[k].line for k in np.flatnonzero(in_box)]
        on_arc = any(beside(end, line)[0][0] < radius for line in nearby)
        duplicate = any(np.linalg.norm(other.line[-1] - end[0]) < LYING for other in kept)
        if not (at_node.any() or on_arc or duplicate):
            kept.append(frontier)
    return kept
