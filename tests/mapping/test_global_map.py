"""The topological map of all scans: whole, its nodes the landmarks, its ids those of before."""

import networkx
import numpy as np
import pytest

from jaxslam.core import polylines
from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.core.se2_np import compose
from jaxslam.core.types import CORNER, JUNCTION
from jaxslam.mapping.global_map import build_global_map, moved_with_poses

CELL = 0.05
NOTHING = TopologicalMap(
    id=np.zeros(0, int),
    xy=np.zeros((0, 2)),
    kind=np.zeros(0, int),
    clearance=np.zeros(0),
    arc_ends=np.zeros((0, 2), int),
    arc_length=np.zeros(0),
    arc_clearance=np.zeros(0),
    arc_lines=(),
)


def landmarks(xy, clearance, ids, kind=JUNCTION):
    """A map of landmarks alone."""
    xy = np.array(xy, float)
    return NOTHING._replace(
        id=np.array(ids), xy=xy, kind=np.full(len(xy), kind), clearance=np.array(clearance, float)
    )


def drawn(*rooms, size=(12.0, 8.0), unknown=()):
    """A grid of free boxes (x0, y0, x1, y1) [m] in walls; boxes of `unknown` cells."""
    shape = tuple(int(round(x / CELL)) for x in size)
    free, known = np.zeros(shape, bool), np.ones(shape, bool)
    for target, boxes, value in ((free, rooms, True), (known, unknown, False)):
        for x0, y0, x1, y1 in boxes:
            i, j = (slice(round(a / CELL), round(b / CELL)) for a, b in ((x0, x1), (y0, y1)))
            target[i, j] = value
    return OccupancyMap(~free & known, free & known, CELL, np.zeros(3))


T_SHAPE = ((1.0, 3.0, 11.0, 5.0), (5.0, 0.5, 7.0, 3.0))
DRIVE = np.array([[x, 4.0, 0.0] for x in np.arange(1.5, 10.5, 0.5)])


def net_of(graph):
    net = networkx.MultiGraph()
    net.add_nodes_from(np.flatnonzero(graph.kind == JUNCTION).tolist())
    net.add_edges_from(graph.arc_ends.tolist())
    return net


def test_a_junction_that_is_a_landmark_has_its_id_and_place():
    known = landmarks([[6.05, 3.75], [3.5, 4.1], [9.9, 0.5]], [1.1, 1.0, 1.0], [7, 3, 5])
    found = build_global_map(drawn(*T_SHAPE), DRIVE, known, 20)
    graph = found.graph
    where = {int(k): xy for k, xy in zip(graph.id, graph.xy, strict=True)}
    np.testing.assert_array_equal(where[7], [6.05, 3.75])  # the junction
    np.testing.assert_array_equal(where[3], [3.5, 4.1])  # on an arc, which is split there
    assert 5 not in where  # a wall is there now
    degree = dict(net_of(graph).degree())
    index = {int(k): n for n, k in enumerate(graph.id.tolist())}
    assert degree[index[7]] == 3 and degree[index[3]] == 2
    others = graph.id[~np.isin(graph.id, [3, 7])]
    assert (np.sort(others) == np.arange(20, 20 + len(others))).all()
    assert found.next_id == 20 + len(others)


def test_every_node_is_joined_and_no_arc_leaves_free_space():
    known = landmarks([[5.2, 4.75], [9.0, 4.0]], [1.0, 1.0], [1, 2])
    grid = drawn(*T_SHAPE)
    graph = build_global_map(grid, DRIVE, known, 20).graph
    assert networkx.is_connected(net_of(graph))
    for line, clearance in zip(graph.arc_lines, graph.arc_clearance, strict=True):
        dense = polylines.resample(line, int(polylines.length(line) / 0.01) + 2)
        assert grid.free[tuple(np.floor(dense / CELL).astype(int).T)].all()
        assert clearance >= 0.2 - CELL
    np.testing.assert_allclose(graph.arc_length, [polylines.length(x) for x in graph.arc_lines])


def test_corners_stay_and_have_no_arcs():
    corners = landmarks([[1.0, 3.0]], [0.0], [4], CORNER)
    graph = build_global_map(drawn(*T_SHAPE), DRIVE, corners, 20).graph
    (index,) = np.flatnonzero(graph.kind == CORNER)
    assert graph.id[index] == 4 and index not in graph.arc_ends


def test_a_gap_that_the_robot_drove_through_joins_two_rooms():
    rooms = (1.0, 3.0, 5.0, 6.0), (5.3, 3.0, 11.0, 6.0)
    gap = (5.0, 3.85, 5.3, 4.15)  # 0.3 m wide, where the robot needs 0.4 m
    closed = build_global_map(drawn(*rooms, gap), DRIVE[:7], NOTHING, 0).graph
    assert networkx.is_connected(net_of(closed)) and closed.xy[:, 0].max() < 5.3
    drive = np.concatenate([DRIVE[:7], [[5.0, 4.0, 0.0], [5.3, 4.0, 0.0]], DRIVE[9:]])
    joined = build_global_map(drawn(*rooms, gap), drive, NOTHING, 0).graph
    assert networkx.is_connected(net_of(joined)) and joined.xy[:, 0].max() > 5.5
    through = [c for c in joined.arc_clearance if c < 0.2]
    assert len(through) == 1 and through[0] > 0.1  # and its clearance tells


def test_only_space_that_the_robot_was_in_is_mapped():
    behind_glass = (1.0, 0.5, 4.0, 2.5)
    graph = build_global_map(drawn(*T_SHAPE, behind_glass), DRIVE, NOTHING, 0).graph
    assert not ((graph.xy < [4.0, 2.5]).all(axis=1)).any()


@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_ids_stay_when_the_poses_move(turn):
    known = landmarks([[6.05, 3.9]], [1.1], [7])
    first = build_global_map(drawn(*T_SHAPE), DRIVE, known, 20)
    shift = np.array([0.3, -0.2, turn])
    moved = moved_with_poses(first.graph, DRIVE, compose(shift[None], DRIVE))
    cosine, sine = np.cos(turn), np.sin(turn)
    expected = first.graph.xy @ np.array([[cosine, sine], [-sine, cosine]]) + shift[:2]
    np.testing.assert_allclose(moved.xy, expected, atol=1e-9)
    back = moved_with_poses(moved, compose(shift[None], DRIVE), DRIVE)
    again = build_global_map(drawn(*T_SHAPE), DRIVE, known, first.next_id, previous=back)
    np.testing.assert_array_equal(again.graph.id, first.graph.id)
    assert again.next_id == first.next_id
    grown = drawn(*T_SHAPE, (5.0, 5.0, 7.0, 7.5))
    later = build_global_map(grown, DRIVE, known, first.next_id, previous=first.graph)
    same = {int(k): xy for k, xy in zip(first.graph.id, first.graph.xy, strict=True)}
    kept = [k for k in later.graph.id.tolist() if k in same]
    assert len(kept) >= len(same) - 1 and later.next_id > first.next_id
    where = {int(k): xy for k, xy in zip(later.graph.id, later.graph.xy, strict=True)}
    assert all(np.hypot(*(where[k] - same[k])) < 0.5 for k in kept)


def test_open_ends_lead_to_unknown_space_alone():
    known = landmarks([[6.0, 3.75]], [1.0], [7])
    unknown = [(5.0, 5.0, 7.0, 7.5), (1.0, 0.0, 1.3, 3.0)]  # beyond an opening; behind the wall
    grid = drawn(*T_SHAPE, (5.0, 5.0, 7.0, 7.5), unknown=unknown)
    found = build_global_map(grid, DRIVE, known, 20)
    (frontier,) = found.graph.frontiers
    np.testing.assert_allclose(frontier[-1], [6.0, 5.0 - 0.2], atol=1.5 * CELL)
    start = found.graph.frontier_node[0]
    np.testing.assert_array_equal(frontier[0], found.graph.xy[start])
    assert net_of(found.graph).degree(start) > 0
    assert found.graph.frontier_id[0] == found.next_id - 1
    again = build_global_map(grid, DRIVE, known, found.next_id, previous=found.graph)
    np.testing.assert_array_equal(again.graph.frontier_id, found.graph.frontier_id)
    assert not build_global_map(drawn(*T_SHAPE), DRIVE, known, 20).graph.frontiers


def test_an_opening_that_the_robot_does_not_fit_through_is_no_open_end():
    for width, ends in ((0.3, 0), (0.6, 1)):
        opening = (6.0 - width / 2, 5.0, 6.0 + width / 2, 5.2)
        walls = drawn(*T_SHAPE, opening, unknown=[(5.0, 5.2, 7.0, 7.5)])
        graph = build_global_map(walls, DRIVE, NOTHING, 0).graph
        assert len(graph.frontiers) == ends
    small = drawn(*T_SHAPE, (5.8, 5.0, 6.2, 5.2), unknown=[(5.8, 5.0, 6.2, 5.2)])
    assert not build_global_map(small, DRIVE, NOTHING, 0).graph.frontiers


def test_a_wide_open_side_has_open_ends_all_along():
    """A hall of 10 m x 2 m whose upper side no scan has seen: ends 3.6 m apart."""
    grid = drawn((1.0, 3.0, 11.0, 5.0), (1.0, 5.0, 11.0, 7.5), unknown=[(1.0, 5.0, 11.0, 7.5)])
    ends = np.array([x[-1] for x in build_global_map(grid, DRIVE, NOTHING, 0).graph.frontiers])
    assert len(ends) == 3 and (abs(ends[:, 1] - 4.8) < 2 * CELL).all()
    assert (np.diff(np.sort(ends[:, 0])) >= 3.6).all()


def test_without_free_space_the_merged_map_is_kept():
    known = landmarks([[6.0, 4.0]], [1.0], [7])
    outside = np.full((1, 3), 11.8)
    found = build_global_map(drawn(*T_SHAPE), outside - [0, 5, 0], known, 20)
    assert found.graph.id.tolist() == [7] or len(found.graph.arc_ends) >= 0
    nowhere = build_global_map(drawn(), np.array([[np.nan] * 3]), known, 20)
    assert nowhere.graph is known and nowhere.next_id == 20


def test_corner_junctions_are_nodes_where_that_is_asked_for():
    """A room of 6 m x 3 m: the two junctions of its diagram, 1.5 m from three walls each."""
    grid = drawn((1.0, 1.0, 7.0, 4.0))
    drive = np.array([[2.0, 2.5, 0.0], [6.0, 2.5, 0.0]])
    found = build_global_map(grid, drive, NOTHING, 0, with_corner_junctions=True).graph
    order = np.argsort(found.xy[:, 0])
    np.testing.assert_allclose(found.xy[order], [[2.5, 2.5], [5.5, 2.5]], atol=1.5 * CELL)
    assert np.sort(found.arc_ends, axis=1).tolist() == [[0, 1]]


def test_no_node_takes_the_id_of_a_corner():
    before = build_global_map(
        drawn(*T_SHAPE), DRIVE, landmarks([[1.0, 3.0]], [0.0], [4], CORNER), 20
    )
    near = before.graph.xy[0] + 0.1  # a corner is there now, with the id of a node before
    corners = landmarks([near], [0.0], [before.graph.id[0]], CORNER)
    grid, next_id = drawn(*T_SHAPE), before.next_id
    graph = build_global_map(grid, DRIVE, corners, next_id, previous=before.graph).graph
    assert len(np.unique(graph.id)) == len(graph.id)
    assert graph.kind[graph.id == before.graph.id[0]].tolist() == [CORNER]
    assert 4 not in graph.id  # nor does a node take that of an earlier corner


def test_a_node_that_becomes_a_landmark_keeps_its_id():
    before = build_global_map(drawn(*T_SHAPE), DRIVE, NOTHING, 0)
    (junction,) = [n for n, degree in net_of(before.graph).degree() if degree == 3]
    known = landmarks([before.graph.xy[junction] + 0.05], [1.1], [50])
    again = build_global_map(drawn(*T_SHAPE), DRIVE, known, 60, previous=before.graph).graph
    np.testing.assert_array_equal(np.sort(again.id), np.sort(before.graph.id))
    np.testing.assert_array_equal(again.xy[again.id == before.graph.id[junction]], known.xy)


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"robot_radius": -1.0}, "robot_radius is -1.0, not a number of metres >= 0"),
        ({"robot_radius": np.nan}, "robot_radius is nan"),
        ({"robot_radius": None}, "robot_radius is object"),
        ({"next_id": -5}, "next_id is -5, not a whole number of at least 0"),
        ({"next_id": 1.5}, "next_id is 1.5, not a whole number"),
        ({"poses": DRIVE[:, :2]}, r"poses is float64 \(18, 2\), not \(T, 3\)"),
        ({"poses": [[1.0, 4.0, 0.0], [np.nan, 4.0, 0.0]]}, r"poses\[1\] is neither finite nor NaN"),
        ({"poses": [[np.inf, 4.0, 0.0]]}, r"poses\[0\] is neither finite nor NaN"),
        ({"merged": None}, "merged is NoneType, not TopologicalMap"),
        ({"previous": 3}, "previous is int, not TopologicalMap"),
        ({"occupancy": drawn()._replace(origin=[0, 0, 0.3])}, "occupancy.origin is turned by 0.3"),
    ],
)
def test_build_global_map_names_the_argument_that_does_not_fit(wrong, problem):
    given = {"occupancy": drawn(*T_SHAPE), "poses": DRIVE, "merged": NOTHING, "next_id": 0}
    with pytest.raises(ValueError, match=f"^{problem}"):
        build_global_map(**given | wrong)


def test_lists_of_poses_are_taken_as_arrays_are():
    want = build_global_map(drawn(*T_SHAPE), DRIVE, NOTHING, 0)
    found = build_global_map(drawn(*T_SHAPE), DRIVE.tolist(), NOTHING, 0)
    np.testing.assert_array_equal(found.graph.xy, want.graph.xy)
