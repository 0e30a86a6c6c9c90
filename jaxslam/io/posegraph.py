"""Pose-landmark graphs for g2o and its kin: what a run of the filter was told, to be optimised.

VERTEX_SE2 id x y theta                      poses of the scans, 0..T-1
VERTEX_XY id x y                             landmarks
FIX 0
EDGE_SE2 a b x y theta + 6 numbers           motions, with information (upper triangle); then
                                             closures, from the earlier pose to the later
EDGE_SE2_XY a b x y + 3 numbers              landmarks seen, robot frame, likewise

Directions of walls have no form of their own there and are left out.
"""

from collections.abc import Iterable
from os import PathLike
from typing import NamedTuple

import numpy as np

from jaxslam.io.errors import InputError
from jaxslam.io.output import write_text


class PoseGraph(NamedTuple):
    """Poses (T,), landmarks (L,) and what ties them together."""

    poses: np.ndarray  # (T, 3) [m, m, rad]
    places: np.ndarray  # (L, 2) [m]
    motion: np.ndarray  # (T - 1, 3) from each pose to the next, in its frame
    motion_information: np.ndarray  # (T - 1, 3, 3)
    seen_by: np.ndarray  # (K,) number of the pose that saw a landmark
    which: np.ndarray  # (K,) number of the landmark
    seen: np.ndarray  # (K, 2) [m] where, robot frame
    seen_information: np.ndarray  # (K, 2, 2)
    closed: np.ndarray = np.zeros((0, 2), int)  # (C, 2) numbers of two poses that scans tie
    closure: np.ndarray = np.zeros((0, 3))  # (C, 3) the second in the frame of the first
    closure_information: np.ndarray = np.zeros((0, 3, 3))  # (C, 3, 3)


def write(path: str | PathLike, graph: PoseGraph) -> None:
    """Write a graph; every number is read back as it was.

    Args:
        path: File to write, all of it or nothing.
        graph: Landmark k gets the name T + k.

    Raises:
        InputError: Something is not finite, or the file cannot be written.
    """
    for name, values in graph._asdict().items():
        if not np.isfinite(values).all():
            raise InputError(f"{name} holds numbers that are not finite", path=path)
    first = len(graph.poses)
    text = [_line("VERTEX_SE2", (k,), pose) for k, pose in enumerate(graph.poses)]
    text += [_line("VERTEX_XY", (first + k,), place) for k, place in enumerate(graph.places)]
    text.append("FIX 0")
    pairs = [(k, k + 1) for k in range(len(graph.motion))]
    parts = (pairs, graph.motion, graph.motion_information)
    closures = (graph.closed.tolist(), graph.closure, graph.closure_information)
    for ties in (parts, closures):
        for pair, move, sure in zip(*ties, strict=True):
            text.append(_line("EDGE_SE2", pair, [*move, *sure[np.triu_indices(3)]]))
    told = zip(graph.seen_by, graph.which, graph.seen, graph.seen_information, strict=True)
    for pose, landmark, place, sure in told:
        values = [*place, *sure[np.triu_indices(2)]]
        text.append(_line("EDGE_SE2_XY", (int(pose), first + int(landmark)), values))
    write_text(path, "\n".join(text) + "\n")


def _line(kind: str, names: Iterable[int], values: Iterable[float]) -> str:
    return " ".join([kind, *map(str, names), *(repr(float(x)) for x in values)])
