"""Trajectories in the TUM format, `t x y z qx qy qz qw` per line, which evo and others read."""

import math
from os import PathLike

import numpy as np

from jaxslam.core.types import AnyArray, as_float64
from jaxslam.io.errors import InputError
from jaxslam.io.output import write_text
from jaxslam.io.text import rows

FIELDS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")


def read(path: str | PathLike) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) [s] and poses (N, 3) [m, m, rad] of a trajectory, projected to the plane.

    Args:
        path: Text file; z, roll and pitch are dropped.

    Raises:
        InputError: The file cannot be read, or a line is not eight finite numbers of which the
            last four are a unit quaternion.
    """
    table = rows(path, FIELDS, "a TUM trajectory")
    for line, fields in table:
        norm = math.hypot(*fields[4:])
        if abs(norm - 1.0) > 1e-2:
            problem = f"quaternion of length {norm:.3g} instead of 1"
            advice = "the last four fields are qx qy qz qw"
            raise InputError(problem, path=path, line=line, field="qx qy qz qw", advice=advice)
    values = np.array([fields for _, fields in table])
    x, y, z, w = (values[:, 4:] / np.linalg.norm(values[:, 4:], axis=1, keepdims=True)).T
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return values[:, 0].copy(), np.column_stack([values[:, 1:3], heading])


def write(path: str | PathLike, times: AnyArray, poses: AnyArray) -> None:
    """Write a trajectory; every number is read back exactly.

    Args:
        path: File to write, atomically.
        times: (N,) [s].
        poses: (N, 3) [m, m, rad].

    Raises:
        ValueError: An argument is not numbers of its shape.
        InputError: A pose is not finite, or the file cannot be written.
    """
    times = as_float64("times", times, ("N",))
    poses = as_float64("poses", poses, (times.size, 3))
    not_finite = ~np.isfinite(np.column_stack([times, poses])).all(axis=1)
    if not_finite.any():
        problem = f"pose {int(np.argmax(not_finite))} is not finite"
        raise InputError(problem, path=path, advice="write only the poses before it")
    text = "".join(
        f"{time!r} {x!r} {y!r} 0 0 0 {math.sin(heading / 2)!r} {math.cos(heading / 2)!r}\n"
        for time, (x, y, heading) in zip(times.tolist(), poses.tolist(), strict=True)
    )
    write_text(path, "# t x y z qx qy qz qw\n" + text)
