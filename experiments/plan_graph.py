"""The Voronoi graph of a whole floor plan, as a robot can drive it: the reference for a map of it.

The walls are sampled densely, and the ridges of SciPy's Voronoi diagram of the samples are its
branches. What is a node follows the rules by which `mapping` documents its maps, here on exact
branches instead of cells:

    the robot fits         branches have its radius as clearance, at least
    dead ends              a branch ends where its two nearest walls are seen under less than
                           `DEAD_END_ANGLE`, unless it leads on to another junction
    spurs                  a dead end no further from its junction than that is from the walls, or
                           by which a corner is run into, is dropped
    one node               two junctions much closer to each other than to the walls are one
"""

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csgraph
from scipy.spatial import Voronoi, cKDTree

from experiments import ground_truth
from experiments.room_graph import angle

SPACING = 0.02  # [m] between the sample points of a wall
MIN_BRANCH_ANGLE = 0.3  # [rad] between the feet of a branch: else both lie on one wall
DEAD_END_ANGLE = np.radians(120.0)
CORNER_SPUR = 1.6  # length of a spur into a corner by the clearance that it loses, at most
MERGE_SHARE = 0.5  # of the smaller clearance, that two junctions of one node are apart at most


class Rules(NamedTuple):
    """What is a node.

    Attributes:
        robot_radius: [m].
        spur: Factor of the lengths up to which spurs are dropped.
        merge: Factor of the distances up to which junctions are one.
        dead_end_angle: [rad] under which the walls beside a dead end are seen, at least.
        shortest: [m] Spurs up to this length are dropped before all others.
    """

    robot_radius: float = 0.2
    spur: float = 1.0
    merge: float = 1.0
    dead_end_angle: float = DEAD_END_ANGLE
    shortest: float = 0.0


RULES = Rules()
TOLERANCE = 0.15  # by which lengths may differ from those of the rules
ANGLE_TOLERANCE = np.radians(5.0)
SHORTEST = 0.1  # [m] of a spur that a map shows: two cells


def variants() -> list[Rules]:
    """The rules, first, and such as differ by no more than the tolerances.

    Where these make other nodes, cells of 5 cm cannot decide, and either is right.
    """
    factors = 1.0, 1.0 - TOLERANCE, 1.0 + TOLERANCE
    turns = 0.0, -ANGLE_TOLERANCE, ANGLE_TOLERANCE
    return [
        Rules(spur=spur, merge=merge, dead_end_angle=DEAD_END_ANGLE + turn, shortest=shortest)
        for spur in factors
        for merge in factors
        for turn in turns
        for shortest in (0.0, SHORTEST)
    ]


class Branches(NamedTuple):
    """Ridges of a Voronoi diagram.

    Attributes:
        xy: (V, 2) [m] vertices.
        clearance: (V,) [m] of each.
        edges: (E, 2) int pairs of vertices.
        angle: (E,) [rad] between the two nearest points of the walls, seen from the ridge.
    """

    xy: np.ndarray
    clearance: np.ndarray
    edges: np.ndarray
    angle: np.ndarray


class PlanArc(NamedTuple):
    """An arc between two nodes, by their vertices, and its vertices in order."""

    ends: tuple[int, int]
    path: list[int]


class PlanGraph(NamedTuple):
    """The nodes and arcs of a floor plan.

    Attributes:
        xy: (N, 2) [m] junctions and dead ends.
        clearance: (N,) [m].
        ends: (A, 2) int nodes of each arc.
        lines: A polylines (n, 2) [m].
        junctions: N arrays (k, 2) [m], the junctions that each node stands for.
    """

    xy: np.ndarray
    clearance: np.ndarray
    ends: np.ndarray
    lines: tuple[np.ndarray, ...]
    junctions: tuple[np.ndarray, ...]


def branches(walls: np.ndarray) -> Branches:
    """All branches of the Voronoi diagram in the largest space that walls (S, 4) [m] enclose."""
    samples = ground_truth.sample(walls, SPACING)
    diagram = Voronoi(samples)
    xy, pairs = diagram.vertices, np.array(diagram.ridge_vertices)
    free = ground_truth.FreeSpace(walls).contains(xy)
    used = (pairs >= 0).all(axis=1)
    used[used] = free[pairs[used]].all(axis=1)
    pairs, feet = pairs[used], samples[diagram.ridge_points[used]]
    middle = xy[pairs].mean(axis=1)
    apart = angle(feet[:, 0] - middle, feet[:, 1] - middle)
    real = apart > MIN_BRANCH_ANGLE
    return Branches(xy, cKDTree(samples).query(xy)[0], pairs[real], apart[real])


def plan_graph(found: Branches, start: np.ndarray, rules: Rules = RULES) -> PlanGraph:
    """The graph of the branches that a robot reaches from `start` (2,) [m]."""
    fits = found.clearance >= rules.robot_radius
    kept = fits[found.edges].all(axis=1)
    pairs, wide = found.edges[kept], found.angle[kept] >= rules.dead_end_angle
    pairs, wide = _reached(found.xy, pairs, wide, start)
    pairs = _without_narrow_ends(pairs, wide, len(found.xy))
    arcs = _traced(pairs, found.clearance)
    stands_for = _clean_up(arcs, found, rules)
    names = sorted({node for arc in arcs for node in arc.ends})
    rank = {node: n for n, node in enumerate(names)}
    return PlanGraph(
        xy=found.xy[names].reshape(-1, 2),
        clearance=found.clearance[names],
        ends=np.array([[rank[node] for node in arc.ends] for arc in arcs], int).reshape(-1, 2),
        lines=tuple(found.xy[arc.path] for arc in arcs),
        junctions=tuple(found.xy[[node, *stands_for[node]]] for node in names),
    )


def _reached(
    xy: np.ndarray, pairs: np.ndarray, wide: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The edges, and whether they are wide, of the component nearest to `start` (2,)."""
    matrix = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(xy), len(xy)))
    part = csgraph.connected_components(matrix, directed=False)[1]
    used = np.unique(pairs)
    own = part[used[np.hypot(*(xy[used] - start).T).argmin()]]
    inside = part[pairs[:, 0]] == own
    return pairs[inside], wide[inside]


def _without_narrow_ends(pairs: np.ndarray, wide: np.ndarray, size: int) -> np.ndarray:
    """The edges (E, 2), less those with a loose end that are not wide, one after the other."""
    while True:
        degree = np.bincount(pairs.ravel(), minlength=size)
        loose = (degree[pairs] == 1).any(axis=1) & ~wide
        if not loose.any():
            return pairs
        pairs, wide = pairs[~loose], wide[~loose]


def _traced(pairs: np.ndarray, clearance: np.ndarray) -> list[PlanArc]:
    """Arcs between vertices whose number of neighbours is not two; rings are loops."""
    beside: dict[int, list[int]] = defaultdict(list)
    for a, b in pairs.tolist():
        beside[a].append(b)
        beside[b].append(a)
    nodes = {v for v, others in beside.items() if len(others) != 2}
    arcs, visited = [], set()

    def walk(first: int, second: int) -> None:
        path = [first, second]
        while path[-1] not in nodes:
            visited.add(path[-1])
            a, b = beside[path[-1]]
            path.append(b if a == path[-2] else a)
        arcs.append(PlanArc((path[0], path[-1]), path))

    for node in sorted(nodes):
        for other in beside[node]:
            if other in nodes:
                if node < other:
                    arcs.append(PlanArc((node, other), [node, other]))
            elif other not in visited:
                walk(node, other)
    for vertex in sorted(beside, key=lambda v: -clearance[v]):
        if vertex not in visited and vertex not in nodes:
            nodes.add(vertex)
            walk(vertex, beside[vertex][0])
    return arcs


def _length(xy: np.ndarray, path: list[int]) -> float:
    return float(np.hypot(*np.diff(xy[path], axis=0).T).sum())


def _at_nodes(arcs: list[PlanArc]) -> dict[int, list[PlanArc]]:
    """The arcs at each node; loops twice."""
    at: dict[int, list[PlanArc]] = defaultdict(list)
    for arc in arcs:
        for node in arc.ends:
            at[node].append(arc)
    return at


def _clean_up(arcs: list[PlanArc], found: Branches, rules: Rules) -> dict[int, list[int]]:
    """Drop spurs, join arcs through nodes of degree 2, make close junctions one; in place.

    Returns:
        The junctions that became one with each other one.
    """
    before, stands_for = -1, defaultdict(list)
    _drop_shortest(arcs, found, rules.shortest)
    _join(arcs)
    while before != len(arcs):
        before = len(arcs)
        while _drop_spurs(arcs, found, rules):
            _join(arcs)
        _join(arcs)
        _merge(arcs, found, rules, stands_for)
    return stands_for


def _drop_shortest(arcs: list[PlanArc], found: Branches, shortest: float) -> None:
    """Drop spurs no longer than `shortest` [m], at junctions; in place."""
    at = _at_nodes(arcs)
    for arc in list(arcs):
        degree = sorted(len(at[node]) for node in arc.ends)
        if degree[0] == 1 < degree[1] and _length(found.xy, arc.path) <= shortest:
            arcs.remove(arc)


def _drop_spurs(arcs: list[PlanArc], found: Branches, rules: Rules) -> bool:
    """Drop all spurs at once that are short; was there one?"""
    at, clearance = _at_nodes(arcs), found.clearance
    short = []
    for arc in arcs:
        order = sorted(arc.ends, key=lambda v: (len(at[v]) > 1, clearance[v]))
        tip, root = order
        fall = CORNER_SPUR * (clearance[root] - clearance[tip])
        limit = rules.spur * max(clearance[root], fall)
        if root != tip and len(at[tip]) == 1 and _length(found.xy, arc.path) <= limit:
            short.append(arc)
    for arc in short:
        arcs.remove(arc)
    return bool(short)


def _from(arc: PlanArc, node: int) -> list[int]:
    """The vertices of an arc, from one of its ends."""
    return arc.path if arc.ends[0] == node else arc.path[::-1]


def _join(arcs: list[PlanArc]) -> None:
    """Make one arc of the two at each node of degree 2; loops stay."""
    for node in sorted(_at_nodes(arcs)):
        two = [arc for arc in arcs if node in arc.ends]
        if len(two) == 2 and all(arc.ends[0] != arc.ends[1] for arc in two):
            path = [*_from(two[0], node)[::-1], *_from(two[1], node)[1:]]
            for arc in two:
                arcs.remove(arc)
            arcs.append(PlanArc((path[0], path[-1]), path))


def _merge(
    arcs: list[PlanArc], found: Branches, rules: Rules, stands_for: dict[int, list[int]]
) -> None:
    """Move the arcs of a junction to one close by, of larger clearance, and note which."""
    clearance = found.clearance
    for arc in sorted(arcs, key=lambda one: _length(found.xy, one.path)):
        lost, kept = sorted(arc.ends, key=lambda v: clearance[v])
        limit = rules.merge * MERGE_SHARE * clearance[lost]
        if arc not in arcs or lost == kept or _length(found.xy, arc.path) > limit:
            continue
        at = _at_nodes(arcs)
        if len(at[lost]) < 3 or len(at[kept]) < 3:
            continue
        stands_for[kept] += [lost, *stands_for[lost]]
        bridge = _from(arc, kept)
        arcs.remove(arc)
        for other in [one for one in arcs if lost in one.ends]:
            arcs.remove(other)
            path = [*bridge, *_from(other, lost)[1:]]
            if other.ends[0] == other.ends[1]:
                path = [*path, *bridge[::-1][1:]]
            arcs.append(PlanArc((path[0], path[-1]), path))
