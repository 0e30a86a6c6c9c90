"""Routes between any two points: laws, and independent references."""

import made_floor as floor
import networkx
import numpy as np
import pytest
from made_floor import RADIUS, graph, straight_graph

from jaxslam.core.maps import OccupancyMap
from jaxslam.core.polylines import refine
from jaxslam.mapping import drivable, extract_topology, route
from jaxslam.mapping.clearance import clearance_at, clearance_field
from jaxslam.mapping.route_legs import describe


def planned(start, goal, radius=RADIUS, **options):
    """A route on the made floor; points are in the frame of its grid."""
    goal = goal if isinstance(goal, str) else floor.at(goal)[0]
    given = {"occupancy": floor.occupancy(), "regions": floor.regions(), "robot_radius": radius}
    return route(graph(), floor.at(start)[0], goal, **(given | options))


def grid_length(start, goal, radius, grid):
    """Length [m] of the shortest path over the eight neighbours of cells, by networkx."""
    field, steps = clearance_field(grid), networkx.Graph()
    free = {tuple(cell) for cell in np.argwhere(field.free & (field.distance >= radius)).tolist()}
    for i, j in free:
        for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
            if {(i + di, j + dj), (i + di, j), (i, j + dj)} <= free:
                steps.add_edge((i, j), (i + di, j + dj), weight=0.1 * np.hypot(di, dj))
    ends = [tuple((10 * np.array(xy)).astype(int).tolist()) for xy in (start, goal)]
    return networkx.dijkstra_path_length(steps, *ends)


POINTS = [(1.05, 5.05), (5.05, 3.65), (7.05, 5.45), (11.05, 3.65), (0.85, 2.05), (11.05, 2.35)]
PAIRS = [(a, b) for k, a in enumerate(POINTS) for b in POINTS[k + 1 :]]


@pytest.mark.parametrize("start, goal", PAIRS)
def test_a_route_is_about_as_short_as_free_space_allows_and_free(start, goal):
    found = planned(start, goal)
    np.testing.assert_allclose(found.line[[0, -1]], floor.at(start, goal), atol=1e-9)
    assert found.length == pytest.approx(np.hypot(*np.diff(found.line, axis=0).T).sum())
    assert found.length >= np.hypot(*np.subtract(start, goal)) - 1e-9
    shortest = grid_length(start, goal, RADIUS, floor.occupancy())
    assert 0.92 * shortest < found.length < 1.15 * shortest
    clearance = clearance_at(clearance_field(floor.occupancy()), refine(found.line, 0.02))
    assert clearance.min() >= RADIUS - 0.5 * floor.RESOLUTION
    assert found.clearance == pytest.approx(clearance.min(), abs=0.02)


@pytest.mark.parametrize("start, goal", PAIRS[::2])
def test_the_route_back_is_the_route_there(start, goal):
    there, back = planned(start, goal), planned(goal, start)
    assert there.length == pytest.approx(back.length)
    np.testing.assert_allclose(there.line, back.line[::-1], atol=1e-6)


@pytest.mark.parametrize("start, goal", PAIRS[::2])
def test_routes_of_wider_robots_are_not_shorter(start, goal):
    lengths = [planned(start, goal, radius).length for radius in (0.05, 0.2, 0.3, 0.45)]
    assert all(b > a - 0.1 for a, b in zip(lengths[:-1], lengths[1:], strict=True))


def test_who_sees_the_goal_goes_straight():
    found = planned((0.6, 1.6), (11.2, 2.6))
    assert found.arcs == () and len(found.line) == 2
    assert found.length == pytest.approx(np.hypot(10.6, 1.0))


def test_a_wide_robot_goes_around_by_the_wide_doors():
    start, goal = (9.3, 2.2), (9.3, 4.5)  # on both sides of door_2, of 0.6 m
    assert [leg.door for leg in planned(start, goal).legs] == ["door_2", None]
    found = planned(start, goal, 0.4)
    assert [leg.door for leg in found.legs if leg.door] == ["door_1", "door_3"]
    assert found.length > 15.0


def test_a_robot_too_wide_for_the_doors_is_refused_with_the_narrowest_place():
    start, goal = (3.0, 4.6), (3.0, 2.1)
    problem = (
        r"^no route leads from \(-3.49, 7.28\) to \(-2.75, 4.89\): its door door_1 is 1.00 m wide, "
        r"the robot 1.20 m$"
    )
    with pytest.raises(ValueError, match=problem):
        planned(start, goal, 0.6)
    with pytest.raises(ValueError, match=r"narrowest place, at \(-3.\d\d, 5.\d\d\), is 0.4[56] m"):
        planned(start, goal, 0.6, regions=None)


def test_parts_that_nothing_joins_are_named():
    closed = floor.occupancy(closed=("door_1", "door_2"))
    with pytest.raises(ValueError, match="they are in separate parts of the map$"):
        apart = extract_topology(
            closed.occupied,
            closed.free,
            resolution=floor.RESOLUTION,
            origin=floor.ORIGIN,
            robot_radius=RADIUS,
            min_region_area=1.0,
        ).graph
        route(apart, *floor.at((1.0, 5.0), (1.0, 2.0)), occupancy=closed)


def test_arcs_of_one_direction_are_driven_in_that_direction_alone():
    ring = int(np.argmin(graph().arc_clearance))  # through all three doors
    assert graph().arc_clearance[ring] < 0.3
    directed = np.arange(len(graph().arc_lines)) == ring
    lengths = {}
    for name, start, goal in (("there", (1.2, 4.5), (9.3, 4.5)), ("back", (9.3, 4.5), (1.2, 4.5))):
        free = planned(start, goal)
        found = planned(start, goal, directed=directed)
        lengths[name] = found.length / free.length
        along = np.linspace(0.1, 0.9, 9) * found.length
        doors = [leg.door for leg in found.legs if leg.door]
        assert doors in (["door_3"], ["door_1", "door_2"], ["door_2", "door_1"]) and len(along)
    assert min(lengths.values()) == pytest.approx(1.0)
    assert max(lengths.values()) > 1.3  # the other way around


def test_a_dead_end_of_one_direction_is_named():
    lines = (np.array([[0.0, 0.0], [5.0, 0.0]]),)
    single = straight_graph(np.array([[0.0, 0.0], [5.0, 0.0]]), [(0, 1)], lines)
    found = route(single, [1.0, 0.2], [4.0, 0.0], directed=[True])
    assert found.length == pytest.approx(3.2, abs=0.06)
    with pytest.raises(ValueError, match="one-way arcs lead in the other direction$"):
        route(single, [4.0, 0.0], [1.0, 0.2], directed=[True])


@pytest.mark.parametrize("seed", range(4))
def test_routes_from_arc_to_arc_are_those_of_networkx(seed):
    random = np.random.default_rng(seed)
    xy = random.uniform(0.0, 20.0, (12, 2))
    every = [(a, b) for a in range(12) for b in range(a)]
    pairs = [every[k] for k in random.choice(len(every), 16, replace=False)]
    made = straight_graph(xy, pairs)
    net = networkx.Graph()
    for a, b in pairs:
        net.add_edge(a, b, weight=np.hypot(*(xy[a] - xy[b])))
    ends = []
    chosen = random.choice(16, 2, replace=False)
    for name, k, fraction in zip("SG", chosen, random.uniform(size=2), strict=True):
        a, b = pairs[k]  # of crossing arcs the point is on this one and on no other
        ends.append(xy[a] + fraction * (xy[b] - xy[a]))
        net.add_edge(name, a, weight=fraction * np.hypot(*(xy[a] - xy[b])))
        net.add_edge(name, b, weight=(1 - fraction) * np.hypot(*(xy[a] - xy[b])))
    if not networkx.has_path(net, "S", "G"):
        with pytest.raises(ValueError, match="separate parts of the map"):
            route(made, *ends)
        return
    found = route(made, *ends)
    assert found.length == pytest.approx(networkx.dijkstra_path_length(net, "S", "G"), abs=1e-6)
    np.testing.assert_allclose(found.line[[0, -1]], ends, atol=1e-9)


def test_a_room_as_a_goal_is_entered_by_its_nearest_door():
    found = planned((11.0, 2.1), "room_2")
    assert [leg.door for leg in found.legs] == ["door_2", None]
    assert [leg.region for leg in found.legs] == ["room_3", "room_2"]
    doors = np.array([door.xy for door in floor.regions().doors[1:]])
    assert np.hypot(*(doors - found.line[-1]).T).min() >= 1.0
    assert found.length < planned((11.0, 2.1), (6.6, 4.5)).length
    assert [leg.door for leg in planned((1.0, 2.0), "room_2", 0.4).legs][-2] == "door_3"


def test_a_room_without_arcs_is_entered_up_to_its_middle():
    bare = straight_graph(floor.at((1.0, 2.1), (11.0, 2.1)), [(0, 1)])
    for with_cells in (True, False):
        regions = floor.regions(with_cells)
        given = {"occupancy": floor.occupancy(), "regions": regions, "robot_radius": RADIUS}
        found = route(bare, floor.at((8.0, 2.1))[0], "room_2", **given)
        assert [leg.door for leg in found.legs] == ["door_2", None]
        assert 4.0 < floor_y(found.line[-1]) < 5.2


def floor_y(point):
    x, y, angle = floor.ORIGIN
    return np.cos(angle) * (point[1] - y) - np.sin(angle) * (point[0] - x)


def test_legs_follow_each_other_and_read_well():
    found = planned((8.0, 1.5), (2.5, 5.7))
    assert sum(leg.length for leg in found.legs) == pytest.approx(found.length)
    for leg, following in zip(found.legs[:-1], found.legs[1:], strict=True):
        np.testing.assert_array_equal(leg.line[-1], following.line[0])
    assert found.clearance == min(leg.clearance for leg in found.legs)
    lines = describe(found.legs, "the goal")
    assert lines[0].endswith(" m along the corridor room_3 to the door door_1 (1.00 m wide)")
    assert lines[0].startswith("heading ")
    assert lines[-1].endswith(" m in room_1 to the goal")
    assert "turn right, " in lines[1]
    mirrored = describe(planned((2.5, 5.7), (8.0, 1.5)).legs, "the goal")
    assert "turn left, " in " ".join(mirrored)


def test_where_no_door_is_known_a_leg_ends_as_another_region_begins():
    bare = floor.regions()._replace(doors=())
    bare = bare._replace(regions=tuple(region._replace(doors=()) for region in bare.regions))
    found = planned((8.0, 1.5), (2.5, 5.7), regions=bare)
    assert [leg.region for leg in found.legs] == ["room_3", "room_1"]
    assert floor_y(found.legs[0].line[-1]) == pytest.approx(3.2, abs=0.1)


def test_a_leg_ends_where_the_route_turns_at_a_junction():
    xy = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [9.0, 0.0]])
    made = straight_graph(xy, [(0, 1), (1, 2), (1, 3)])
    found = route(made, xy[0], xy[2])
    assert [leg.length for leg in found.legs] == pytest.approx([4.0, 3.0])
    assert [leg.turn for leg in found.legs] == pytest.approx([0.0, np.pi / 2])
    assert [leg.arcs for leg in found.legs] == [(0,), (1,)]
    assert describe(found.legs, "F") == ["heading 0 deg, 4.0 m", "turn left, 3.0 m to F"]
    assert describe(route(made, xy[2], xy[0]).legs, "F")[1] == "turn right, 4.0 m to F"
    assert len(route(made, xy[0], xy[3]).legs) == 1  # straight on


def test_no_path_leads_between_two_cells_that_touch_at_a_corner():
    free = np.zeros((30, 30), bool)
    free[1:15, 1:15] = free[15:29, 15:29] = True  # these touch at one corner
    free[27:29, 1:29] = free[1:29, 1:3] = True  # around the other corner
    grid = OccupancyMap(~free, free, 0.1, np.zeros(3))
    bare = straight_graph(np.zeros((0, 2)), np.zeros((0, 2), int))
    found = route(bare, [1.35, 1.35], [1.65, 1.65], occupancy=grid, robot_radius=0.0)
    assert found.length > 3.0


@pytest.mark.parametrize("size, detour", [(1, False), (3, True)])
def test_specks_of_noise_are_no_obstacles(size, detour):
    grid = floor.occupancy()
    grid.occupied[50 : 50 + size, 21 : 21 + size] = True
    grid.free[50 : 50 + size, 21 : 21 + size] = False
    found = planned((2.05, 2.15), (8.05, 2.15), occupancy=grid)
    assert (found.length > 6.001) == detour
    assert found.clearance > RADIUS - 0.05


def test_arcs_far_from_the_start_are_found():
    free = np.zeros((160, 60), bool)
    free[1:159, 1:59] = True
    free[1:150, 30] = False  # a wall; start and goal are on both sides of its left end
    grid = OccupancyMap(~free, free, 0.1, np.zeros(3))
    far = straight_graph(np.array([[15.4, 1.0], [15.4, 5.0]]), [(0, 1)])
    found = route(far, [1.0, 2.0], [1.0, 4.0], occupancy=grid)
    assert found.arcs == (0,) and 28.0 < found.length < 32.0


def test_a_route_to_its_start_has_no_length():
    found = planned((1.0, 5.0), (1.0, 5.0))
    assert found.length == 0.0 and found.line.shape == (2, 2) and len(found.legs) == 1


def test_without_an_occupancy_map_it_goes_straight_to_the_nearest_arc():
    made = straight_graph(np.array([[0.0, 0.0], [10.0, 0.0]]), [(0, 1)])
    found = route(made, [2.0, 0.3], [8.0, -0.4])
    assert found.length == pytest.approx(0.3 + 6.0 + 0.4)
    np.testing.assert_allclose(found.line, [[2, 0.3], [2, 0], [8, 0], [8, -0.4]], atol=1e-9)
    assert found.clearance == 1.0 and found.arcs == (0,)
    with pytest.raises(ValueError, match=r"start \(2.00, 5.30\) is 5.3 m from the nearest arc"):
        route(made, [2.0, 5.3], [8.0, -0.4])
    with pytest.raises(ValueError, match=r"narrowest place.* is 1.00 m .* needs 1.20 m"):
        route(made, [2.0, 0.3], [8.0, 0.0], robot_radius=1.2)
    unknown = made._replace(arc_clearance=np.array([np.nan]))
    with pytest.raises(ValueError, match="the width of an arc to it is not known"):
        route(unknown, [2.0, 0.3], [8.0, 0.0])
    assert np.isnan(route(unknown, [2.0, 0.3], [8.0, 0.0], robot_radius=0.0).clearance)


@pytest.mark.parametrize("options", [{}, {"directed": [True]}, {"robot_radius": 2.0}])
@pytest.mark.parametrize("xy", [(2.0, 0.0), (2.0, 3.0), (-3.0, 2.0), (0.0, 0.0)])
def test_without_an_occupancy_map_a_route_to_its_start_has_no_length(xy, options):
    made = straight_graph(np.array([[0.0, 0.0], [10.0, 0.0]]), [(0, 1)])
    found = route(made, xy, xy, **options)
    np.testing.assert_array_equal(found.line, [xy, xy])
    assert found.length == 0.0 and np.isnan(found.clearance) and found.arcs == ()
    (leg,) = found.legs
    assert leg.length == 0.0 and np.isnan(leg.clearance) and leg.arcs == ()


@pytest.mark.parametrize(
    "start, goal, length",
    [
        ((2.0, 0.3), (2.03, -0.1), 0.3 + 0.03 + 0.1),  # on one piece of the arc
        ((2.03, 0.0), (2.0, 0.0), 0.03),
        ((1.91, 0.0), (2.09, 0.0), 0.18),  # on two pieces
        ((2.09, 0.2), (1.97, 0.2), 0.12 + 0.4),
        ((-1.0, 0.0), (0.02, 1.0), 1.0 + 0.02 + 1.0),
    ],
)
def test_between_two_places_of_an_arc_a_route_follows_it(start, goal, length):
    made = straight_graph(np.array([[0.0, 0.0], [10.0, 0.0]]), [(0, 1)], clearance=0.7)
    found = route(made, start, goal)
    assert found.length == pytest.approx(length)
    assert found.clearance == 0.7 and found.arcs == (0,)


@pytest.mark.parametrize(
    "start, goal", [((2.0, 0.3), (2.0, -0.3)), ((-1.0, 1.0), (-1.1, 1.0)), ((0.0, 1.0), (0.0, 2.0))]
)
def test_of_a_route_to_an_arc_and_back_no_clearance_is_known(start, goal):
    made = straight_graph(np.array([[0.0, 0.0], [10.0, 0.0], [5.0, 8.0]]), [(0, 1), (1, 2)])
    made = made._replace(arc_clearance=np.array([1.0, 3.0]))
    found = route(made, start, goal)
    foot = [max(start[0], 0.0), 0.0]
    assert found.length == pytest.approx(
        sum(np.hypot(*np.subtract(x, foot)) for x in (start, goal))
    )
    assert np.isnan(found.clearance) and found.arcs == ()
    assert all(np.isnan(leg.clearance) and leg.arcs == () for leg in found.legs)
    alone = straight_graph(made.xy[:2], [(0, 1)])
    with pytest.raises(ValueError, match="its narrowest place.* is 1.00 m .* needs 1.20 m"):
        route(alone, start, goal, robot_radius=1.2)


def test_without_an_occupancy_map_a_leg_has_the_clearance_of_its_own_arcs():
    xy = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [9.0, 0.0]])
    made = straight_graph(xy, [(0, 1), (1, 2), (1, 3)])
    made = made._replace(arc_clearance=np.array([1.0, 0.3, 0.8]))
    found = route(made, [1.0, 2.0], [2.0, 3.0], robot_radius=0.3)
    np.testing.assert_allclose([leg.clearance for leg in found.legs], [np.nan, 1.0, 0.3, np.nan])
    assert found.clearance == 0.3 and found.arcs == (0, 1)


def test_a_goal_just_behind_on_an_arc_of_one_direction_is_refused():
    made = straight_graph(np.array([[0.0, 0.0], [10.0, 0.0]]), [(0, 1)])
    assert route(made, [1.01, 0.1], [1.03, 0.1], directed=[True]).arcs == (0,)
    with pytest.raises(ValueError, match="one-way arcs lead in the other direction$"):
        route(made, [1.03, 0.1], [1.01, 0.1], directed=[True])


def test_the_arcs_that_a_robot_can_drive():
    given = {"occupancy": floor.occupancy()}
    assert len(drivable(graph(), RADIUS, **given).arc_ends) == len(graph().arc_ends)
    assert len(drivable(graph(), 0.4, **given).arc_ends) == len(graph().arc_ends) - 1
    wide = drivable(graph(), 5.0, **given)
    assert len(wide.arc_ends) == 0 and len(wide.xy) == len(graph().xy)
    unknown = graph()._replace(arc_clearance=np.full(len(graph().arc_ends), np.nan))
    assert len(drivable(unknown, RADIUS).arc_ends) == 0
    assert len(drivable(unknown, 0.0).arc_ends) == len(graph().arc_ends)
    assert len(drivable(unknown, RADIUS, **given).arc_ends) == len(graph().arc_ends)


@pytest.mark.parametrize(
    "start, problem",
    [
        ((6.0, 3.1), r"^start \(-0.18, 6.73\) is in a wall$"),
        ((6.05, 6.65), r"^start .* is in unknown space$"),
        ((30.0, 3.0), r"^start .* is outside of the map, which reaches x -7.1 to 6.6 m, y 2.0 to"),
        (
            (1.05, 1.35),
            r"^start .* is 0.15 m from an obstacle, nearer than the robot radius of 0.2",
        ),
        ((np.nan, 1.0), r"^start \(nan, nan\) is not finite$"),
    ],
)
def test_a_start_that_does_not_do_is_named(start, problem):
    with pytest.raises(ValueError, match=problem):
        planned(start, (1.0, 2.0))
    with pytest.raises(ValueError, match=problem.replace("start", "goal")):
        planned((1.0, 2.0), start)


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"goal": "room_4"}, "goal is 'room_4', no room of the map; it has room_3, room_2, room_1"),
        ({"goal": "room_1", "regions": None}, "goal is 'room_1', and the map has no rooms"),
        ({"goal": [1.0]}, r"goal is float64 \(1,\)"),
        ({"radius": np.nan}, "robot_radius is nan, not a number of metres >= 0"),
        ({"radius": -1.0}, "robot_radius is -1.0, not a number of metres >= 0"),
        ({"radius": None}, r"robot_radius is object \(\), not numbers"),
        ({"radius": "a"}, r"robot_radius is <U1 \(\), not numbers"),
        ({"directed": [True]}, r"directed is bool \(1,\), not bool \(4,\)"),
        ({"occupancy": 3}, "occupancy is int, not OccupancyMap"),
        ({"regions": 3}, "regions is int, not Regions"),
    ],
)
def test_route_names_the_argument_that_does_not_fit(wrong, problem):
    given = {"start": (1.0, 2.0), "goal": (5.0, 2.0)} | wrong
    with pytest.raises(ValueError, match=problem):
        if isinstance(given["goal"], list):
            route(graph(), [0.0, 0.0], given["goal"])
        planned(**given)


def test_a_map_without_arcs_joins_what_see_each_other_alone():
    free = np.ones((40, 40), bool)
    grid = OccupancyMap(~free, free, 0.1, np.zeros(3))
    bare = straight_graph(np.zeros((0, 2)), np.zeros((0, 2), int))
    assert route(bare, [1.0, 1.0], [3.0, 3.0], occupancy=grid).length == pytest.approx(8**0.5)
    with pytest.raises(ValueError, match="^the map has no arcs, and without an occupancy map"):
        route(bare, [1.0, 1.0], [3.0, 3.0])


@pytest.mark.parametrize("radius", [None, "a", -0.1, np.nan, np.inf, True, [0.2]])
def test_drivable_names_a_radius_that_is_no_length(radius):
    with pytest.raises(ValueError, match="^robot_radius is "):
        drivable(graph(), radius)


def test_numbers_of_any_kind_are_taken():
    grid = floor.occupancy()._replace(resolution=np.float32(0.1), origin=floor.ORIGIN.tolist())
    found = planned((1.0, 5.0), (8.0, 2.0), np.float32(RADIUS), occupancy=grid)
    assert found.length == pytest.approx(planned((1.0, 5.0), (8.0, 2.0)).length, abs=1e-3)
