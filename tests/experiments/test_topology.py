import numpy as np
import pytest

from experiments import (
    hall_plans,
    peer_roadmaps,
    plan_drives,
    plan_graph,
    route_measures,
    thinning,
    topology,
    topology_picture,
    waypoint_measures,
)
from experiments.plan_agreement import agreement, branches_of
from experiments.plan_graph import PlanGraph
from experiments.roadmaps import Chains, Ground, Roadmap, grid_graph
from jaxslam.core.maps import OccupancyMap, TopologicalMap
from jaxslam.core.types import JUNCTION
from jaxslam.simulation.worlds import outline, polyline

RADIUS = 0.2


def occupancy(free: np.ndarray, resolution: float = 0.1) -> OccupancyMap:
    return OccupancyMap(~free, free, resolution, np.array([1.0, -2.0, 0.3]))


def two_rooms() -> OccupancyMap:
    """Rooms of 4.9 m by 3.9 m, joined by a door of 1 m."""
    free = np.zeros((100, 40), bool)
    free[1:49, 1:39] = free[50:99, 1:39] = True
    free[49, 15:25] = True
    return occupancy(free)


def roadmap(ground: Ground, cells, pairs) -> Roadmap:
    """Nodes at cells (N, 2), joined by straight arcs."""
    xy, ends = ground.points(np.array(cells)), np.array(pairs, int).reshape(-1, 2)
    return Roadmap(xy, ends, tuple(xy[pair] for pair in ends), np.zeros(len(xy), bool))


def places(ground: Ground, count: int = 200) -> route_measures.Places:
    return route_measures.free_places(np.random.default_rng(0), ground, count)


def measured(ground: Ground, graph: Roadmap) -> dict:
    return route_measures.measure(route_measures.shortest_paths(ground, places(ground)), graph)


def test_points_and_cells_of_a_turned_grid_are_inverse():
    ground = Ground.of_map(two_rooms(), RADIUS)
    cells = np.argwhere(ground.fits)
    back, inside = ground.cells(ground.points(cells))
    np.testing.assert_array_equal(back, cells)
    assert inside.all()
    assert not ground.at(ground.fits, np.array([[1e3, 1e3]])).any()


def test_detour_of_the_grid_itself_is_one():
    ground = Ground.of_map(two_rooms(), RADIUS)
    cells = np.argwhere(ground.fits)
    _, matrix = grid_graph(ground.fits, ground.resolution)
    own = measured(ground, roadmap(ground, cells, np.column_stack(matrix.nonzero())))
    assert own["detour_median"] == pytest.approx(1.0, abs=1e-6)
    assert own["detour_p90"] == pytest.approx(1.0, abs=1e-6)
    assert own["reach"] == own["routed"] == own["covered"] == 1.0
    assert own["blocked"] == 0.0
    assert own["parts"] == 1


def test_detour_of_a_corner_is_that_of_two_sides():
    free = np.zeros((104, 104), bool)
    free[2:102, 2:102] = True
    ground = Ground.of_map(occupancy(free), RADIUS)
    cells = [(6, 6), (6, 97), (97, 97)]
    ends = route_measures.Places(ground.points(np.array(cells)), np.array([[0, 2]]))
    own = route_measures.measure(
        route_measures.shortest_paths(ground, ends), roadmap(ground, cells, [(0, 1), (1, 2)])
    )
    assert own["detour_median"] == pytest.approx(np.sqrt(2.0), rel=1e-3)


def test_routes_count_the_free_path_to_the_graph_and_from_it():
    ground = Ground.of_map(two_rooms(), RADIUS)
    beside = ground.points(np.array([(8, 30), (44, 30)]))
    by = route_measures.shortest_paths(ground, route_measures.Places(beside, np.array([[0, 1]])))
    own = route_measures.measure(by, roadmap(ground, [(4, 20), (90, 20)], [(0, 1)]))
    assert own["detour_median"] == pytest.approx((1.0 + 3.6 + 1.0) / 3.6, rel=0.03)


def test_blocked_parts_and_lonely_nodes_are_counted():
    ground = Ground.of_map(two_rooms(), RADIUS)
    left, right, alone = (20, 20), (80, 20), (30, 5)
    through_door = measured(ground, roadmap(ground, [left, right, alone], [(0, 1)]))
    assert through_door["blocked"] == 0.0
    assert (through_door["parts"], through_door["lonely"]) == (1, 1)
    through_wall = measured(ground, roadmap(ground, [(44, 5), (54, 5)], [(0, 1)]))
    assert through_wall["blocked"] == pytest.approx(0.1, abs=0.06)
    in_two = measured(ground, roadmap(ground, [left, (10, 20), right, (90, 20)], [(0, 1), (2, 3)]))
    assert in_two["parts"] == 2
    assert in_two["routed"] < 0.6


def test_open_ends_are_not_lonely_and_count_only_with_ids():
    line = np.array([[0.0, 0.0], [2.0, 0.0]])
    graph = TopologicalMap(
        id=np.arange(3),
        xy=np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 5.0]]),
        kind=np.full(3, JUNCTION),
        clearance=np.ones(3),
        arc_ends=np.array([[0, 1]]),
        arc_length=np.array([2.0]),
        arc_clearance=np.array([1.0]),
        arc_lines=(line,),
        frontiers=(line + [2.0, 0.0],),
        frontier_node=np.array([1]),
    )
    assert len(Roadmap.of_map(graph).lines) == 1
    own = Roadmap.of_map(graph._replace(frontier_id=np.array([7])))
    assert own.ends.tolist() == [[0, 1], [1, 3]]
    assert own.is_open.tolist() == [False, False, False, True]
    assert Chains.of_roadmap(own).length.sum() == pytest.approx(4.0)


def test_measures_of_waypoints_know_straight_free_and_joined():
    ground = Ground.of_map(two_rooms(), RADIUS)
    rng = np.random.default_rng(0)
    cells = [(10, 20), (40, 20), (90, 20)]
    own = waypoint_measures.measure(rng, ground, roadmap(ground, cells, [(0, 1), (1, 2)]), 50)
    assert own["path_smoothness"] == pytest.approx(1.0)
    assert own["collision_free"] == own["path_success"] == own["coverage"] == 1.0
    assert own["connected"]
    walled = roadmap(ground, [*cells, (44, 5), (54, 5)], [(0, 1), (1, 2), (3, 4)])
    own = waypoint_measures.measure(rng, ground, walled, 200)
    assert own["collision_free"] == pytest.approx(2 / 3)
    assert (own["connected"], own["subgraphs"]) == (False, 2)
    assert 0.2 < own["path_success"] < 0.6
    right_turn = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    assert waypoint_measures.smoothness(right_turn) == pytest.approx(0.5)


def plan() -> np.ndarray:
    """A corridor of 2 m with a crossing one, and a room behind a door."""
    free = [(0.0, 0.0, 12.0, 2.0), (4.0, 2.0, 6.0, 9.0), (6.15, 4.0, 12.0, 8.0)]
    return outline([*free, (6.0, 5.5, 6.15, 6.6)])


def test_graph_of_a_plan_has_its_junctions_and_dead_ends():
    found = plan_graph.plan_graph(plan_graph.branches(plan()), np.array([1.0, 1.0]))
    degree = np.bincount(found.ends.ravel(), minlength=len(found.xy))
    assert sorted(degree) == [1, 1, 1, 1, 3, 3]
    expected = [[1.0, 1.0], [5.0, 8.0], [11.0, 1.0], [10.0, 6.0]]
    ends = found.xy[degree == 1]
    for xy in expected:
        assert np.hypot(*(ends - xy).T).min() < 0.02
    np.testing.assert_allclose(sorted(found.clearance[degree == 1]), [1, 1, 1, 2], atol=0.02)


def test_a_dead_end_of_a_plan_does_not_run_into_a_wedge():
    tip = 8.0 + 1.0 / np.tan(np.radians(32.5))
    walls = polyline([(0.0, 0.0), (8.0, 0.0), (tip, 1.0), (8.0, 2.0), (0.0, 2.0), (0.0, 0.0)])
    found = plan_graph.plan_graph(plan_graph.branches(walls), np.array([4.0, 1.0]))
    ends = found.xy[np.argsort(found.xy[:, 0])]
    last = 8.0 - np.tan(np.radians(32.5 / 2))
    np.testing.assert_allclose(ends, [[1.0, 1.0], [last, 1.0]], atol=0.05)


def test_a_plan_agrees_with_itself_and_not_with_less():
    true = plan_graph.plan_graph(plan_graph.branches(plan()), np.array([1.0, 1.0]))
    same = agreement(true, true)
    np.testing.assert_array_equal(same.node, np.arange(len(true.xy)))
    np.testing.assert_array_equal(same.arc, np.arange(len(true.ends)))
    moved = true._replace(xy=true.xy + [0.0, 0.3])
    assert (agreement(true, moved).node < 0).all()
    less = true._replace(ends=true.ends[1:], lines=true.lines[1:])
    assert np.sum(agreement(true, less).arc < 0) == 1


def test_branches_pass_through_nodes_that_only_split_them():
    xy = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [1.0, 1.0]])
    ends = np.array([[0, 1], [2, 1], [1, 3]])
    lines = tuple(xy[pair] for pair in ends)
    graph = TopologicalMap(
        id=np.arange(4),
        xy=xy,
        kind=np.full(4, JUNCTION),
        clearance=np.ones(4),
        arc_ends=ends,
        arc_length=np.ones(3),
        arc_clearance=np.ones(3),
        arc_lines=lines,
        arc_filled=np.array([False, False, True]),
    )
    found = branches_of(graph, np.array([0.0, 0.0, np.pi / 2]))
    assert isinstance(found, PlanGraph)
    np.testing.assert_allclose(found.xy, [[0.0, 0.0], [0.0, 2.0]], atol=1e-12)
    np.testing.assert_allclose(found.lines[0], [[0.0, 0.0], [0.0, 1.0], [0.0, 2.0]], atol=1e-12)


def test_a_tour_comes_near_all_places_and_keeps_off_walls():
    walls = plan()
    path = plan_drives.tour(walls, 1.5)
    for xy in ((1.0, 1.0), (11.0, 1.0), (5.0, 8.0), (11.0, 7.0)):
        assert np.hypot(*(path - xy).T).min() < 1.6
    assert np.hypot(*np.diff(path, axis=0).T).max() < 0.1
    assert plan_graph.ground_truth.clearance(path, walls).min() > 0.2


def test_halls_are_as_wide_as_they_say():
    for build in hall_plans.BUILDINGS.values():
        walls = build()
        assert np.isfinite(walls).all()
        free = plan_graph.ground_truth.FreeSpace(walls)
        assert free.region.sum() * plan_graph.ground_truth.CELL_SIZE**2 > 350.0


def test_waves_meet_midway():
    free = np.zeros((60, 41), bool)
    free[2:58, 2:39] = True
    fronts = peer_roadmaps.wave_fronts(free, 8.0)
    assert np.flatnonzero(fronts[30]).tolist() == [20]


@pytest.mark.skipif(bool(thinning.missing()), reason="needs scikit-image and sknw")
def test_peers_make_whole_graphs_of_two_rooms():
    ground = Ground.of_map(two_rooms(), RADIUS)
    for peer in peer_roadmaps.available().values():
        own = measured(ground, peer(ground, RADIUS))
        assert own["parts"] == 1
        assert own["routed"] > 0.9


def test_rows_and_picture_of_a_subject(tmp_path):
    room = two_rooms()
    ground = Ground.of_map(room, RADIUS)
    graph = roadmap(ground, [(20, 20), (80, 20)], [(0, 1)])
    poses = ground.points(np.argwhere(ground.fits))
    subject = topology.Subject("log", "rooms", room, poses, {"grid": graph, "merged": graph})
    rows = topology.rows_of(subject, 0, 50)
    assert {row["method"] for row in rows} >= {"grid", "merged"}
    assert "rooms" in topology.line_of(rows[0])
    numbers = {
        "graphs": rows,
        "drawn": {"name": "rooms", **topology_picture.picture_of(room, graph, RADIUS)},
    }
    topology.common.save(tmp_path, "topology", numbers, topology_picture.draw)
    assert (tmp_path / "topology.png").stat().st_size > 10_000


def test_totals_of_plans_are_shares():
    score = {"true_nodes": 4, "nodes": 5, "nodes_found": 4, "true_arcs": 4, "arcs": 4}
    score |= {"arcs_found": 3, "node_errors_m": np.array([0.1, 0.0, 0.1, 0.1])}
    total = topology.totals_of([score, score])
    assert total["nodes_found"] == 1.0
    assert total["nodes_spurious"] == pytest.approx(0.2)
    assert total["arcs_found"] == 0.75
    assert topology.errors_of(score) == 3
    assert topology.totals_of([]) == {}


def test_a_spur_at_the_limit_is_in_some_variants_of_a_plan_alone():
    # A dead end of 1.25 m, whose junction is as far from the walls.
    walls = outline([(0.0, 0.0, 12.0, 2.0), (5.0, 2.0, 7.0, 3.5)])
    ridges, start = plan_graph.branches(walls), np.array([1.0, 1.0])
    sizes = [len(plan_graph.plan_graph(ridges, start, rules).xy) for rules in plan_graph.variants()]
    assert min(sizes) == 2
    assert max(sizes) == 4
