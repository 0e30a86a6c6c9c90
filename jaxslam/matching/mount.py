"""Where the scanner is on the robot is often not stated: what that does to its odometry.

A scanner at (t, yaw) of the wheels' centre moves, when that moves by (d, turn), by

    R(-yaw) (d + (R(turn) - I) t),    to first order in yaw:  d + (R(turn) - I) t + yaw (d_y, -d_x)

With t of covariance s^2 I, and as (R - I)(R - I)^T = 2 (1 - cos turn) I, the covariance of this is

    2 (1 - cos turn) s^2 I + s_yaw^2 (d_y, -d_x) (d_y, -d_x)^T
"""

import jax.numpy as jnp

from jaxslam.core.types import Array

MOUNT_STD = (0.2, 0.05)
"""[m], [rad] std of the scanner's place: most are within 0.4 m of the axle, aligned by eye."""


def mount_variance(odometry: Array) -> Array:
    """Covariance (3, 3) of a scanner's increment because its place on the robot is not known.

    Args:
        odometry: (3,) [m, m, rad] increment of the wheels' centre.
    """
    lever = 2.0 * (1.0 - jnp.cos(odometry[2])) * MOUNT_STD[0] ** 2
    tilted = MOUNT_STD[1] * jnp.stack([odometry[1], -odometry[0], jnp.zeros_like(odometry[0])])
    return lever * jnp.diag(jnp.array([1.0, 1.0, 0.0])) + tilted[:, None] * tilted[None]
