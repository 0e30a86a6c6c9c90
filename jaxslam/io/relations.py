"""Verified relative poses, `t1 t2 x y z roll pitch yaw` a line, that a trajectory should obey."""

from os import PathLike
from typing import NamedTuple

import numpy as np

from jaxslam.io.text import rows

FIELDS = ("t1", "t2", "x", "y", "z", "roll", "pitch", "yaw")


class Relations(NamedTuple):
    """N motions between two times of a log.

    References:
        Kuemmerle et al. (2009), On measuring the accuracy of SLAM algorithms.
    """

    t1: np.ndarray  # (N,) [s]
    t2: np.ndarray  # (N,) [s]
    motion: np.ndarray  # (N, 3) [m, m, rad] pose at t2 in the robot frame at t1


def read(path: str | PathLike) -> Relations:
    """Read relations; height, roll and pitch are dropped.

    Args:
        path: Text file.

    Raises:
        InputError: The file cannot be read, or a line is not eight finite numbers.
    """
    values = np.array([values for _, values in rows(path, FIELDS, "relations")])
    return Relations(values[:, 0].copy(), values[:, 1].copy(), values[:, [2, 3, 7]])
