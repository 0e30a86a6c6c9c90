"""Pose graphs in the form of g2o that hold the laser scans of their poses, as recordings.

    VERTEX_SE2 id x y theta
    ROBOTLASER1 ... (`robotlaser`)
    EDGE_SE2 from to x y theta (6 numbers of the information matrix)

A scan belongs to the vertex before it. Edges from one vertex to the next one in the file are the
odometry; all others are left to whoever closes loops. Places of the vertices are not used.
"""

import math
from collections import Counter
from os import PathLike

import numpy as np

from jaxslam.io import robotlaser
from jaxslam.io.errors import InputError
from jaxslam.io.recording import NOISE, REACH, TOLERATED, Recording, no_return
from jaxslam.io.robotlaser import Laser
from jaxslam.io.text import lines, number
from jaxslam.lidar import Lidar
from jaxslam.poses import chain

_FORMS = {
    b"VERTEX_SE2": "VERTEX_SE2 id x y theta",
    b"ROBOTLASER1": robotlaser.FORM,
    b"EDGE_SE2": "EDGE_SE2 from to x y theta and 6 numbers of the information matrix",
}


def read(path: str | PathLike, *, reach: float = REACH) -> Recording:
    """Read a pose graph with scans: plain, gzipped, or the one file in a zip archive.

    Args:
        path: The file.
        reach: Range [m] from which on a reading counts as no return, if the scans do not name a
            smaller one; so does one <= 0.

    Raises:
        InputError: The file cannot be read, has no scan or no odometry from one vertex to the
            next, a vertex or edge is broken, or more than 5 % of the scans.
    """
    if not 0.0 < reach < math.inf:
        raise InputError(f"reach {reach} m", advice="give a positive number of metres")
    order: list[int] = []  # names of the vertices as they come
    scans: dict[int, Laser] = {}
    edges: dict[tuple[int, int], tuple[float, ...]] = {}
    broken: dict[int, str] = {}
    for line, text in lines(path):
        fields = text.split()
        kind = fields[0] if fields else b""
        if kind not in _FORMS:
            continue
        try:
            if kind == b"VERTEX_SE2":
                order.append(_name(fields, 5, 1))
            elif kind == b"EDGE_SE2":
                pair = _name(fields, 12, 1), _name(fields, 12, 2)
                edges.setdefault(pair, tuple(number(x, "x y theta") for x in fields[3:6]))
            elif order:
                scans.setdefault(order[-1], robotlaser.parse(line, fields))
        except InputError as error:
            if kind != b"ROBOTLASER1":
                advice = f"repair it, it is: {_FORMS[kind]}"
                raise InputError(str(error), path=path, line=line, advice=advice) from None
            broken[line] = str(error)
    if not order:
        advice = "name a pose graph of g2o; other formats have other readers"
        raise InputError("has no VERTEX_SE2 lines", path=path, advice=advice)
    if len(set(order)) < len(order):
        twice = Counter(order).most_common(1)[0][0]
        raise InputError(f"vertex {twice} comes twice", path=path, advice="number them anew")
    scans, odd = robotlaser.alike(scans)
    broken |= odd
    _check(path, scans, broken)
    return _recording(path, order, scans, edges, len(broken), reach)


def _name(fields: list[bytes], count: int, at: int) -> int:
    """Number of a vertex; errors do not know the place."""
    if len(fields) != count:
        raise InputError(f"cut or damaged: {len(fields)} fields instead of {count}")
    value = number(fields[at], f"field {at + 1}")
    if value != int(value):
        raise InputError(f"{value:g} is no whole number", field=f"field {at + 1}")
    return int(value)


def _check(path: str | PathLike, scans: dict[int, Laser], broken: dict[int, str]) -> None:
    """Raise if there are no scans, or more are broken than is tolerated."""
    total = len(scans) + len(broken)
    if not total:
        advice = "name a graph that holds its laser scans"
        raise InputError("has no ROBOTLASER1 lines", path=path, advice=advice)
    if len(broken) > TOLERATED * total:
        line = min(broken)
        problem = f"{broken[line]} ({len(broken)} of {total} ROBOTLASER1 lines are broken)"
        advice = f"repair them, each is: {_FORMS[b'ROBOTLASER1']}"
        raise InputError(problem, path=path, line=line, advice=advice)


def _recording(
    path: str | PathLike,
    order: list[int],
    scans: dict[int, Laser],
    edges: dict[tuple[int, int], tuple[float, ...]],
    skipped: int,
    reach: float,
) -> Recording:
    """Put scans and odometry together."""
    pairs = list(zip(order[:-1], order[1:], strict=True))
    for pair in pairs:
        if pair not in edges:
            problem = f"no EDGE_SE2 from vertex {pair[0]} to the next, {pair[1]}"
            raise InputError(problem, path=path, advice="name a graph with its odometry")
    moves = np.array([edges[pair] for pair in pairs]).reshape(-1, 3)
    poses = chain(moves)
    with_scan = np.array([name in scans for name in order])
    kept = [scans[name] for name in order if name in scans]
    first = kept[0]
    reach = min(reach, first.reach)
    ranges = no_return(np.array([one.ranges for one in kept]), reach)
    times = np.array([one.time for one in kept])
    odometry = poses[with_scan]
    return Recording(
        times=times,
        odometry=odometry,
        ranges=ranges,
        lidar=Lidar(ranges.shape[1], first.first, first.step, reach, NOISE),
        skipped=skipped,
        wheel_times=times,
        wheel_poses=odometry,
    )
