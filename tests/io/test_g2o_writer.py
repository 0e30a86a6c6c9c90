import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.io import g2o_writer
from jaxslam.mapping.pose_graph import PoseGraph

WRITTEN = """VERTEX_SE2 0 0.0 0.0 0.0
VERTEX_SE2 1 1.0 0.0 0.5
VERTEX_XY 2 2.0 1.0
EDGE_SE2 0 1 1.0 0.25 0.0 4.0 0.5 0.0 5.0 0.0 6.0
EDGE_SE2 0 1 1.0 0.0 0.0 1.0 0.0 0.0 2.0 0.0 3.0
EDGE_SE2_XY 1 2 0.5 0.25 7.0 0.5 8.0
FIX 0
"""


def graph():
    return PoseGraph(
        poses=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5]]),
        landmark_positions=np.array([[2.0, 1.0]]),
        odometry=np.array([[1.0, 0.25, 0.0]]),
        odometry_information=np.array([[[4.0, 0.5, 0.0], [0.5, 5.0, 0.0], [0.0, 0.0, 6.0]]]),
        pose_index=np.array([1]),
        landmark_index=np.array([0]),
        landmark_xy=np.array([[0.5, 0.25]]),
        landmark_information=np.array([[[7.0, 0.5], [0.5, 8.0]]]),
        closure_ends=np.array([[0, 1]]),
        closure_pose=np.array([[1.0, 0.0, 0.0]]),
        closure_information=np.diag([1.0, 2.0, 3.0])[None],
    )


@pytest.mark.parametrize("convert", [np.asarray, np.ndarray.tolist, jnp.asarray])
def test_all_factors_are_written_whatever_holds_their_numbers(tmp_path, convert):
    path = tmp_path / "graph.g2o"
    g2o_writer.write(path, PoseGraph._make(convert(values) for values in graph()))
    assert path.read_text() == WRITTEN


def information(line):
    """Information matrix of an EDGE_SE2 line."""
    upper = np.zeros((3, 3))
    upper[np.triu_indices(3)] = [float(x) for x in line.split()[6:]]
    return upper + np.triu(upper, 1).T


def edges(path):
    return [line for line in path.read_text().splitlines() if line.startswith("EDGE_SE2 ")]


@pytest.mark.parametrize("turn", [0.3, np.pi / 2, -2.5])
def test_information_is_that_of_the_error_of_g2o(tmp_path, turn):
    """Whose position is in the frame of the second pose: the cost of a deviation is the same."""
    root = np.array([[3.0, 0.5, 0.2], [0.0, 1.0, 0.1], [0.0, 0.0, 4.0]])
    given, pose = root.T @ root, np.array([1.0, -2.0, turn])
    changed = graph()._replace(
        odometry=pose[None],
        odometry_information=given[None],
        closure_pose=pose[None],
        closure_information=given[None],
    )
    g2o_writer.write(tmp_path / "graph.g2o", changed)
    deviation = np.array([0.03, -0.02, 0.01])
    c, s = np.cos(turn), np.sin(turn)
    x, y = deviation[:2]
    error = np.array([c * x + s * y, c * y - s * x, deviation[2]])
    for line in edges(tmp_path / "graph.g2o"):
        cost = error @ information(line) @ error
        np.testing.assert_allclose(cost, deviation @ given @ deviation, rtol=1e-12)


def test_singular_information_of_closures_gets_a_floor_and_nothing_else_changes(tmp_path):
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(100, 3, 3)))[0]
    values = np.array([0.0, 2.4e3, 3.5e4])
    singular = (axes * values) @ axes.swapaxes(1, 2)
    regular = np.diag([3.5e4, 1e-3, 9.0])[None]  # not below the floor
    changed = graph()._replace(
        closure_ends=np.tile([0, 1], (101, 1)),
        closure_pose=np.zeros((101, 3)),
        closure_information=np.concatenate([singular, regular]),
    )
    g2o_writer.write(tmp_path / "graph.g2o", changed)
    written = np.stack([information(line) for line in edges(tmp_path / "graph.g2o")[1:]])
    found = np.linalg.eigvalsh(written[:100])
    np.testing.assert_allclose(found[:, 0], 1e-9 * found[:, 2], rtol=1e-5)
    np.testing.assert_allclose(found[:, 1:], np.tile(values[1:], (100, 1)), rtol=1e-9)
    np.testing.assert_array_equal(written[100], regular[0])


@pytest.mark.parametrize(
    "change, message",
    [
        ({"poses": np.zeros((2, 2))}, r"poses is .* \(2, 2\), not \(T, 3\)"),
        ({"odometry": np.zeros((2, 3))}, r"odometry is .* \(2, 3\), not \(1, 3\)"),
        ({"odometry_information": np.eye(3)}, "odometry_information is"),
        ({"landmark_information": np.eye(2)}, "landmark_information is"),
        ({"pose_index": [2]}, "pose_index has 2 to 2, not 0 to 1"),
        ({"landmark_index": [-1]}, "landmark_index has -1 to -1, not 0 to 0"),
        ({"closure_ends": [[0, 5]]}, "closure_ends has 0 to 5, not 0 to 1"),
        ({"landmark_xy": [["a", "b"]]}, "landmark_xy is <U1"),
        ({"poses": np.full((2, 3), np.inf)}, "poses holds numbers that are not finite"),
    ],
)
def test_what_is_no_graph_is_not_written(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        g2o_writer.write(tmp_path / "graph.g2o", graph()._replace(**change))
    assert not list(tmp_path.iterdir())
