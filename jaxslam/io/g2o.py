"""Pose graphs in the format of g2o that also hold the laser scan of each pose, read as logs.

    VERTEX_SE2 id x y theta
    ROBOTLASER1 ... (`robotlaser`)
    EDGE_SE2 from to x y theta (6 numbers of the information matrix)

A scan belongs to the vertex before it. Edges from a vertex to the next one in the file are the
odometry; all other edges (loop closures) and the poses of the vertices are ignored.
"""

from collections import Counter
from os import PathLike

import numpy as np

from jaxslam.core.logs import DEFAULT_RANGE_MAX, MAX_BROKEN_FRACTION, LaserLog
from jaxslam.core.se2_np import dead_reckoning
from jaxslam.io import robotlaser
from jaxslam.io.assemble import read_assembled
from jaxslam.io.errors import InputError
from jaxslam.io.raw_log import RawLog, RawScan, as_odometry
from jaxslam.io.text import lines, number

FRAME = "laser"  # of the scans, whose poses the odometry is

_FORMS = {
    b"VERTEX_SE2": "VERTEX_SE2 id x y theta",
    b"ROBOTLASER1": robotlaser.FORM,
    b"EDGE_SE2": "EDGE_SE2 from to x y theta and 6 numbers of the information matrix",
}


def read(path: str | PathLike, *, range_max: float = DEFAULT_RANGE_MAX) -> LaserLog:
    """Read a pose graph with scans: plain, gzipped, or the one file in a zip archive.

    Args:
        path: The file.
        range_max: Range [m] from which on a reading counts as no return, unless the range_max of
            the scans is smaller; so does one <= 0.

    Raises:
        InputError: `range_max` is not positive, the file cannot be read, has no scan or no odometry
            from one vertex to the next, a vertex or edge is broken, or more than 5 % of the scans.
    """
    return read_assembled(path, read_raw, range_max=range_max)


def read_raw(path: str | PathLike) -> RawLog:
    """Scans of a pose graph, with their poses by its odometry edges.

    Raises:
        InputError: The file cannot be read, has no scan or no odometry from one vertex to the next,
            a vertex or edge is broken, or more than 5 % of the scans.
    """
    vertices: list[int] = []  # ids in file order
    scans: dict[int, RawScan] = {}
    edges: dict[tuple[int, int], tuple[float, ...]] = {}
    broken: dict[int, str] = {}
    for line, text in lines(path):
        fields = text.split()
        keyword = fields[0] if fields else b""
        if keyword not in _FORMS:
            continue
        try:
            if keyword == b"VERTEX_SE2":
                vertices.append(_vertex_id(fields, 5, 1))
            elif keyword == b"EDGE_SE2":
                pair = _vertex_id(fields, 12, 1), _vertex_id(fields, 12, 2)
                edges.setdefault(pair, tuple(number(field, "x y theta") for field in fields[3:6]))
            elif vertices:
                scans.setdefault(vertices[-1], robotlaser.parse(line, fields, FRAME)[0])
        except InputError as error:
            if keyword != b"ROBOTLASER1":
                advice = f"repair it, it is: {_FORMS[keyword]}"
                raise InputError(str(error), path=path, line=line, advice=advice) from None
            broken[line] = str(error)
    if not vertices:
        advice = "name a pose graph of g2o; other formats have other readers"
        raise InputError("has no VERTEX_SE2 lines", path=path, advice=advice)
    if len(set(vertices)) < len(vertices):
        duplicate = Counter(vertices).most_common(1)[0][0]
        raise InputError(f"vertex {duplicate} occurs twice", path=path, advice="renumber them")
    _check_scans(path, scans, broken)
    poses = _odometry(path, vertices, edges)
    has_scan = np.array([vertex in scans for vertex in vertices])
    return RawLog(
        scans=[scans[vertex] for vertex in vertices if vertex in scans],
        odometry=as_odometry([]),
        base_frame=FRAME,
        scan_poses=poses[has_scan],
        num_skipped=len(broken),
    )


def _vertex_id(fields: list[bytes], count: int, index: int) -> int:
    """Id of a vertex in a line of `count` fields; errors carry no line number."""
    if len(fields) != count:
        raise InputError(f"cut or damaged: {len(fields)} fields instead of {count}")
    value = number(fields[index], f"field {index + 1}")
    if value != int(value):
        raise InputError(f"{value:g} is not an integer", field=f"field {index + 1}")
    return int(value)


def _check_scans(path: str | PathLike, scans: dict[int, RawScan], broken: dict[int, str]) -> None:
    """Raise if there are no scans, or more are broken than `MAX_BROKEN_FRACTION` allows."""
    total = len(scans) + len(broken)
    if not total:
        advice = "name a graph that holds its laser scans"
        raise InputError("has no ROBOTLASER1 lines", path=path, advice=advice)
    if len(broken) > MAX_BROKEN_FRACTION * total:
        line = min(broken)
        problem = f"{broken[line]} ({len(broken)} of {total} ROBOTLASER1 lines are broken)"
        advice = f"repair them, each is: {_FORMS[b'ROBOTLASER1']}"
        raise InputError(problem, path=path, line=line, advice=advice)


def _odometry(
    path: str | PathLike,
    vertices: list[int],
    edges: dict[tuple[int, int], tuple[float, ...]],
) -> np.ndarray:
    """Poses (V, 3) [m, m, rad] of the vertices by dead reckoning along the odometry edges."""
    pairs = list(zip(vertices[:-1], vertices[1:], strict=True))
    for pair in pairs:
        if pair not in edges:
            problem = f"no EDGE_SE2 from vertex {pair[0]} to the next, {pair[1]}"
            raise InputError(problem, path=path, advice="name a graph with its odometry")
    increments = np.array([(0.0, 0.0, 0.0), *(edges[pair] for pair in pairs)])
    return dead_reckoning(np.zeros(3), increments)
