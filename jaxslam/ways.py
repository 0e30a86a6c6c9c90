"""Ways between the nodes of a map: polylines that are split, merged and searched, in NumPy."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

POINTS = 9  # of a line that is compared or made of a drive
BESIDE = 1.0  # [m] a drive this close to known arcs follows them, more where there is more room
DETOUR = 1.5, 0.5  # [-, m] factor and excess in length of arcs that a drive has followed
LYING = 0.5  # [m] the end of a frontier this close to an arc, or to another's end, lies on it
ASIDE = 0.7  # of the distance to its own ends: a way this close to a node goes through it
STUB = 0.1  # [m] nothing shorter is split off


class Way(NamedTuple):
    """A way from one node to another, to itself, or to the end of what was seen; world frame."""

    a: int  # index of a node
    b: int  # index of a node, -1 at a frontier
    line: np.ndarray  # (n >= 2, 2) [m]
    length: float  # [m]
    clearance: float  # [m] at its narrowest, NaN if not known
    seen: int  # how often


def size(line: np.ndarray) -> np.ndarray:
    """Length (...) [m] of polylines (..., n, 2)."""
    return np.linalg.norm(np.diff(line, axis=-2), axis=-1).sum(axis=-1)


def evenly(line: np.ndarray, count: int = POINTS) -> np.ndarray:
    """Points (count, 2) at equal distances along a polyline (n, 2) [m], its ends included."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(at, along, line[:, k]) for k in range(2)], axis=1)


def beside(points: np.ndarray, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (M,) [m] of points (M, 2) from a polyline (n, 2), and how far along it (M,) [m]."""
    start, step = line[:-1], np.diff(line, axis=0)
    square = np.maximum(np.sum(step**2, axis=1), 1e-12)
    part = np.clip(np.sum((points[:, None] - start) * step, axis=2) / square, 0.0, 1.0)
    away = np.linalg.norm(start + part[..., None] * step - points[:, None], axis=2)  # (M, n - 1)
    nearest = np.argmin(away, axis=1)
    long = np.sqrt(np.sum(step**2, axis=1))
    before = np.concatenate([[0.0], np.cumsum(long)])
    rows = np.arange(len(points))
    return away[rows, nearest], before[nearest] + part[rows, nearest] * long[nearest]


def reverse(way: Way) -> Way:
    """The same way from its other end."""
    return way._replace(a=way.b, b=way.a, line=way.line[::-1])


def split(way: Way, xy: np.ndarray, near: np.ndarray) -> list[Way]:
    """The parts of a way between the nodes that it goes through.

    Args:
        way: An arc or a frontier.
        xy: (N, 2) [m] of the nodes.
        near: (N,) [m] how close it must come to each.
    """
    whole, room = size(way.line), near[:, None]
    about = (way.line.min(axis=0) - room < xy) & (xy < way.line.max(axis=0) + room)
    some = np.setdiff1d(np.flatnonzero(about.all(axis=1)), (way.a, way.b))
    away, along = beside(xy[some], way.line)
    ends = way.line[[0, -1]] if way.b >= 0 else way.line[:1]
    far = np.min(np.linalg.norm(xy[some, None] - ends, axis=2), axis=1)
    passed = (away < np.minimum(near[some], ASIDE * far)) & (along > STUB)
    passed &= (along < whole - STUB) | (way.b < 0)
    passed = np.flatnonzero(passed)[np.argsort(along[passed], kind="stable")]
    if not passed.size:
        return [way]
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way.line, axis=0), axis=1))])
    cuts, stops = [0.0, *along[passed], whole], some[passed]
    names = [way.a, *map(int, stops), way.b]
    places = [way.line[0], *xy[stops], way.line[-1]]
    parts = []
    for k in range(len(cuts) - 1):
        inner = way.line[(at > cuts[k] + STUB) & (at < cuts[k + 1] - STUB)]
        line = np.concatenate([places[k][None], inner, places[k + 1][None]])
        if size(line) > STUB:
            length = size(line) * way.length / whole
            parts.append(way._replace(a=names[k], b=names[k + 1], line=line, length=length))
    return parts


def merge(ways: Sequence[Way], apart: float) -> list[Way]:
    """Ways of which no two have the same ends and lines less than `apart` [m] from each other.

    Of such, the one seen most often stands, with the smallest clearance of all.
    """
    found: list[Way] = []
    between: dict[tuple[int, int], list[int]] = {}  # those found, by their ends
    for way in sorted(ways, key=lambda way: -way.seen):
        rivals = between.setdefault((min(way.a, way.b), max(way.a, way.b)), [])
        for k in rivals:
            known = found[k]
            turned = [w for w in (way, reverse(way)) if (w.a, w.b) == (known.a, known.b)]
            gaps = [np.linalg.norm(evenly(w.line) - evenly(known.line), axis=1) for w in turned]
            if any(gap.max() < apart for gap in gaps):
                narrow = float(np.fmin(known.clearance, way.clearance))
                found[k] = known._replace(clearance=narrow, seen=known.seen + way.seen)
                break
        else:
            rivals.append(len(found))
            found.append(way)
    return found


def shortest(
    pairs: np.ndarray, lengths: np.ndarray, start: int, goal: int, *, places: int
) -> list[int]:
    """Arcs of the shortest way from `start` to `goal`, in order; none if these are one.

    Args:
        pairs: (A, 2) int, the two places each arc joins, both ways; loops and parallel arcs count.
        lengths: (A,) [m], not negative; infinite for arcs that must not be used.
        start: Index of the first place.
        goal: Index of the last place.
        places: Number of places.

    Raises:
        ValueError: No arcs lead from `start` to `goal`, or there is no such place.
    """
    for place in (start, goal):
        if not 0 <= place < places:
            raise ValueError(f"no place {place}: the map has the places 0 to {places - 1}")
    pairs, lengths = np.asarray(pairs, int).reshape(-1, 2), np.asarray(lengths, float)
    if lengths.shape != (len(pairs),) or np.any(lengths < 0) or np.any(np.isnan(lengths)):
        raise ValueError(f"lengths {lengths.shape} must be numbers >= 0, one of {len(pairs)} arcs")
    # The shortest of parallel arcs; the sparse matrix would add them up.
    ends = np.sort(pairs, axis=1)
    order = np.argsort(lengths, kind="stable")[: np.count_nonzero(lengths < np.inf)]
    order = order[np.unique(ends[order] @ [places, 1], return_index=True)[1]]
    joined = sparse.csr_array((lengths[order], ends[order].T), shape=(places, places))
    how = {"directed": False, "indices": start, "return_predecessors": True}
    before = csgraph.dijkstra(joined, **how)[1]
    way, here = [], int(goal)
    while here != start:
        last = int(before[here])
        if last < 0:
            raise ValueError(f"no route leads from place {start} to place {goal}")
        between = np.flatnonzero(np.all(ends == sorted((last, here)), axis=1))
        way.append(int(between[np.argmin(lengths[between])]))
        here = last
    return way[::-1]


def along(lines: Sequence[np.ndarray], pairs: np.ndarray, arcs: Sequence[int], start: int):
    """Places in order, and the polyline (n, 2), of a way over `arcs` from the place `start`."""
    here, nodes, parts = start, [start], []
    for k in arcs:
        a, b = (int(i) for i in pairs[k])
        parts.append(lines[k] if a == here else lines[k][::-1])
        here = b if a == here else a
        nodes.append(here)
    return nodes, np.concatenate(parts) if parts else np.zeros((0, 2))


def node_at(place: np.ndarray, xy: np.ndarray, clearance: np.ndarray) -> int:
    """Node in whose circle a place (2,) is, the nearest where circles overlap; -1 for none.

    Args:
        place: [m].
        xy: (N, 2) [m] positions of the nodes.
        clearance: (N,) [m] radii of their circles.
    """
    away = np.linalg.norm(xy - place, axis=1)
    inside = np.where(away < clearance, away, np.inf)
    return int(np.argmin(inside)) if np.isfinite(inside).any() else -1


def trail(xy: np.ndarray, clearance: np.ndarray, poses: np.ndarray) -> list[Way]:
    """Drives of the robot from node to node, and from a node around back to it.

    The robot is at a node while it is inside its circle (`node_at`).

    Args:
        xy: (N, 2) [m] positions of the nodes.
        clearance: (N,) [m] radii of their circles.
        poses: (T, 3) where the robot was.
    """
    place = np.asarray(poses, float)[:, :2]
    found, here, since = [], -1, 0
    for step, at in enumerate(place):
        now = node_at(at, xy, clearance)
        if now >= 0 and here >= 0 and (now != here or step > since + 1):
            line = np.concatenate([xy[[here]], place[since : step + 1], xy[[now]]])
            found.append(Way(here, now, evenly(line), float(size(line)), np.nan, 1))
        if now >= 0:
            here, since = now, step
    return found


def add_driven(
    known: Sequence[Way], driven: Sequence[Way], clearance: np.ndarray, apart: float
) -> list[Way]:
    """Known arcs, and those drives that do not follow them.

    A drive follows arcs that lead from its first node to its last if they are about as short and
    it stays beside them. A drive back to its node is an arc if it went around something.

    Args:
        known: Arcs seen.
        driven: Drives from node to node.
        clearance: (N,) [m] of the nodes.
        apart: Distance [m] between the way out and the way back around something, at least.
    """
    known, most = list(known), len(known) + len(driven)
    pairs, lengths, extents = np.zeros((most, 2), int), np.zeros(most), np.zeros((most, 4))
    bounds = lambda line: np.concatenate([line.min(axis=0), -line.max(axis=0)])

    def note(k: int, way: Way) -> None:
        pairs[k], lengths[k], extents[k] = (way.a, way.b), way.length, bounds(way.line)

    def learn(way: Way) -> None:
        note(len(known), way)
        known.append(way)

    for k, way in enumerate(known):
        note(k, way)
    for way in driven:
        count, room = len(known), max(BESIDE, clearance[way.a], clearance[way.b])
        if way.a == way.b:
            around = np.linalg.norm(way.line - way.line[::-1], axis=1).max() > 2 * apart
            others = [w.line for w in known if w.a == w.b == way.a]
            if around and all(beside(way.line, line)[0].max() > room for line in others):
                learn(way)
            continue
        # An arc that the drive did not keep beside is none that it followed.
        close = np.all(extents[:count] >= bounds(way.line) - room, axis=1)
        for k in np.flatnonzero(close):
            close[k] = beside(known[k].line, way.line)[0].max() < room
        usable = np.where(close, lengths[:count], np.inf)
        try:
            arcs = shortest(pairs[:count], usable, way.a, way.b, places=len(clearance))
        except ValueError:
            arcs = None
        if arcs is None or lengths[arcs].sum() > DETOUR[0] * way.length + DETOUR[1]:
            learn(way)
    return known


def still_open(
    frontiers: Sequence[Way], known: Sequence[Way], xy: np.ndarray, clearance: np.ndarray
) -> list[Way]:
    """Frontiers that no arc or other node has reached; of several at one place, the shortest.

    Args:
        frontiers: Ways that end where the view ended.
        known: Arcs.
        xy: (N, 2) [m] of the nodes.
        clearance: (N,) [m] of the nodes.
    """
    found: list[Way] = []
    low = np.array([w.line.min(axis=0) for w in known]).reshape(-1, 2)
    high = np.array([w.line.max(axis=0) for w in known]).reshape(-1, 2)
    for way in sorted(frontiers, key=lambda way: way.length):
        end, reach = way.line[-1:], min(LYING, way.length / 2)
        on_node = np.linalg.norm(xy - end, axis=1) < clearance / 2
        on_node[way.a] = False
        about = ((low - reach <= end) & (end <= high + reach)).all(axis=1)
        lines = [known[k].line for k in np.flatnonzero(about)]
        taken = any(beside(end, line)[0][0] < reach for line in lines)
        twice = any(np.linalg.norm(w.line[-1] - end[0]) < LYING for w in found)
        if not (on_node.any() or taken or twice):
            found.append(way)
    return found
