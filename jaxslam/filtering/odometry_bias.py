"""Slowly drifting biases of odometry, as states of the filter beside the pose.

Three numbers b, zero for odometry without systematic errors, turn a reported increment of length d
and turn t (`core.calibration.scale_increments`) into

    d' = (1 + b_0) d          t' = (1 + b_1) t + b_2 d

They begin with the standard deviations `FilterConfig.odometry_bias_std`, and are constant, or walk
randomly: over d metres the variance of b_k grows by w_k^2 d, w = `NoiseParams.odometry_bias_walk`.

In the filter the biases stand in the block of the pose: with J the derivative of the predicted pose
by b, F that by the pose, and x the landmarks,

    P_pp' = F P_pp F^T + F P_pb J^T + J P_bp F^T + J P_bb J^T + G Q G^T
    P_px' = F P_px + J P_bx,    P_bp' = P_bp F^T + P_bb J^T,    P_bb' = P_bb + diag(w^2) d

No measurement depends on b but through the pose, so an update is the same with a wider block. The
biases learn from landmarks alone: how odometry and scan matching differ changes the increment, not
b, which leaves information unused but nothing inconsistent.

References:
    Larsen, Hansen, Andersen, Ravn (1999), Design of Kalman filters for mobile robots: odometry
    errors as states of the filter.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxslam.core.calibration import Calibration, scale_increments
from jaxslam.core.se2 import range_bearing
from jaxslam.core.types import Array

NUM_BIASES = 3
"""Of distance per distance [-], of rotation per rotation [-], and of rotation per distance
[rad / m]."""


class OdometryBias(NamedTuple):
    """Gaussian over the biases, and their covariance with the rest of the belief.

    Attributes:
        mean: (3,) [-, -, rad / m].
        cov: (3, 3) covariance.
        pose_cov: (3, 3) covariance of biases (rows) and pose.
        map_cov: (3, 2 L) covariance of biases and slots.
    """

    mean: Array
    cov: Array
    pose_cov: Array
    map_cov: Array


def initial_bias(std: tuple[float, ...], max_landmarks: int, dtype: Any) -> OdometryBias:
    """Biases of mean zero and standard deviations `std`, uncorrelated with all else."""
    zeros = jnp.zeros((NUM_BIASES, NUM_BIASES), dtype)
    return OdometryBias(
        mean=jnp.zeros(NUM_BIASES, dtype),
        cov=jnp.diag(jnp.asarray(std, dtype) ** 2),
        pose_cov=zeros,
        map_cov=jnp.zeros((NUM_BIASES, 2 * max_landmarks), dtype),
    )


def correct_odometry(bias: Array, odometry: Array) -> Array:
    """Increment (3,) that odometry (3,) means if it has biases (3,)."""
    zero = jnp.zeros_like(bias[0])
    calibration = Calibration(1.0 + bias[0], 1.0 + bias[1], bias[2], jnp.zeros_like(bias), zero)
    return scale_increments(calibration, odometry)


def walk(bias: OdometryBias, std: Array, odometry: Array) -> OdometryBias:
    """The biases after a random walk over an increment (3,), of `std` (3,) per root of a metre."""
    distance = range_bearing(odometry[:2])[0]
    return bias._replace(cov=bias.cov + jnp.diag(std**2 * distance))
