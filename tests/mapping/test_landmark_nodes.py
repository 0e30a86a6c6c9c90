import numpy as np
import pytest

from jaxslam.mapping.landmark_nodes import place_landmarks
from jaxslam.mapping.open_space import FreeSpace
from jaxslam.mapping.plane_graph import Line, PlaneGraph


def corridor() -> tuple[PlaneGraph, FreeSpace]:
    """A corridor of 4 m by 2 m along x, with a diagram of three arcs and a junction at (2, 1)."""
    xy = np.array([[0.5, 1.0], [2.0, 1.0], [3.5, 1.0], [2.0, 1.6]])
    lines = [Line(a, 1, xy[[a, 1]], True) for a in (0, 2, 3)]
    clearance = np.full((80, 40), 1.0)
    return PlaneGraph(xy, lines), FreeSpace(clearance, 0.05, np.zeros(2), 0.2)


@pytest.mark.parametrize(
    "off, same, moved", [(0.05, True, True), (0.15, True, False), (0.35, False, False)]
)
def test_a_node_is_the_landmark_of_its_place_and_moves_within_its_accuracy(off, same, moved):
    graph, space = corridor()
    landmark = np.array([[2.0, 1.0 - off]])
    names = place_landmarks(graph, landmark, np.array([1.0]), space)
    (node,) = names
    assert (node == 1) == same
    np.testing.assert_allclose(graph.xy[1], landmark[0] if moved else [2.0, 1.0])
    if not same:
        np.testing.assert_allclose(graph.xy[node], landmark[0])
    assert all(line.is_branch for line in graph.arcs.values()) == same
    assert len(graph.arcs) == (3 if same else 4)


def test_an_arc_is_split_at_a_landmark_that_it_passes_and_led_to_one_beside():
    graph, space = corridor()
    landmarks = np.array([[1.2, 1.1], [2.8, 0.6], [2.8, 5.0]])
    names = place_landmarks(graph, landmarks, np.array([1.0, 1.0, 1.0]), space)
    assert sorted(names.values()) == [0, 1]
    node = {k: n for n, k in names.items()}
    assert graph.degrees()[node[0]] == 2
    assert graph.degrees()[node[1]] == 1
    assert [line.is_branch for line in graph.arcs.values()].count(False) == 1


def test_a_landmark_with_an_obstacle_in_its_circle_is_no_node():
    graph, space = corridor()
    space.clearance[:] = 0.4
    assert not place_landmarks(graph, np.array([[2.0, 1.0]]), np.array([1.0]), space)
