"""The topological map of an occupancy grid: the medial cells of free space as a graph.

Nodes are the junctions and dead ends of the medial cells, arcs the lines between them. A graph
here is a dict of arcs, each a path of cells with a node at either end; two nodes may have several
arcs, and a ring without junction is one node with an arc to itself.
"""

from collections import defaultdict
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from jaxslam import medial, ways
from jaxslam.topomap import Graph
from jaxslam.types import NODE

ANGLE = np.radians(120.0)  # walls seen further apart than this make dead ends; corners do not
CORNER = 1.6  # a spur into a right corner is 1.41 times as long as its clearance falls
MERGE = 0.5  # junctions nearer than this part of the smaller of their clearances are one
STAGES = ("distances", "thinning", "graph")
WALL = 2  # [cells] unknown cells this near to an occupied one are part of the wall


class Survey(NamedTuple):
    """The topological map of an occupancy grid."""

    graph: Graph  # frame of the map
    regions: int  # regions of free space drawn
    reached: float  # [m^2] where the centre of the robot may be in them
    left_out: float  # [m^2] the same of the regions left out


class _Arc(NamedTuple):
    """A path of cells between two nodes."""

    ends: tuple[int, int]  # names of nodes
    cells: np.ndarray  # (n >= 2, 2) int index, neighbours touch
    line: np.ndarray  # (m >= 2, 2) [cells] the path smoothed
    length: float  # [cells] of the line


class _Net(NamedTuple):
    """A graph of cells."""

    nodes: dict[int, np.ndarray]  # name -> (2,) cell index
    arcs: dict[int, _Arc]


def survey(
    occupied: np.ndarray,
    free: np.ndarray,
    *,
    resolution: float,
    origin: np.ndarray,
    clearance: float,
    speck: float = 0.1,
    area: float | None = None,
    watch: Callable[[str], object] = str,
) -> Survey:
    """Topological map of the free space that a robot can reach.

    Every region in which the robot's centre may move is one connected graph with a ring around
    each thing it can drive around. A spur, an arc with a dead end, is kept if it is longer than the
    clearance at its root. Unknown cells keep the robot out, but are no walls: they alone make no
    dead end, and patches of them smaller than the robot are passed over.

    Args:
        occupied: (H, W) bool; i grows with x, j with y.
        free: (H, W) bool; a cell that is neither is unknown.
        resolution: [m] side of a cell.
        origin: (3,) [m, m, rad] pose of the corner of cell [0, 0] in the frame of the map.
        clearance: [m] radius of the robot. Nodes keep this far from what is not free, arcs too but
            for less than a cell where their line cuts a bend; `arc_clearance` is that of the line.
        speck: [m] things in free space no wider than this are noise.
        area: [m^2] draw each region at least this large, and not just the largest one.
        watch: Called with the name of each of the `STAGES` as it begins.

    Raises:
        ValueError: The robot fits nowhere.
    """
    watch(STAGES[0])
    free = medial.free_space(
        occupied, free, speck=speck / resolution, gap=2 * clearance / resolution
    )
    space = medial.places(free, clearance=clearance / resolution)
    sizes = space.sizes * resolution**2
    if not sizes.size:
        raise ValueError(f"has no free space for a robot with a clearance of {clearance:g} m")
    count = 1 if area is None else max(1, int(np.sum(sizes >= area)))
    chosen = (space.inside > 0) & (space.inside <= count)
    wall = ndimage.binary_dilation(occupied, structure=np.ones((3, 3)), iterations=WALL)
    kept = medial.facing(space, wall, angle=ANGLE) & chosen
    watch(STAGES[1])
    cells = medial.medial(space, chosen, kept)
    watch(STAGES[2])
    net = _trace(cells, space.room)
    _settle(net, space.room)
    graph = _graph(net, space, resolution, np.asarray(origin, float))
    return Survey(graph, count, float(sizes[:count].sum()), float(sizes[count:].sum()))


def _trace(cells: np.ndarray, room: np.ndarray) -> _Net:
    """Graph of thin cells (H, W) bool."""
    index = np.argwhere(cells)
    number = np.full(np.add(cells.shape, 2), -1)
    number[tuple(index.T + 1)] = np.arange(len(index))
    at = lambda i, j: number[1 + i : number.shape[0] - 1 + i, 1 + j : number.shape[1] - 1 + j]
    # Neighbours: beside each other, or across a corner where no cell is beside both.
    pairs = [(at(0, 0), at(1, 0), None), (at(0, 0), at(0, 1), None)]
    pairs += [(at(0, 0), at(1, s), (at(1, 0) < 0) & (at(0, s) < 0)) for s in (1, -1)]
    beside: dict[int, list[int]] = defaultdict(list)
    for a, b, only in pairs:
        use = (a >= 0) & (b >= 0)
        use = use if only is None else use & only
        for p, q in zip(a[use].tolist(), b[use].tolist(), strict=True):
            beside[p].append(q)
            beside[q].append(p)
    height = room[tuple(index.T)]
    # Four cells in a square have no hole between them: they are one node.
    square = np.stack([at(0, 0), at(1, 0), at(0, 1), at(1, 1)], axis=-1)
    squares = square[(square >= 0).all(axis=-1)]
    name = {p: p for p in range(len(index)) if len(beside[p]) != 2}
    for block in squares.tolist():
        names = {name.get(p, p) for p in block}
        best = max(names, key=lambda p: (height[p], -p))
        name |= {p: best for p in [*block, *(p for p, own in name.items() if own in names)]}
    net = _Net({own: index[own] for own in name.values()}, {})
    seen: set[int] = set()

    def walk(start: int, then: int) -> list[int]:
        path = [start, then]
        while path[-1] not in name:
            seen.add(path[-1])
            path.append(next(p for p in beside[path[-1]] if p != path[-2]))
        return path

    def add(path: list[int]) -> None:
        ends = name[path[0]], name[path[-1]]
        whole = [*(ends[:1] if ends[0] != path[0] else ()), *path]
        whole += ends[1:] if ends[1] != path[-1] else ()
        net.arcs[len(net.arcs)] = _arc(ends, index[whole])

    for p in list(name):
        for q in beside[p]:
            if q in name and (name[p] == name[q] or p > q):
                continue  # within one node, or seen from the other side
            if q not in seen:
                add(walk(p, q))
    for p in np.argsort(-height, kind="stable").tolist():  # what is left are rings
        if p not in seen and p not in name:
            name[p] = p
            net.nodes[p] = index[p]
            add(walk(p, beside[p][0]))
    return net


def _arc(ends: tuple[int, int], cells: np.ndarray) -> _Arc:
    """Arc along a path of cells."""
    line = _smooth(cells)
    return _Arc(ends, cells, line, float(ways.size(line)))


def _smooth(cells: np.ndarray) -> np.ndarray:
    """Polyline (m, 2) of few corners along a path (n, 2), less than a cell away; ends stay."""
    line = cells.astype(float)
    for _ in range(4):
        line[1:-1] = 0.25 * line[:-2] + 0.5 * line[1:-1] + 0.25 * line[2:]
    # Douglas and Peucker: a stretch is split at its point furthest from the chord, if too far.
    kept, todo = {0, len(line) - 1}, [(0, len(line) - 1)]
    while todo:
        a, b = todo.pop()
        away = ways.beside(line[a + 1 : b], line[[a, b]])[0]
        if away.size and away.max() > 0.4:
            worst = a + 1 + int(away.argmax())
            kept.add(worst)
            todo += [(a, worst), (worst, b)]
    return line[sorted(kept)]


def _ends(net: _Net) -> dict[int, list[int]]:
    """Arcs at each node; an arc that returns to its node is there twice."""
    found: dict[int, list[int]] = {own: [] for own in net.nodes}
    for k, arc in net.arcs.items():
        for own in arc.ends:
            found[own].append(k)
    return found


def _settle(net: _Net, room: np.ndarray) -> None:
    """Drop short spurs, join arcs that run through, merge junctions, until nothing changes."""
    before = None
    while before != len(net.arcs):
        before = len(net.arcs)
        while _drop_spurs(net, room):
            _join(net)
        _join(net)
        _merge(net, room)


def _drop_spurs(net: _Net, room: np.ndarray) -> bool:
    """Drop spurs no longer than the clearance at their root, or into a corner; whether any was.

    All at once: of the two spurs into the corners of a dead end neither becomes its end.
    """
    at, height = _ends(net), lambda own: room[tuple(net.nodes[own])]
    short = {}
    for k, arc in net.arcs.items():
        root, tip = sorted(arc.ends, key=lambda own: (len(at[own]) > 1, height(own)), reverse=True)
        least = max(height(root), CORNER * (height(root) - height(tip)))
        if root != tip and len(at[tip]) == 1 and arc.length <= least:
            short[k] = tip
    for k, tip in short.items():
        del net.arcs[k], net.nodes[tip]
    return bool(short)


def _join(net: _Net) -> None:
    """Make one arc of the two at each node that has no others."""
    at = _ends(net)
    for own, arcs in at.items():
        if len(arcs) != 2 or arcs[0] == arcs[1]:
            continue
        first, second = arcs
        before, after = (_towards(net.arcs[first], own), _from(net.arcs[second], own))
        ends = before.ends[0], after.ends[1]
        net.arcs[first] = _arc(ends, np.concatenate([before.cells, after.cells[1:]]))
        at[ends[1]] = [first if k == second else k for k in at[ends[1]]]
        del net.arcs[second], net.nodes[own]


def _merge(net: _Net, room: np.ndarray) -> None:
    """Make one node of junctions whose circles overlap by much, the one with the most room."""
    at, height = _ends(net), lambda own: room[tuple(net.nodes[own])]
    for k in sorted(net.arcs, key=lambda k: (net.arcs[k].length, k)):
        arc = net.arcs[k]
        lost, stays = sorted(arc.ends, key=lambda own: (height(own), -own))
        if lost == stays or arc.length > MERGE * height(lost) or len(at[lost]) < 3:
            continue
        if len(at[stays]) < 3:
            continue
        way = _towards(arc, lost).cells
        at[lost].remove(k)
        at[stays].remove(k)
        for other in at[lost]:  # twice for one that returns to the same node
            old = _from(net.arcs[other], lost)
            ends = stays, old.ends[1]
            net.arcs[other] = _arc(ends, np.concatenate([way, old.cells[1:]]))
        at[stays] += at.pop(lost)
        del net.arcs[k], net.nodes[lost]


def _turned(arc: _Arc) -> _Arc:
    """The arc from its last end to its first."""
    return _Arc(arc.ends[::-1], arc.cells[::-1], arc.line[::-1], arc.length)


def _from(arc: _Arc, own: int) -> _Arc:
    """The arc, turned if need be so that it starts at a node."""
    return arc if arc.ends[0] == own else _turned(arc)


def _towards(arc: _Arc, own: int) -> _Arc:
    """The arc, turned if need be so that it ends at a node."""
    return arc if arc.ends[1] == own else _turned(arc)


def _graph(net: _Net, space: medial.Places, resolution: float, origin: np.ndarray) -> Graph:
    """The graph in the frame of the map."""
    names = list(net.nodes)
    index = {own: n for n, own in enumerate(names)}
    cells = np.array([net.nodes[own] for own in names])
    c, s = np.cos(origin[2]), np.sin(origin[2])
    turn = np.array([[c, s], [-s, c]])
    place = lambda at: (at + 0.5) * resolution @ turn + origin[:2]
    arcs = list(net.arcs.values())
    lines = tuple(place(arc.line) for arc in arcs)
    return Graph(
        id=np.arange(len(names)),
        xy=place(cells),
        kind=np.full(len(names), NODE),
        clearance=space.room[tuple(cells.T)] * resolution,
        pairs=np.array([[index[own] for own in arc.ends] for arc in arcs], int).reshape(-1, 2),
        length=np.array([ways.size(line) for line in lines], float),
        arc_clearance=np.array([_narrowest(arc.line, space.foot) for arc in arcs]) * resolution,
        lines=lines,
    )


def _narrowest(line: np.ndarray, foot: np.ndarray) -> float:
    """Smallest clearance [cells] along a polyline (n, 2) [cells].

    The nearest obstacle of a point is one of those of the four cells around it.
    """
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    at = np.unique(np.concatenate([along, np.arange(0.0, along[-1], 0.25)]))
    points = np.stack([np.interp(at, along, line[:, k]) for k in range(2)])
    i, j = np.floor(points).astype(int)
    i, j = i + np.array([[0], [0], [1], [1]]), j + np.array([[0], [1], [0], [1]])
    i, j = np.minimum(i, foot.shape[1] - 1), np.minimum(j, foot.shape[2] - 1)
    return float(np.hypot(*(foot[:, i, j] - points[:, None])).min()) - 0.5
