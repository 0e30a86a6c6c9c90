"""Verified relative poses, one `t1 t2 x y z roll pitch yaw` per line, as a reference for SLAM."""

from os import PathLike

import numpy as np

from jaxslam.core.logs import Relations
from jaxslam.io.text import rows

FIELDS = ("t1", "t2", "x", "y", "z", "roll", "pitch", "yaw")


def read(path: str | PathLike) -> Relations:
    """Read relative poses; z, roll and pitch are dropped.

    Args:
        path: Text file.

    Raises:
        InputError: The file cannot be read, or a line is not eight finite numbers.
    """
    values = np.array([values for _, values in rows(path, FIELDS, "relations")])
    return Relations(values[:, 0].copy(), values[:, 1].copy(), values[:, [2, 3, 7]])
