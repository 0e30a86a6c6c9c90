import jax
import jax.numpy as jnp
import networkx
import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxslam.mapping import cell_graph, cell_graph_cleanup, grid_topology, medial_axis

CELL = 0.1  # [m]
CLEARANCE = 0.25  # [m]
EIGHT = np.ones((3, 3), bool)
SEEDS = range(4)


def carved(shape, *boxes):
    """Free cells (H, W): these boxes (i0, i1, j0, j1) of a solid grid."""
    free = np.zeros(shape, bool)
    for i0, i1, j0, j1 in boxes:
        free[i0:i1, j0:j1] = True
    return free


def clutter(seed, shape=(90, 120), things=14):
    """Free cells of a room with boxes and pillars, with the jagged walls that a scanner sees."""
    random = np.random.default_rng(seed)
    free = carved(shape, (4, shape[0] - 4, 4, shape[1] - 4))
    for _ in range(things):
        i, j = random.integers(8, np.array(shape) - 8)
        height, width = random.integers(2, 16, 2)
        free[i : i + height, j : j + width] = False
    rough = ndimage.binary_dilation(~free, EIGHT) & (random.random(shape) < 0.3)
    return free & ~rough


def topology_of(free, occupied=None, **options):
    occupied = ~free if occupied is None else occupied
    given = {"resolution": CELL, "origin": np.zeros(3), "robot_radius": CLEARANCE} | options
    return grid_topology.extract_topology(occupied, free, **given)


def multigraph(graph):
    net = networkx.MultiGraph()
    net.add_nodes_from(range(len(graph.id)))
    net.add_edges_from(graph.arc_ends.tolist())
    return net


def holes(cells):
    """Number of background components within cells (H, W), which are 8-connected."""
    return ndimage.label(np.pad(~cells, 1, constant_values=True))[1] - 1


def along(line, step=0.02):
    """Points (n, 2) along a polyline."""
    pieces = [
        a + np.linspace(0, 1, 2 + int(np.hypot(*(b - a)) / step))[:, None] * (b - a)
        for a, b in zip(line[:-1], line[1:], strict=True)
    ]
    return np.concatenate(pieces)


def degrees(graph):
    return np.bincount(graph.arc_ends.ravel(), minlength=len(graph.id))


@pytest.mark.parametrize("pattern", range(256))
def test_simple_cells_change_neither_components_nor_holes(pattern):
    block = np.zeros((5, 5), bool)
    for k, (i, j) in enumerate(medial_axis._ROUND):
        block[2 + i, 2 + j] = pattern >> k & 1

    def count(cells):
        return ndimage.label(cells, EIGHT)[1], holes(cells)

    without = count(block)
    block[2, 2] = True
    assert medial_axis._SIMPLE[pattern] == (count(block) == without)
    assert medial_axis._COUNT[pattern] == block.sum() - 1


@pytest.mark.parametrize("seed", SEEDS)
def test_medial_cells_have_the_components_and_holes_of_the_free_configurations(seed):
    free = clutter(seed)
    space = medial_axis.free_configurations(free, clearance=2.5)
    inside = space.region > 0
    kept = medial_axis.between_walls(space, ~free, angle=grid_topology.DEAD_END_ANGLE)
    cells = medial_axis.medial_cells(space, inside, kept)
    assert not (cells & ~inside).any() and cells.sum() < 0.2 * inside.sum()
    assert ndimage.label(cells, EIGHT)[1] == ndimage.label(inside, EIGHT)[1] == space.region.max()
    assert holes(cells) == holes(inside) > 1


@pytest.mark.parametrize("seed", SEEDS)
def test_distance_is_that_to_the_nearest_cell_that_is_not_free(seed):
    free = clutter(seed)
    space = medial_axis.free_configurations(free, clearance=2.5)
    away = cKDTree(np.argwhere(~free)).query(np.argwhere(free))[0] - 0.5
    np.testing.assert_allclose(space.distance[free], away)
    sizes = np.bincount(space.region[space.region > 0])[1:]
    np.testing.assert_array_equal(space.region_sizes, sizes)
    assert (np.diff(sizes) <= 0).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_region_is_one_graph_with_a_ring_around_each_obstacle(seed):
    free = clutter(seed)
    found = topology_of(free)
    space = medial_axis.free_configurations(free, clearance=CLEARANCE / CELL)
    net = multigraph(found.graph)
    assert networkx.number_connected_components(net) == found.num_regions == 1
    assert len(net.edges) - len(net.nodes) + 1 == holes(space.region == 1) > 1
    assert found.reached_area == pytest.approx(np.sum(space.region == 1) * CELL**2)


@pytest.mark.parametrize("seed", SEEDS)
def test_all_regions_together_have_as_many_components_and_rings(seed):
    free = clutter(seed)
    free[30:34] = free[:, 60:64] = False
    found = topology_of(free, min_region_area=0.0)
    inside = medial_axis.free_configurations(free, clearance=CLEARANCE / CELL).region
    net = multigraph(found.graph)
    assert networkx.number_connected_components(net) == found.num_regions == inside.max() > 3
    assert len(net.edges) - len(net.nodes) + found.num_regions == holes(inside > 0)
    assert found.unreached_area == 0.0


@pytest.mark.parametrize("seed", SEEDS)
def test_spurs_are_longer_than_the_clearance_at_their_root(seed):
    graph = topology_of(clutter(seed)).graph
    degree = degrees(graph)
    loops = graph.arc_ends[graph.arc_ends[:, 0] == graph.arc_ends[:, 1], 0]
    assert set(np.flatnonzero(degree == 2)) <= set(loops)
    spurs = 0
    for (a, b), length in zip(graph.arc_ends, graph.arc_length, strict=True):
        for root, tip in ((a, b), (b, a)):
            if degree[tip] == 1:
                spurs += 1
                assert length > graph.clearance[root]
    assert spurs > 0


@pytest.mark.parametrize("seed", SEEDS)
def test_lines_join_their_nodes_and_keep_their_clearance(seed):
    free = clutter(seed)
    graph = topology_of(free).graph
    walls = cKDTree((np.argwhere(~free) + 0.5) * CELL)

    def away(points):
        return walls.query(points)[0] - 0.5 * CELL

    np.testing.assert_allclose(away(graph.xy), graph.clearance)
    assert (graph.clearance >= CLEARANCE).all() and len(graph.arc_lines) == len(graph.arc_ends)
    for (a, b), line, length, narrow in zip(
        graph.arc_ends, graph.arc_lines, graph.arc_length, graph.arc_clearance, strict=True
    ):
        np.testing.assert_allclose(line[[0, -1]], graph.xy[[a, b]])
        assert length == pytest.approx(np.hypot(*np.diff(line, axis=0).T).sum())
        assert away(along(line)).min() == pytest.approx(narrow, abs=0.05 * CELL)
        assert narrow > CLEARANCE - CELL


def test_three_corridors_that_meet_are_one_junction_and_three_dead_ends():
    free = carved((110, 80), (5, 105, 30, 41), (50, 61, 41, 75))
    graph = topology_of(free).graph
    degree = degrees(graph)
    assert sorted(degree) == [1, 1, 1, 3]
    np.testing.assert_allclose(graph.xy[degree == 3], [[5.55, 3.69]], atol=0.1)  # as far from
    assert graph.clearance[degree == 3] == pytest.approx(0.69, abs=0.1)  # a wall and two corners
    ends = graph.xy[degree == 1]
    expected = np.array([[1.05, 3.55], [9.95, 3.55], [5.55, 6.95]])
    assert cKDTree(expected).query(ends)[0].max() < 0.35
    assert sorted(np.round(graph.arc_length, 1)) == pytest.approx([3.4, 4.5, 4.5], abs=0.4)
    assert graph.arc_clearance == pytest.approx(0.5, abs=0.06)


def test_a_ring_without_junction_is_one_node_and_a_loop():
    free = carved((70, 90), (5, 65, 5, 85))
    free[16:54, 16:74] = False
    graph = topology_of(free).graph
    np.testing.assert_array_equal(graph.arc_ends, [[0, 0]])
    np.testing.assert_allclose(graph.arc_lines[0][0], graph.arc_lines[0][-1])
    assert graph.arc_length[0] == pytest.approx(2 * (4.9 + 6.9), rel=0.05)


def test_parallel_arcs_are_kept():
    free = carved((70, 90), (5, 65, 5, 85))
    free[16:30, 16:74] = free[41:54, 16:74] = False
    graph = topology_of(free).graph
    assert len(graph.id) == 2 and len(graph.arc_ends) == 3
    assert {tuple(sorted(pair)) for pair in graph.arc_ends.tolist()} == {(0, 1)}


def test_a_plain_room_is_one_node_or_one_arc():
    small = topology_of(carved((40, 40), (5, 35, 5, 35))).graph
    assert len(small.id) == 1 and not len(small.arc_ends)
    np.testing.assert_allclose(small.xy, [[2.0, 2.0]], atol=0.15)
    long = topology_of(carved((90, 40), (5, 85, 5, 35))).graph
    assert len(long.id) == 2 and len(long.arc_ends) == 1


@pytest.mark.parametrize("turn", np.linspace(0.05, 0.8, 8))
def test_dead_ends_of_a_turned_room_do_not_run_into_its_corners(turn):
    # 9 m by 2.4 m: the medial axis ends 1.2 m from both short walls.
    cell, half = 0.05, np.array([4.5, 1.2])
    centres = (np.stack(np.indices((220, 220)), axis=-1) + 0.5) * cell - 5.5
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    free = (np.abs(centres @ rotation) < half).all(axis=-1)
    origin = np.array([-5.5, -5.5, 0.0])
    graph = topology_of(free, resolution=cell, origin=origin, robot_radius=0.2).graph
    assert sorted(degrees(graph)) == [1, 1]
    ends = graph.xy @ rotation
    ends = ends[np.argsort(ends[:, 0])]
    np.testing.assert_allclose(ends, [[-3.3, 0.0], [3.3, 0.0]], atol=0.2)


def test_the_graph_is_in_the_frame_of_the_map():
    free, origin = clutter(0), np.array([-3.0, 7.0, 2.1])
    here, there = topology_of(free).graph, topology_of(free, origin=origin).graph
    c, s = np.cos(origin[2]), np.sin(origin[2])

    def moved(points):
        return points @ np.array([[c, s], [-s, c]]) + origin[:2]

    np.testing.assert_allclose(there.xy, moved(here.xy))
    for a, b in zip(here.arc_lines, there.arc_lines, strict=True):
        np.testing.assert_allclose(b, moved(a))
    np.testing.assert_allclose(there.arc_length, here.arc_length)


@pytest.mark.parametrize("kind", ["occupied", "unknown"])
def test_small_obstacles_in_free_space_change_nothing(kind):
    free = clutter(1)
    random = np.random.default_rng(1)
    specks = np.zeros_like(free)
    specks[2::4, 2::4] = random.random(specks[2::4, 2::4].shape) < 0.2
    specks &= ndimage.binary_erosion(free, EIGHT)
    occupied = ~free | specks if kind == "occupied" else ~free
    found, clean = topology_of(free & ~specks, occupied), topology_of(free)
    assert specks.sum() > 30
    for a, b in zip(found.graph, clean.graph, strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)
    as_obstacles = topology_of(free & ~specks, occupied, min_obstacle_size=0.0)
    rings, rings_clean = (
        len(graph.arc_ends) - len(graph.id) for graph in (as_obstacles.graph, clean.graph)
    )
    if kind == "occupied":
        assert rings != rings_clean


def test_unknown_patches_make_rings_only_where_they_are_larger_than_the_robot():
    for size, rings in ((4, 0), (12, 1)):
        free = carved((60, 60), (5, 55, 5, 55))
        walls = ~free
        free[28 : 28 + size, 28 : 28 + size] = False
        graph = topology_of(free, walls).graph
        assert len(graph.arc_ends) - len(graph.id) + 1 == rings


def test_unknown_alone_makes_no_dead_end():
    free = carved((100, 60), (5, 95, 5, 16), (40, 51, 16, 50))
    walls = ~free
    stub = np.zeros_like(free)
    stub[36:56, 20:] = True
    seen, unseen = topology_of(free, walls).graph, topology_of(free, walls & ~stub).graph
    assert sorted(degrees(seen)) == [1, 1, 1, 3]
    assert seen.xy[:, 1].max() > 4.0
    assert (degrees(unseen) <= 3).all() and unseen.xy[:, 1].max() < 2.5


def test_a_gap_too_narrow_for_the_robot_parts_two_regions():
    free = carved((60, 100), (5, 55, 5, 50), (5, 55, 53, 80), (28, 32, 50, 53))
    largest, both = topology_of(free), topology_of(free, min_region_area=1.0)
    assert largest.num_regions == 1 and both.num_regions == 2
    assert largest.graph.xy[:, 1].max() < 5.0 < both.graph.xy[:, 1].max()
    assert largest.unreached_area == pytest.approx(both.reached_area - largest.reached_area)
    assert topology_of(free, robot_radius=0.1).num_regions == 1
    assert topology_of(free, robot_radius=0.1).graph.xy[:, 1].max() > 5.0


def test_a_grid_too_narrow_for_the_robot_is_refused():
    with pytest.raises(ValueError, match="robot_radius = 0.25 m"):
        topology_of(carved((20, 20), (5, 15, 8, 11)))


def test_the_callback_is_given_the_stages_as_they_begin():
    stages = []
    topology_of(clutter(0), callback=stages.append)
    assert tuple(stages) == grid_topology.STAGES


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"occupied": np.zeros((40, 40), np.uint8)}, "occupied is uint8"),
        ({"occupied": np.zeros(40, bool)}, r"occupied is bool \(40,\), not bool \(H, W\)"),
        ({"free": np.ones((40, 39), bool)}, r"free is bool \(40, 39\), not bool \(40, 40\)"),
        ({"origin": [1.0, 2.0]}, r"origin is float64 \(2,\), not \(3,\)"),
        ({"origin": "here"}, "origin is .*, not numbers"),
        ({"origin": [0.0, np.nan, 0.0]}, r"origin is \[0.0, nan, 0.0\], not finite"),
        (
            dict.fromkeys(("occupied", "free"), np.zeros((0, 0), bool)),
            r"occupied is bool \(0, 0\), without a cell",
        ),
        ({"resolution": 0.0}, "resolution is 0.0, not a number of metres between 0.001 and 100"),
        ({"resolution": np.inf}, "resolution is inf, not a number of metres between"),
        ({"resolution": 1e6}, "resolution is 1000000.0, not a number of metres between"),
        ({"resolution": None}, "resolution is object .*, not numbers"),
        ({"robot_radius": "a"}, "robot_radius is <U1 .*, not numbers"),
        ({"robot_radius": None}, "robot_radius is object .*, not numbers"),
        ({"robot_radius": -0.1}, "robot_radius is -0.1, not a number of metres >= 0"),
        ({"min_obstacle_size": np.nan}, "min_obstacle_size is nan"),
        ({"min_region_area": -1.0}, "min_region_area is -1.0, not a number of square metres >= 0"),
    ],
)
def test_extract_topology_names_the_argument_that_does_not_fit(wrong, problem):
    free = carved((40, 40), (5, 35, 5, 35))
    given = {"occupied": ~free, "free": free, "resolution": CELL, "origin": np.zeros(3)}
    with pytest.raises(ValueError, match=problem):
        grid_topology.extract_topology(**{**given, "robot_radius": CLEARANCE, **wrong})


def test_extract_topology_takes_lists_numpy_and_jax_arrays_alike():
    free, origin = carved((40, 60), (5, 35, 5, 55)), np.array([1.0, 2.0, 0.0])
    want = topology_of(free, origin=origin).graph
    for convert in (np.ndarray.tolist, jnp.asarray, lambda x: x.astype(x.dtype)):
        graph = topology_of(convert(free), convert(~free), origin=convert(origin)).graph
        jax.tree.map(np.testing.assert_array_equal, graph, want)
    graph = topology_of(free, origin=origin.astype(np.float32)).graph
    jax.tree.map(np.testing.assert_array_equal, graph, want)
    graph = topology_of(free, origin=[1, 2, 0]).graph
    jax.tree.map(np.testing.assert_array_equal, graph, want)


def test_four_cells_in_a_square_are_one_junction_without_a_ring():
    cells = np.zeros((12, 12), bool)
    for k in range(5):
        cells[1 + k, 1 + k] = cells[10 - k, 1 + k] = True
        cells[1 + k, 10 - k] = cells[10 - k, 10 - k] = True
    assert cells[5:7, 5:7].all()
    net = cell_graph.trace_cells(cells, cells.astype(float))
    assert len(net.arcs) == 4 and len(net.nodes) == 5
    degrees = [len(arcs) for arcs in cell_graph_cleanup.arcs_at_nodes(net).values()]
    assert sorted(degrees) == [1, 1, 1, 1, 4]
    for arc in net.arcs.values():
        np.testing.assert_array_equal(arc.cells[[0, -1]], [net.nodes[own] for own in arc.ends])
        assert np.abs(np.diff(arc.cells, axis=0)).max() == 1


def test_corridors_that_cross_a_little_askew_meet_in_one_junction():
    free = carved((110, 110), (5, 105, 50, 61), (50, 61, 61, 105), (52, 63, 5, 50))
    graph = topology_of(free).graph
    assert sorted(degrees(graph)) == [1, 1, 1, 1, 4]
    apart = carved((110, 110), (5, 105, 50, 61), (35, 46, 61, 105), (65, 76, 5, 50))
    assert sorted(degrees(topology_of(apart).graph)) == [1, 1, 1, 1, 3, 3]


@pytest.mark.parametrize("tip, arcs", [(3.0, 2), (10.0, 3)])
def test_a_spur_into_a_corner_is_dropped(tip, arcs):
    cells = np.zeros((101, 101), bool)
    cells[:, 50] = cells[50, 50:91] = True
    clearance = np.full(cells.shape, 30.0)
    clearance[50, 90] = tip
    net = cell_graph.trace_cells(cells, clearance)
    dropped = cell_graph_cleanup.drop_spurs(net, clearance)
    assert dropped == (arcs == 2)  # 40 long, from a clearance of 30
    assert len(net.arcs) == arcs


def test_a_drive_near_a_wall_makes_no_ring():
    free = carved((60, 40), (5, 55, 5, 35))
    driven = np.zeros_like(free)
    driven[20:40, 6] = True
    driven[20, 6:12] = driven[39, 6:12] = True
    space = medial_axis.free_configurations(free, clearance=4.0, also_free=driven)
    assert holes(space.region > 0) == 0
    driven[30, 20:30] = True
    free[25:28, 15:18] = False
    space = medial_axis.free_configurations(free, clearance=2.0, also_free=driven & free)
    assert holes(space.region > 0) == 1
