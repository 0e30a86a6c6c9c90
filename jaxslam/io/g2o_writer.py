"""Pose graphs with landmarks, written in the format of g2o for batch optimisers.

VERTEX_SE2 id x y theta                      poses of the scans, 0..T-1
VERTEX_XY id x y                             landmarks
EDGE_SE2 a b x y theta + 6 numbers           odometry, with information (upper triangle); then
                                             loop closures, from the earlier pose to the later
EDGE_SE2_XY a b x y + 3 numbers              landmark measurements, robot frame, likewise
FIX 0

Wall directions have no line type in this format and are left out. The error of an EDGE_SE2 is the
second pose in the frame of the measured second pose, and its information is that of this error.
GTSAM 4.3 reads no edge behind a line it does not know, which `FIX` and comments are: `FIX` is last
and there are no comments. Its `readG2o` leaves out EDGE_SE2_XY by design.
"""

from collections.abc import Iterable
from os import PathLike

import numpy as np

from jaxslam.core.types import AnyArray, as_float64
from jaxslam.io.errors import InputError
from jaxslam.io.output import write_text
from jaxslam.mapping.pose_graph import PoseGraph

LEAST_EIGENVALUE = 1e-9
"""Least eigenvalue of a loop closure's information, as a fraction of its largest.

Readers factorise the matrix. Rounding errs by about 1e-15 of the largest eigenvalue, so that of one
that is zero some make a tie of decimetres. From this fraction on GTSAM has eigenvalues to 2e-7, and
the tie that it adds is one of 30 m or weaker where the closure is good to 1 mm.
"""


def write(path: str | PathLike, graph: PoseGraph) -> None:
    """Write a graph; poses and measurements are read back exactly.

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
    consecutive = [(index, index + 1) for index in range(len(graph.odometry))]
    text += _relative_poses(consecutive, graph.odometry, graph.odometry_information)
    text += _relative_poses(
        graph.closure_ends.tolist(), graph.closure_pose, with_floor(graph.closure_information)
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
    if first_landmark:
        text.append("FIX 0")
    write_text(path, "\n".join(text) + "\n")


def with_floor(information: np.ndarray) -> np.ndarray:
    """Information matrices (N, k, k) with eigenvalues of at least `LEAST_EIGENVALUE` x the largest.

    A matrix whose eigenvalues are so large stays as it is.
    """
    eigenvalues, axes = np.linalg.eigh(information)
    missing = np.maximum(LEAST_EIGENVALUE * eigenvalues[:, -1:] - eigenvalues, 0.0)
    added: np.ndarray = (axes * missing[:, None]) @ axes.swapaxes(1, 2)
    return information + added


def in_frame_of_second(relative_poses: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Information (N, 3, 3) of relative poses (N, 3), turned from the first frame to the second."""
    c, s = np.cos(relative_poses[:, 2]), np.sin(relative_poses[:, 2])
    turn = np.zeros((len(relative_poses), 3, 3))
    turn[:, :2, :2] = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    turn[:, 2, 2] = 1.0
    turned: np.ndarray = turn.swapaxes(1, 2) @ information @ turn
    return turned


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
    """EDGE_SE2 lines of relative poses (N, 3), with information (N, 3, 3) in the first frame."""
    upper = np.triu_indices(3)
    information = in_frame_of_second(relative_poses, information)
    return [
        _line("EDGE_SE2", pair, [*pose, *matrix[upper]])
        for pair, pose, matrix in zip(pairs, relative_poses, information, strict=True)
    ]


def _line(keyword: str, vertices: Iterable[int], values: Iterable[float]) -> str:
    """A line of the file."""
    return " ".join([keyword, *map(str, vertices), *(repr(float(value)) for value in values)])
