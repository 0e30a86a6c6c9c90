"""Pose graphs with landmarks, written in the format of g2o for batch optimisers.

VERTEX_SE2 id x y theta                      poses of the scans, 0..T-1
VERTEX_XY id x y                             landmarks
FIX 0
EDGE_SE2 a b x y theta + 6 numbers           odometry, with information (upper triangle); then
                                             loop closures, from the earlier pose to the later
EDGE_SE2_XY a b x y + 3 numbers              landmark measurements, robot frame, likewise

Wall directions have no line type in this format and are left out.
"""

from collections.abc import Iterable
from os import PathLike

import numpy as np

from jaxslam.core.types import AnyArray, as_float64
from jaxslam.io.errors import InputError
from jaxslam.io.output import write_text
from jaxslam.mapping.pose_graph import PoseGraph


def write(path: str | PathLike, graph: PoseGraph) -> None:
    """Write a graph; every number is read back exactly.

    Args:
        path: File to write, atomically.
        graph: The graph; landmark k becomes vertex T + k.

    Raises:
        ValueError: A field is not numbers of its shape, or an index is out of range.
        InputError: Something is not finite, or the file cannot be written.
    """
    graph = _checked(graph)
    for name, values in graph._asdict().items():
        if not np.isfinite(values).all():
            raise InputError(f"{name} holds numbers that are not finite", path=path)
    first_landmark = len(graph.poses)
    text = [_line("VERTEX_SE2", (index,), pose) for index, pose in enumerate(graph.poses)]
    text += [
        _line("VERTEX_XY", (first_landmark + index,), position)
        for index, position in enumerate(graph.landmark_positions)
    ]
    text.append("FIX 0")
    consecutive = [(index, index + 1) for index in range(len(graph.odometry))]
    text += _relative_poses(consecutive, graph.odometry, graph.odometry_information)
    text += _relative_poses(
        graph.closure_ends.tolist(), graph.closure_pose, graph.closure_information
    )
    observed = zip(
        graph.pose_index,
        graph.landmark_index,
        graph.landmark_xy,
        graph.landmark_information,
        strict=True,
    )
    for pose, landmark, position, information in observed:
        vertices = int(pose), first_landmark + int(landmark)
        numbers = [*position, *information[np.triu_indices(2)]]
        text.append(_line("EDGE_SE2_XY", vertices, numbers))
    write_text(path, "\n".join(text) + "\n")


def _checked(graph: PoseGraph) -> PoseGraph:
    """The graph with NumPy arrays in its fields; raise ValueError if one is wrong."""
    poses = as_float64("poses", graph.poses, ("T", 3))
    landmark_positions = as_float64("landmark_positions", graph.landmark_positions, ("L", 2))
    odometry = as_float64("odometry", graph.odometry, (max(len(poses) - 1, 0), 3))
    landmark_xy = as_float64("landmark_xy", graph.landmark_xy, ("K", 2))
    closure_pose = as_float64("closure_pose", graph.closure_pose, ("C", 3))
    num_observed, num_closures = len(landmark_xy), len(closure_pose)
    return PoseGraph(
        poses=poses,
        landmark_positions=landmark_positions,
        odometry=odometry,
        odometry_information=as_float64(
            "odometry_information", graph.odometry_information, (len(odometry), 3, 3)
        ),
        pose_index=_indices("pose_index", graph.pose_index, (num_observed,), len(poses)),
        landmark_index=_indices(
            "landmark_index", graph.landmark_index, (num_observed,), len(landmark_positions)
        ),
        landmark_xy=landmark_xy,
        landmark_information=as_float64(
            "landmark_information", graph.landmark_information, (num_observed, 2, 2)
        ),
        closure_ends=_indices("closure_ends", graph.closure_ends, (num_closures, 2), len(poses)),
        closure_pose=closure_pose,
        closure_information=as_float64(
            "closure_information", graph.closure_information, (num_closures, 3, 3)
        ),
    )


def _indices(name: str, x: AnyArray, shape: tuple[int, ...], count: int) -> np.ndarray:
    """Integers of this shape; raise ValueError unless they are within 0 .. `count` - 1."""
    indices = as_float64(name, x, shape).astype(int)
    if indices.size and not (0 <= indices.min() and indices.max() < count):
        raise ValueError(f"{name} has {indices.min()} to {indices.max()}, not 0 to {count - 1}")
    return indices


def _relative_poses(
    pairs: Iterable[Iterable[int]], relative_poses: np.ndarray, information: np.ndarray
) -> list[str]:
    """EDGE_SE2 lines of relative poses (N, 3) between vertices, with information (N, 3, 3)."""
    upper = np.triu_indices(3)
    return [
        _line("EDGE_SE2", pair, [*pose, *matrix[upper]])
        for pair, pose, matrix in zip(pairs, relative_poses, information, strict=True)
    ]


def _line(keyword: str, vertices: Iterable[int], values: Iterable[float]) -> str:
    """A line of the file."""
    return " ".join([keyword, *map(str, vertices), *(repr(float(value)) for value in values)])
