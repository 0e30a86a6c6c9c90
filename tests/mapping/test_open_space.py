"""Arcs through open space: everywhere is near an arc, and no route leads far around."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.sparse import csgraph

from jaxslam.core import polylines
from jaxslam.mapping import grid_topology, medial_axis, open_space
from jaxslam.mapping.open_space import COVER, MAX_DETOUR, FreeSpace, fill_open_space
from jaxslam.mapping.plane_graph import MIN_PIECE, Line, PlaneGraph

CELL, RADIUS = 0.1, 0.25


def branches_of(free):
    """Branches of the diagram of free cells (H, W), and the free space."""
    space = medial_axis.free_configurations(free, clearance=RADIUS / CELL)
    cells, _ = grid_topology.trace_medial_axis(space, ~free, space.region == 1)
    place = FreeSpace(space.distance * CELL * (space.region == 1), CELL, np.zeros(2), RADIUS)
    return grid_topology.to_plane(cells, CELL, np.zeros(2)), place


def hall(pillars=()):
    """A hall of 24 m x 18 m with two doors and a corridor."""
    free = np.zeros((300, 260), bool)
    free[20:260, 10:190] = True
    free[100:112, 190:250] = free[210:222, 190:250] = free[20:290, 230:250] = True
    for i, j in pillars:
        free[i : i + 8, j : j + 8] = False
    return free


def farthest(graph, place):
    """[m] from the arcs, of the free cell that is farthest by free path."""
    lines = [line.points for line in graph.arcs.values()]
    dense = np.concatenate(
        [polylines.resample(x, int(20 * polylines.length(x)) + 2) for x in lines]
    )
    start = np.zeros(place.clearance.shape, bool)
    start[tuple(np.floor(dense / CELL).astype(int).T)] = True
    free = place.clearance > 0.0
    reached, steps = start & free, 0
    while True:
        more = ndimage.binary_dilation(reached, np.ones((3, 3))) & free
        if (more == reached).all():
            return steps * CELL
        reached, steps = more, steps + 1


def stretch(graph, place):
    """[m] by which a route between points of arcs that see each other exceeds `MAX_DETOUR`."""
    points, edges = open_space._points_of(graph, 1.0)
    over = csgraph.dijkstra(open_space._matrix(edges, len(points)), directed=False)
    worst = 0.0
    for i in range(0, len(points), 3):
        for j in range(i + 1, len(points), 2):
            straight = float(np.hypot(*(points[i] - points[j])))
            if straight < open_space.REACH and place.sees(points[i], points[j]):
                limit = max(MAX_DETOUR[0] * straight, MAX_DETOUR[1] + straight)
                worst = max(worst, float(over[i, j]) - limit)
    return worst


@pytest.mark.parametrize("pillars", [(), ((60, 60), (150, 100), (200, 50))])
def test_a_hall_is_served_everywhere_and_without_detours(pillars):
    graph, place = branches_of(hall(pillars))
    before, num_branches = farthest(graph, place), len(graph.arcs)
    fill_open_space(graph, place)
    assert before > 2 * COVER or stretch(branches_of(hall(pillars))[0], place) > 3.0
    # Free paths are measured in blocks of 0.2 m, and here in steps that may be diagonal.
    assert farthest(graph, place) <= COVER + 0.4
    # Shortcuts join points of arcs that are `SPACING` apart, so half of that from any other: a
    # route to them and back is longer by up to 2 (1 + 1.5) times as much.
    assert stretch(graph, place) < 2.5 * open_space.SPACING
    assert len(graph.arcs) > num_branches


def test_filled_arcs_are_free_and_meet_at_nodes_alone():
    graph, place = branches_of(hall(((60, 60), (150, 100))))
    fill_open_space(graph, place)
    filled = [line for line in graph.arcs.values() if not line.is_branch]
    assert filled
    for line in filled:
        dense = polylines.resample(line.points, int(50 * polylines.length(line.points)) + 2)
        assert (place.at(dense) >= RADIUS).all()
        np.testing.assert_array_equal(line.points[0], graph.xy[line.start])
        np.testing.assert_array_equal(line.points[-1], graph.xy[line.end])
    for k, line in enumerate(filled):
        middle = polylines.resample(line.points, 41)[3:-3]
        for other in filled[:k]:
            if not {line.start, line.end} & {other.start, other.end}:
                assert polylines.project(middle, other.points)[0].min() > 0.0


@pytest.mark.parametrize("thick", [1, 2, 3])
def test_no_arc_of_a_small_robot_passes_a_thin_wall(thick):
    """Two halls of 12 m x 8 m beside each other; a door at one end of the wall between them."""
    cell, radius = 0.05, 0.05
    free = np.zeros((244, 330), bool)
    free[2:242, 2:328] = True
    free[:200, 162 : 162 + thick] = False
    space = medial_axis.free_configurations(free, clearance=radius / cell)
    cells, _ = grid_topology.trace_medial_axis(space, ~free, space.region == 1)
    place = FreeSpace(space.distance * cell * (space.region == 1), cell, np.zeros(2), radius)
    graph = grid_topology.to_plane(cells, cell, np.zeros(2))
    fill_open_space(graph, place)
    assert not all(line.is_branch for line in graph.arcs.values())
    for line in graph.arcs.values():
        dense = polylines.refine(line.points, 0.01)
        assert free[tuple(np.floor(dense / cell).astype(int).T)].all()


def test_corridors_and_small_rooms_need_nothing():
    free = np.zeros((200, 120), bool)
    free[10:190, 50:70] = True
    free[60:86, 72:96] = free[70:80, 70:72] = True
    graph, place = branches_of(free)
    before = len(graph.arcs)
    fill_open_space(graph, place)
    assert len(graph.arcs) == before and all(line.is_branch for line in graph.arcs.values())


def square():
    """A square with its diagonal's ends as nodes 0 and 2."""
    xy = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    sides = [Line(k, (k + 1) % 4, xy[[k, (k + 1) % 4]], True) for k in range(4)]
    return PlaneGraph(xy, sides)


def total(graph):
    return sum(float(polylines.length(line.points)) for line in graph.arcs.values())


def test_a_split_arc_is_as_long_as_before_and_is_not_split_at_its_ends():
    graph = square()
    node = graph.split(1, 1.5)
    np.testing.assert_allclose(graph.xy[node], [4.0, 1.5])
    assert np.isclose(total(graph), 16.0) and len(graph.arcs) == 5
    assert graph.split(0, 0.5 * MIN_PIECE) == 0 and graph.split(0, 4.0) == 1
    assert len(graph.arcs) == 5
    np.testing.assert_array_equal(graph.degrees(), [2, 2, 2, 2, 2])


def test_lines_that_cross_share_a_node():
    graph = square()
    graph.add_segment(np.array([0.0, 2.0]), np.array([4.0, 3.0]))
    graph.add_segment(np.array([1.0, 0.0]), np.array([1.0, 4.0]))
    crossing = [k for k, xy in enumerate(graph.xy) if np.allclose(xy, [1.0, 2.25])]
    assert len(crossing) == 1 and graph.degrees()[crossing[0]] == 4
    assert np.isclose(total(graph), 16.0 + np.hypot(4, 1) + 4.0)
    graph.move(crossing[0], np.array([1.1, 2.2]))
    assert sum((x.points == [1.1, 2.2]).all(axis=1).any() for x in graph.arcs.values()) == 4
    arc, distance, along = graph.nearest(np.array([3.0, -1.0]))
    assert np.isclose(distance, 1.0) and {graph.arcs[arc].start, graph.arcs[arc].end} & {1}
    assert 0.0 < along < 3.1 and graph.nearest(np.array([9.0, 9.0]), 2.0)[0] == -1
