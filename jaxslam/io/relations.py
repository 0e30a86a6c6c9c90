"""Verified relative poses, one `t1 t2 x y z roll pitch yaw` per line, as a reference for SLAM."""

from os import PathLike
from typing import NamedTuple

import numpy as np

from jaxslam.io.text import rows

FIELDS = ("t1", "t2", "x", "y", "z", "roll", "pitch", "yaw")


class Relations(NamedTuple):
    """N relative poses between two times of a log.

    Attributes:
        t1: (N,) [s].
        t2: (N,) [s].
        motion: (N, 3) [m, m, rad] pose at t2 in the robot frame at t1.

    References:
        Kuemmerle et al. (2009), On measuring the accuracy of SLAM algorithms.
    """

    t1: np.ndarray
    t2: np.ndarray
    motion: np.ndarray


def read(path: str | PathLike) -> Relations:
    """Read relative poses; z, roll and pitch are dropped.

    Args:
        path: Text file.

    Raises:
        InputError: The file cannot be read, or a line is not eight finite numbers.
    """
    values = np.array([values for _, values in rows(path, FIELDS, "relations")])
    return Relations(values[:, 0].copy(), values[:, 1].copy(), values[:, [2, 3, 7]])
