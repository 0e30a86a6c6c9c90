"""Fusion of odometry with scan matching, robust against odometry that is wrong.

A Kalman update in information form, with the covariance Q of the odometry and the information H of
the scan:

    cov = (w Q^-1 + H)^-1        increment = odometry + cov H (match - odometry)

The weight w is that of a Student t distribution of nu degrees of freedom, after one step of
iteratively reweighted least squares: 1 where both agree, and small where the squared Mahalanobis
distance d^2 of their difference is large,

    w = min(1, (nu + 3) / (nu + d^2))        d^2 = e^T (Q + H^-1)^-1 e,    e = match - odometry

where (Q + H^-1)^-1 = H - H (Q^-1 + H)^-1 H also for a singular H, as in a corridor.

Where the scanner is on the robot is often not stated. If it is at (t, yaw) in the frame of the
wheels' centre, and this moves by (d, turn), the scanner moves, to first order in yaw, by

    d + (R(turn) - I) t + yaw (d_y, -d_x)

With t of covariance s^2 I, and as (R - I)(R - I)^T = 2 (1 - cos turn) I, Q grows by

    2 (1 - cos turn) s^2 I + s_yaw^2 (d_y, -d_x) (d_y, -d_x)^T

References:
    Lange, Little, Taylor (1989), Robust statistical modeling using the t distribution.
"""

import jax.numpy as jnp

from jaxslam.core.linalg import inverse_cholesky
from jaxslam.core.measurement import ScanMatch
from jaxslam.core.se2 import wrap_angle
from jaxslam.core.types import Array

FUSION_STD_FLOOR = (0.01, 0.005)
"""[m], [rad] least std of odometry where it is fused with scans."""

MOUNT_STD = (0.2, 0.05)
"""[m], [rad] std of a scanner's place that is not stated: most are within 0.4 m of the axle, and
aligned by eye."""

DEGREES_OF_FREEDOM = 3.0
"""nu of the Student t distribution: heavy tails, and yet a finite variance."""


def fuse_odometry(
    std_scale: Array, odometry: Array, odometry_cov: Array, scan_match: ScanMatch
) -> tuple[Array, Array]:
    """Increment (3,) by odometry and scan matching together, and its covariance (3, 3).

    Without information of the scan, the odometry and its covariance are returned as they are.

    Args:
        std_scale: () factor on the standard deviation of scan matching.
        odometry: (3,) [m, m, rad] odometry increment.
        odometry_cov: (3, 3) its covariance; `FUSION_STD_FLOOR` and `mount_cov` are added where
            there is something to fuse it with.
        scan_match: Result of scan matching; `expected` takes the place of the odometry.
    """
    information = scan_match.information / std_scale**2
    floor = jnp.array([FUSION_STD_FLOOR[0], FUSION_STD_FLOOR[0], FUSION_STD_FLOOR[1]]) ** 2
    floor = jnp.diag(floor) + mount_cov(odometry)
    if scan_match.expected is not None and scan_match.expected_variance is not None:
        odometry = scan_match.expected
        odometry_cov = odometry_cov + jnp.diag(scan_match.expected_variance)
    innovation = scan_match.increment - odometry
    innovation = innovation.at[2].set(wrap_angle(innovation[2]))
    odometry_root = inverse_cholesky(odometry_cov + floor)[0]
    odometry_information = odometry_root.T @ odometry_root
    weight = student_weight(odometry_information, information, innovation)
    cov_root = inverse_cholesky(weight * odometry_information + information)[0]
    cov = cov_root.T @ cov_root
    matched = jnp.any(scan_match.information != 0.0)
    increment = odometry + cov @ (information @ innovation)
    return jnp.where(matched, increment, odometry), jnp.where(matched, cov, odometry_cov)


def student_weight(odometry_information: Array, information: Array, innovation: Array) -> Array:
    """Weight w () of the odometry; the module's docstring has the formula.

    Args:
        odometry_information: (3, 3) Q^-1, positive definite.
        information: (3, 3) H of the scan, perhaps singular.
        innovation: (3,) e.
    """
    root = inverse_cholesky(odometry_information + information)[0]
    pull = information @ innovation
    square = jnp.maximum(innovation @ pull - jnp.sum((root @ pull) ** 2), 0.0)
    return jnp.minimum(1.0, (DEGREES_OF_FREEDOM + 3.0) / (DEGREES_OF_FREEDOM + square))


def mount_cov(odometry: Array) -> Array:
    """Covariance (3, 3) of an odometry increment (3,) for a scanner at an unknown place."""
    lever = 2.0 * (1.0 - jnp.cos(odometry[2])) * MOUNT_STD[0] ** 2
    tilted = MOUNT_STD[1] * jnp.stack([odometry[1], -odometry[0], jnp.zeros_like(odometry[0])])
    return lever * jnp.diag(jnp.array([1.0, 1.0, 0.0])) + tilted[:, None] * tilted[None]
