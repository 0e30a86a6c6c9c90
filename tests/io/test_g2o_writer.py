import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.io import g2o_writer
from jaxslam.mapping.pose_graph import PoseGraph

WRITTEN = """VERTEX_SE2 0 0.0 0.0 0.0
VERTEX_SE2 1 1.0 0.0 0.5
VERTEX_XY 2 2.0 1.0
FIX 0
EDGE_SE2 0 1 1.0 0.0 0.5 4.0 0.0 0.0 5.0 0.0 6.0
EDGE_SE2 0 1 1.0 0.0 0.25 1.0 0.0 0.0 2.0 0.0 3.0
EDGE_SE2_XY 1 2 0.5 0.25 7.0 0.5 8.0
"""


def graph():
    return PoseGraph(
        poses=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5]]),
        landmark_positions=np.array([[2.0, 1.0]]),
        odometry=np.array([[1.0, 0.0, 0.5]]),
        odometry_information=np.diag([4.0, 5.0, 6.0])[None],
        pose_index=np.array([1]),
        landmark_index=np.array([0]),
        landmark_xy=np.array([[0.5, 0.25]]),
        landmark_information=np.array([[[7.0, 0.5], [0.5, 8.0]]]),
        closure_ends=np.array([[0, 1]]),
        closure_pose=np.array([[1.0, 0.0, 0.25]]),
        closure_information=np.diag([1.0, 2.0, 3.0])[None],
    )


@pytest.mark.parametrize("convert", [np.asarray, np.ndarray.tolist, jnp.asarray])
def test_all_factors_are_written_whatever_holds_their_numbers(tmp_path, convert):
    path = tmp_path / "graph.g2o"
    g2o_writer.write(path, PoseGraph._make(convert(values) for values in graph()))
    assert path.read_text() == WRITTEN


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
