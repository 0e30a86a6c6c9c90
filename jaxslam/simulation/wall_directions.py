"""How parallel the walls of a building are.

The direction of a wall is a landmark that all walls of about this direction have in common. Those
of a plan are parallel to rounding; those of a building as it was built, or mapped, are not.
"""

import math
from typing import Any

import numpy as np

from jaxslam.filtering.data_association import AssociationSpec
from jaxslam.frontend.features import FeatureSpec

MIN_LENGTH = FeatureSpec().min_wall_length
MAX_ANGLE = AssociationSpec().min_wall_angle


def direction_std(
    walls: Any, *, min_length: float = MIN_LENGTH, max_angle: float = MAX_ANGLE
) -> float:
    """Standard deviation [rad] of the directions of walls that are taken for parallel.

    With the length l of a wall and the angle d between two, of all pairs, those of a wall with
    itself included,

        std^2 = sum l_i l_j d_ij^2 / (2 sum l_i l_j),    |d_ij| < max_angle

    Args:
        walls: (S, 4) [m] ends.
        min_length: [m] of the walls that count: from shorter ones the front end takes no direction.
        max_angle: [rad] from which on two directions are different landmarks.

    Returns:
        0 where no wall is long enough.
    """
    ends = np.asarray(walls, float).reshape(-1, 4)
    along = ends[:, 2:] - ends[:, :2]
    length = np.hypot(along[:, 0], along[:, 1])
    long = length >= min_length
    direction = np.arctan2(along[long, 1], along[long, 0]) % math.pi
    order = np.argsort(direction)
    direction, length = direction[order], length[long][order]
    # Each pair once, from the smaller direction on, around the half turn; in (0, max_angle).
    after = np.concatenate([direction, direction + math.pi])
    weight = np.tile(length, 2)
    sums = [np.append(0.0, np.cumsum(weight * after**power)) for power in range(3)]
    first = np.arange(len(direction)) + 1
    last = np.maximum(np.searchsorted(after, direction + max_angle), first)
    zeroth, linear, square = (one[last] - one[first] for one in sums)
    squares = square - 2.0 * direction * linear + direction**2 * zeroth
    pairs = np.sum(length**2) + 2.0 * np.sum(length * zeroth)
    return math.sqrt(max(np.sum(length * squares) / pairs, 0.0)) if len(length) else 0.0
