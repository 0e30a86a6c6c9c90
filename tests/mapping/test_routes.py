import jax.numpy as jnp
import networkx
import numpy as np
import pytest

from jaxslam.core.maps import TopologicalMap
from jaxslam.mapping import routes
from jaxslam.mapping.routes import find_route

POSITIONS = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [5, 5]], float)
PAIRS = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [0, 3]])


def graph_of(lengths, clearance=(1.0,) * 5):
    """A square of five arcs, two of them between the same nodes, and an isolated node."""
    lines = [POSITIONS[pair] for pair in PAIRS[:4]]
    lines.append(np.array([POSITIONS[0], [-1.0, 0.5], POSITIONS[3]]))
    return TopologicalMap(
        id=np.arange(5),
        xy=POSITIONS,
        kind=np.zeros(5, int),
        clearance=np.ones(5),
        arc_ends=PAIRS,
        arc_length=np.array(lengths, float),
        arc_clearance=np.array(clearance),
        arc_lines=tuple(lines),
    )


@pytest.mark.parametrize(
    "lengths, nodes, arcs",
    [
        ([1.0, 1.0, 1.0, 3.0, 4.0], [0, 1, 2], [0, 1]),
        ([1.0, 5.0, 1.0, 3.0, 4.0], [0, 3, 2], [3, 2]),
        ([1.0, 3.0, 1.0, 9.0, 2.0], [0, 3, 2], [4, 2]),  # the shorter of two arcs counts
        ([1.0, 3.0, 0.0, 3.5, 9.0], [0, 3, 2], [3, 2]),  # an arc of no length is an arc
    ],
)
def test_route_is_the_shortest_and_its_line_goes_from_end_to_end(lengths, nodes, arcs):
    found = find_route(graph_of(lengths), 0, 2)
    assert (found.nodes, found.arcs) == (nodes, arcs)
    assert found.length == np.sum(np.array(lengths)[arcs])
    np.testing.assert_array_equal(found.line[[0, -1]], POSITIONS[[0, 2]])
    for position in POSITIONS[nodes]:
        assert np.any(np.all(found.line == position, axis=1))


def test_a_route_keeps_its_clearance():
    graph = graph_of([1.0, 1.0, 1.0, 3.0, 4.0], [0.3, 0.9, 0.5, np.nan, 0.6])
    assert find_route(graph, 0, 2).arcs == [0, 1]
    assert find_route(graph, 0, 2, min_clearance=0.4).arcs == [4, 2]  # not where none is known
    with pytest.raises(ValueError, match="no route leads from node 0 to node 2"):
        find_route(graph, 0, 2, min_clearance=0.55)


def test_route_there_is_route_back_and_may_be_empty():
    graph = graph_of(np.ones(5))
    assert find_route(graph, 2, 0).nodes in ([2, 1, 0], [2, 3, 0])
    rest = find_route(graph, 4, 4)
    assert (rest.nodes, rest.arcs, rest.length) == ([4], [], 0.0)
    np.testing.assert_array_equal(rest.line, POSITIONS[[4]])


@pytest.mark.parametrize(
    "goal, problem",
    [(4, "no route leads from node 0 to node 4"), (9, "goal is 9, not a node 0 to 4")],
)
def test_a_route_that_does_not_exist_is_refused(goal, problem):
    with pytest.raises(ValueError, match=problem):
        find_route(graph_of(np.ones(5)), 0, goal)


@pytest.mark.parametrize("seed", range(5))
def test_the_shortest_path_is_that_of_networkx(seed):
    random, num_nodes = np.random.default_rng(seed), 9
    pairs = random.integers(0, num_nodes, (14, 2))  # loops and parallel arcs among them
    lengths = random.integers(0, 9, 14).astype(float)  # and some of no length
    lengths[:2] = np.inf
    graph = networkx.MultiGraph()
    graph.add_nodes_from(range(num_nodes))
    for (a, b), length in list(zip(pairs.tolist(), lengths, strict=True))[2:]:
        graph.add_edge(a, b, weight=length)
    for goal in range(num_nodes):
        if not networkx.has_path(graph, 0, goal):
            with pytest.raises(ValueError, match=f"no route leads from node 0 to node {goal}"):
                routes.shortest_path(pairs, lengths, 0, goal, num_nodes=num_nodes)
            continue
        arcs = routes.shortest_path(pairs, lengths, 0, goal, num_nodes=num_nodes)
        want = networkx.shortest_path_length(graph, 0, goal, weight="weight")
        assert lengths[arcs].sum() == want
        assert routes.join_arcs([np.zeros((2, 2))] * 14, pairs, arcs, 0)[0][-1] == goal


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"start": -1}, "start is -1, not a node 0 to 4"),
        ({"goal": 1.5}, r"goal is float64 \(\), not integer \(\)"),
        ({"goal": [1, 2]}, r"goal is int64 \(2,\), not integer \(\)"),
        ({"min_clearance": np.nan}, "min_clearance is nan, not a finite number"),
        ({"topological_map": POSITIONS}, "topological_map is of type ndarray, not TopologicalMap"),
    ],
)
def test_find_route_names_the_argument_that_does_not_fit(wrong, problem):
    given = {"topological_map": graph_of(np.ones(5)), "start": 0, "goal": 2}
    with pytest.raises(ValueError, match=problem):
        find_route(**{**given, **wrong})


@pytest.mark.parametrize(
    "wrong, problem",
    [
        ({"lengths": [1.0, 2.0]}, r"pairs is int64 \(5, 2\), not integer \(2, 2\)"),
        ({"lengths": [1, 1, -1, 1, 1]}, "lengths holds numbers that are negative or NaN"),
        ({"lengths": [1, 1, np.nan, 1, 1]}, "lengths holds numbers that are negative or NaN"),
        ({"pairs": PAIRS + 1}, "pairs holds nodes 1 to 4 of 4"),
        ({"pairs": np.ones((5, 2))}, r"pairs is float64 \(5, 2\), not integer"),
        ({"start": 4}, "start is 4, not a node 0 to 3"),
    ],
)
def test_shortest_path_names_the_argument_that_does_not_fit(wrong, problem):
    given = {"pairs": PAIRS, "lengths": np.ones(5), "start": 0, "goal": 2, "num_nodes": 4}
    with pytest.raises(ValueError, match=problem):
        routes.shortest_path(**{**given, **wrong})


def test_lists_numpy_and_jax_arrays_give_the_same_path():
    lengths = np.array([1.0, 3.0, 1.0, 9.0, 2.0])
    for convert in (np.asarray, np.ndarray.tolist, jnp.asarray, np.int32):
        path = routes.shortest_path(PAIRS.tolist(), convert(lengths), 0, 2, num_nodes=5)
        assert path == [4, 2]
    assert routes.shortest_path(jnp.asarray(PAIRS), np.float32(lengths), 0, 2, num_nodes=5) == path
    assert find_route(graph_of(lengths), jnp.int32(0), np.int64(2)).nodes == [0, 3, 2]
    assert routes.shortest_path([], [], 1, 1, num_nodes=2) == []
