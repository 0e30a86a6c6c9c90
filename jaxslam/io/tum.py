"""Trajectories in the TUM format, `t x y z qx qy qz qw` per line, which evo and others read."""

import math
from os import PathLike

import numpy as np

from jaxslam.core.types import AnyArray, as_float64
from jaxslam.io.errors import InputError
from jaxslam.io.output import write_text
from jaxslam.io.quaternions import yaw_of
from jaxslam.io.text import rows

PLANAR = 0.05  # of a quaternion: roll and pitch that a robot in the plane may have
MIN_TURN = 0.5  # [rad] by which a path turns that must have other headings than 0
MAX_STEPS = 200  # of the path that are looked at, for the direction of each
FIELDS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")


def read(path: str | PathLike) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) [s] and poses (N, 3) [m, m, rad] of a trajectory, projected to the plane.

    Args:
        path: Text file; z, roll and pitch are dropped.

    Raises:
        InputError: The file cannot be read, or a line is not eight finite numbers of which the
            last four are a unit quaternion.
    """
    return read_reference(path)[0]


def read_reference(
    path: str | PathLike,
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[str, ...]]:
    """The trajectory, as `read`, and notes on what it lacks.

    Headings are NaN where quaternions are written in another order, or say nothing although the
    path turns.

    Raises:
        InputError: As `read`.
    """
    table = rows(path, FIELDS, "a TUM trajectory")
    for line, fields in table:
        norm = math.hypot(*fields[4:])
        if abs(norm - 1.0) > 1e-2:
            problem = f"quaternion of length {norm:.3g} instead of 1"
            advice = "the last four fields are qx qy qz qw"
            raise InputError(problem, path=path, line=line, field="qx qy qz qw", advice=advice)
    values = np.array([fields for _, fields in table])
    quaternions = values[:, 4:] / np.linalg.norm(values[:, 4:], axis=1, keepdims=True)
    heading = yaw_of(quaternions)
    notes: tuple[str, ...] = ()
    problem = _heading_problem(values[:, 1:3], quaternions)
    if problem:
        heading = np.full(len(values), np.nan)
        notes = (f"{problem}: errors of the heading are left out",)
    poses = np.column_stack([values[:, 1:3], heading])
    return (values[:, 0].copy(), poses), notes


def _heading_problem(positions: np.ndarray, quaternions: np.ndarray) -> str:
    """Why the quaternions (N, 4) are no headings of the path (N, 2); "" if they may be."""
    x, y, z, w = np.abs(quaternions.T)
    if max(np.quantile(y, 0.9), np.quantile(z, 0.9)) < PLANAR and x.max() > 0.5:
        return "quaternions have w first, not last"
    steps = np.diff(positions[:: max(len(positions) // MAX_STEPS, 1)], axis=0)
    steps = steps[np.hypot(*steps.T) > 0.0]
    if (w == 1.0).all() and len(steps) > 1:
        along = steps / np.hypot(*steps.T)[:, None]
        if (along @ along[0]).min() < math.cos(MIN_TURN):
            return "quaternions hold no heading"
    return ""


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
