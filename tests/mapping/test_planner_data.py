import made_floor as floor
import numpy as np
import pytest
from made_floor import graph, straight_graph

from jaxslam.core import polylines
from jaxslam.core.maps import OccupancyMap
from jaxslam.core.regions import Regions
from jaxslam.io.route_labels import arc_clearances
from jaxslam.mapping.planner_data import doors_crossed, planner_data, region_at


@pytest.mark.parametrize("with_cells", [True, False])
def test_points_lie_in_the_region_that_holds_them(with_cells):
    regions = floor.regions(with_cells)
    points = floor.at((1.0, 5.0), (11.0, 4.0), (6.05, 4.5), (3.0, 2.0), (99.0, 9.0), (2.5, 3.1))
    np.testing.assert_array_equal(region_at(regions, points), [0, 1, -1, 2, -1, -1])


def test_of_nested_polygons_the_smallest_counts():
    regions = floor.regions(with_cells=False)
    outer = regions.regions[0]._replace(polygon=floor.at((0, 0), (12, 0), (12, 7), (0, 7)))
    nested = regions._replace(regions=(outer._replace(area=84.0), *regions.regions[1:]))
    np.testing.assert_array_equal(region_at(nested, floor.at((8.0, 5.0), (2.0, 5.0))), [1, 0])


def test_doors_are_those_that_a_line_crosses_in_its_direction():
    line = floor.at((2.5, 2.0), (2.5, 4.5), (9.3, 4.5), (9.3, 2.0), (0.5, 2.0))
    doors = floor.regions().doors
    assert doors_crossed(doors, line) == [(0, 0), (1, 2), (2, 1)]
    assert [door for _, door in doors_crossed(doors, line[::-1])] == [1, 2, 0]
    assert doors_crossed(doors, floor.at((1.5, 2.0), (1.5, 4.0))) == []  # beside the door
    assert doors_crossed((), line) == []


@pytest.mark.parametrize("shift", [0.0, 1e-9, -1e-9])
@pytest.mark.parametrize("first", [1, -1])
@pytest.mark.parametrize("second", [1, -1])
def test_arcs_that_meet_on_the_line_of_a_door_both_have_it(first, second, shift):
    """The node is in door_1, the arcs are stored in either direction."""
    ends = floor.at((2.5, 2.0), (2.5, 3.1 + shift), (2.6, 4.5))
    pairs = [(0, 1)[::first], (1, 2)[::second]]
    found = planner_data(straight_graph(ends, pairs), floor.occupancy(), floor.regions())
    assert found.arc_doors == ((0,), (0,))


@pytest.mark.parametrize("along", [1, -1])
@pytest.mark.parametrize(
    "points, wanted",
    [
        ([(2.5, 2.0), (2.5, 3.1), (2.5, 4.5)], [0]),
        ([(2.5, 2.0), (2.5, 3.1), (2.5, 3.1), (2.5, 4.5)], [0]),
        ([(2.5, 2.0), (2.5, 3.1), (2.5, 3.1)], [0]),
        ([(2.5, 2.0), (2.5, 3.099)], []),
        ([(2.5, 2.0), (2.5, 3.1), (2.6, 2.0)], [0]),
        ([(2.5, 2.0), (2.5, 4.0), (2.6, 4.0), (2.6, 2.0)], [0, 0]),
        ([(9.3, 3.1), (9.3, 4.5), (2.5, 4.5), (2.5, 3.1)], [1, 2, 0]),
    ],
)
def test_a_door_at_a_point_of_a_line_is_crossed_once(points, wanted, along):
    line, regions = floor.at(*points)[::along], floor.regions()
    wanted = wanted[::along]
    assert [door for _, door in doors_crossed(regions.doors, line)] == wanted
    made = straight_graph(line[[0, -1]], [(0, 1)], (line,))
    found = planner_data(made, floor.occupancy(), regions)
    assert found.arc_doors == (tuple(dict.fromkeys(wanted)),)


def test_planner_data_of_the_made_floor():
    made = straight_graph(
        floor.at((1.0, 2.1), (11.0, 2.1), (2.5, 5.0), (9.3, 5.0)), [(0, 1), (0, 2), (3, 2), (1, 3)]
    )
    lines = list(made.arc_lines)
    lines[1] = floor.at((1.0, 2.1), (2.5, 2.1), (2.5, 5.0))
    # 1.5 + 0.9 m in the corridor, 1.8 m in room_1; 3.7 m in room_2, 3.4 + 0.5 m in room_1
    lines[2] = floor.at((9.3, 5.0), (9.3, 4.5), (2.5, 4.5), (2.5, 5.0))
    found = planner_data(made._replace(arc_lines=tuple(lines)), floor.occupancy(), floor.regions())
    assert found.node_region.tolist() == [2, 2, 0, 1]
    assert found.arc_region.tolist() == [2, 2, 0, 1]
    assert found.arc_doors[:3] == ((), (0,), (2,))


def test_widths_are_distances_to_the_nearest_obstacle():
    grid = floor.occupancy()
    found = planner_data(graph(), grid, None)
    walls = np.argwhere(grid.occupied) + 0.5
    for line, widths in zip(graph().arc_lines, found.arc_widths, strict=True):
        places = polylines.resample(line, len(widths))
        assert polylines.length(line) / (len(widths) - 1) <= 0.05
        cells = floor_cells(places)
        nearest = np.hypot(*(cells[:, None] - walls).transpose(2, 0, 1)).min(axis=1)
        np.testing.assert_allclose(widths, 0.1 * (nearest - 0.5), atol=2e-3)
    assert (found.node_region == -1).all() and set(found.arc_doors) == {()}


def floor_cells(points):
    x, y, angle = floor.ORIGIN
    c, s = np.cos(angle), np.sin(angle)
    return (points - [x, y]) @ np.array([[c, -s], [s, c]]) / floor.RESOLUTION


def test_open_ends_know_the_doors_before_them():
    behind, beside = floor.at((2.5, 2.1), (2.5, 5.0)), floor.at((2.5, 2.1), (3.0, 2.1))
    made = graph()._replace(frontiers=(behind, beside), frontier_node=np.array([0, 0]))
    found = planner_data(made, floor.occupancy(), floor.regions())
    assert found.frontier_doors == ((0,), ())
    assert planner_data(made, floor.occupancy()).frontier_doors == ()


def test_what_lies_beyond_the_map_has_no_width():
    made = straight_graph(floor.at((11.0, 2.1), (20.0, 2.1)), [(0, 1)])
    (widths,) = planner_data(made, floor.occupancy()).arc_widths
    assert widths[0] == pytest.approx(0.65, abs=0.06) and np.isnan(widths[-1])


def test_the_profile_of_a_straight_arc_knows_the_door_between_its_ends():
    """A wall across, 0.2 m thick, with a door of 1 m, and an arc of two points through it."""
    free = np.ones((100, 60), bool)
    free[[0, -1]], free[:, [0, -1]], free[48:52] = False, False, False
    free[48:52, 20:40] = True
    grid = OccupancyMap(~free, free, 0.05, np.zeros(3))
    made = straight_graph(np.array([[1.0, 1.5], [4.0, 1.5]]), [(0, 1)])
    data = planner_data(made, grid)
    (widths,) = data.arc_widths
    np.testing.assert_allclose(widths[[0, -1]], 0.95, atol=0.05)
    assert arc_clearances(made, data)[0] == pytest.approx(0.5, abs=0.05)


def test_arcs_of_coarse_maps_are_sampled_by_the_cell(monkeypatch):
    counts, resample = [], polylines.resample
    monkeypatch.setattr(
        polylines, "resample", lambda line, count: counts.append(count) or resample(line, count)
    )
    grid = floor.occupancy()._replace(resolution=1e3 * floor.RESOLUTION)
    coarse = graph()._replace(arc_lines=tuple(1e3 * line for line in graph().arc_lines))
    planner_data(coarse, grid, floor.regions())
    assert counts and max(counts) < 1000


def test_a_map_without_nodes_has_no_data():
    bare = straight_graph(np.zeros((0, 2)), np.zeros((0, 2), int))
    found = planner_data(bare, floor.occupancy(), floor.regions())
    assert found.node_region.shape == found.arc_region.shape == (0,)
    assert found.arc_doors == found.arc_widths == ()


def test_other_types_are_refused():
    with pytest.raises(ValueError, match="regions is str, not Regions"):
        planner_data(graph(), floor.occupancy(), "rooms")
    assert isinstance(floor.regions(), Regions)
