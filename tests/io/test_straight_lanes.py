import numpy as np
import pytest
from small_building import building, planner, regions

from jaxslam.core.polylines import simplify
from jaxslam.io.straight_lanes import straight_lanes


def distance(points, line):
    """Distance (n,) of points from a polyline, by dense samples of it."""
    fine = np.concatenate(
        [
            a + np.linspace(0, 1, 500)[:, None] * (b - a)
            for a, b in zip(line[:-1], line[1:], strict=True)
        ]
    )
    return np.linalg.norm(points[:, None] - fine, axis=2).min(axis=1)


@pytest.mark.parametrize("tolerance", [0.02, 0.1, 0.5])
def test_no_point_of_a_line_is_farther_than_the_tolerance_and_few_are_kept(tolerance):
    s = np.linspace(0.0, 6.0, 200)
    line = np.stack([s, np.sin(s)], axis=1)
    kept = simplify(line, tolerance)
    assert (kept[0] == line[0]).all() and (kept[-1] == line[-1]).all()
    assert distance(line, kept).max() <= tolerance + 1e-3 and len(kept) < 20
    assert len(simplify(line[[0, 50, 50, 199]], 9.0)) == 2


def along(found, arc):
    """Points that the lanes of an arc visit, and the doors of the lanes."""
    lanes = [lane for lane in found.lanes if lane.arc == arc]
    assert all(a.end == b.start for a, b in zip(lanes[:-1], lanes[1:], strict=True))
    assert [lane.number for lane in lanes] == list(range(len(lanes)))
    stops = [lanes[0].start, *(lane.end for lane in lanes)]
    return stops, [lane.door for lane in lanes]


def test_lanes_follow_arcs_from_node_to_node():
    graph, found = building(), straight_lanes(building(), regions(), planner())
    assert found.names[:3] == ("5", "8", "11")  # no corner, no open end
    assert len(set(found.names)) == len(found.names) == len(found.xy) == len(found.labels)
    for arc, (start, end) in enumerate(graph.arc_ends.tolist()):
        stops, _ = along(found, arc)
        assert [found.names[k] for k in (stops[0], stops[-1])] == [
            str(graph.id[k]) for k in (start, end)
        ]
        line = graph.arc_lines[arc]
        assert distance(found.xy[stops], line).max() < 0.11
        assert distance(line, found.xy[stops]).max() < 0.11
    assert [found.names[k] for k in along(found, 2)[0]] == ["5", "arc2_1", "8"]
    assert len(along(found, 1)[0]) == 2 and len(along(found, 3)[0]) == 5  # straight; a loop
    assert [lane.speed for lane in found.lanes if lane.arc in (1, 2)] == [1.0, 0.2, 0.2]
    assert found.labels[2].region == "room_1" and found.labels[3].region == ""


@pytest.mark.parametrize("radius, off", [(0.0, 0.1), (0.4, 0.05), (0.6, 0.02), (np.nan, 0.1)])
def test_lanes_are_nearer_to_the_arc_where_the_robot_has_little_space(radius, off):
    """An arc that bends by 0.09 m, and by 0.04 m, with 0.45 m to obstacles."""
    line = np.array([[6.0, 0.0], [6.09, 2.0], [6.0, 4.0], [5.96, 6.0], [6.0, 8.0]])
    graph = building()._replace(arc_lines=(line, *building().arc_lines[1:]))
    unknown = np.isnan(radius)
    graph = graph._replace(arc_clearance=np.where([unknown, 0, 0, 0], np.nan, 0.45))
    found = straight_lanes(graph, robot_radius=0.0 if unknown else radius)
    gap = distance(line, found.xy[along(found, 0)[0]]).max()
    assert gap <= (0.02 if unknown else off) + 1e-3
    assert len(along(found, 0)[1]) == {0.0: 1, 0.4: 3}.get(radius, 4)


def test_doors_have_short_lanes_of_their_own():
    found = straight_lanes(building(), regions(), planner())
    stops, doors = along(found, 0)
    assert doors == ["", "door_3", "door_4", ""]
    np.testing.assert_allclose(found.xy[stops][:, 1], [0.0, 3.0, 4.6, 6.2, 8.0], atol=0.01)
    assert all(lane.door == "" for lane in found.lanes if lane.arc)
    assert [lane.door for lane in straight_lanes(building()).lanes if lane.arc == 0] == [""]


def test_a_door_that_an_arc_passes_beside_is_on_the_nearest_lane_and_one_at_a_node_on_the_last():
    given = regions()
    beside = given.doors[0]._replace(jambs=np.array([[6.5, 4.0], [7.5, 4.0]]))
    at_node = given.doors[1]._replace(xy=np.array([6.0, 8.0]), jambs=[[5.0, 8.0], [7.0, 8.0]])
    at_node = at_node._replace(jambs=np.array(at_node.jambs))
    found = straight_lanes(building(), given._replace(doors=(beside, at_node)), planner())
    stops, doors = along(found, 0)
    assert doors == ["", "door_3", "", "door_4"]
    np.testing.assert_allclose(found.xy[stops][:, 1], [0.0, 3.0, 5.0, 7.0, 8.0], atol=0.01)


def test_an_arc_that_passes_a_door_twice_opens_it_twice():
    graph = building()
    ring = np.array([[6.0, 8.0], [6.1, 3.0], [9.0, 3.0], [9.0, 1.0], [5.9, 1.0], [6.0, 8.0]])
    graph = graph._replace(arc_lines=(*graph.arc_lines[:3], ring))
    data = planner()._replace(arc_doors=((), (), (), (0, 0)))
    found = straight_lanes(graph, regions(), data)
    _, doors = along(found, 3)
    assert doors == ["", "door_3", "", "", "", "", "door_3", ""]


def test_small_loops_are_left_out_and_bad_maps_refused():
    graph = building()
    tiny = np.array([[6.0, 8.0], [6.05, 8.0], [6.0, 8.05], [6.0, 8.0]])
    found = straight_lanes(graph._replace(arc_lines=(*graph.arc_lines[:3], tiny)))
    assert {lane.arc for lane in found.lanes} == {0, 1, 2}
    with pytest.raises(ValueError, match=r"arc_lines\[3\] is"):
        straight_lanes(graph._replace(arc_lines=(*graph.arc_lines[:3], np.zeros(3))))
    with pytest.raises(ValueError, match="not finite"):
        straight_lanes(graph._replace(xy=np.full((4, 2), np.nan)))


def test_lanes_start_at_the_node_where_a_polyline_starts_beside_it():
    graph = building()
    moved = graph.arc_lines[1] + np.array([[0.0, 0.5], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    found = straight_lanes(
        graph._replace(arc_lines=(graph.arc_lines[0], moved, *graph.arc_lines[2:]))
    )
    assert len(along(found, 1)[0]) == 2
