"""Motion model of odometry: the process noise Q of an increment."""

import jax.numpy as jnp

from jaxslam.core.se2 import range_bearing, unit_vector
from jaxslam.core.types import Array


def odometry_cov(coefficients: Array, increment: Array) -> Array:
    """Process noise Q (3, 3) of an increment, in the frame of the pose before it.

    Over d metres and t radians, the variances of the distance and of the heading grow as

        var_d = o0^2 |d| + o1^2 |t|        var_t = o2^2 |d| + o3^2 |t|

    The distance error e points along t / 2. The heading error is a random walk w(s), with s = 0..1
    the fraction of the increment driven, var w(s) = s var_t. It rotates the rest of the increment,
    so the end moves sideways by p times the mean of w, p being the increment turned left by 90
    degrees:

        var mean(w) = var_t / 3        cov(mean(w), w(1)) = var_t / 2

    that is, mean(w) = w(1) / 2 + r, with r independent of w(1) and var r = var_t / 12. So

        error = e (cos t/2, sin t/2, 0) + w(1) (p / 2, 1) + r (p, 0)
        Q = G^T diag(var_d, var_t, var_t / 12) G,    rows of G: these three vectors

    which is positive semi-definite. The curvature of the arc within one increment is neglected; it
    adds terms of order t^2.

    Args:
        coefficients: (4,) o0 [m / sqrt(m)], o1 [m / sqrt(rad)], o2 [rad / sqrt(m)],
            o3 [rad / sqrt(rad)]: the alphas of an odometry motion model.
        increment: (3,) the increment [m, m, rad].

    References:
        Compare the odometry motion model of Thrun, Burgard, Fox (2005), Probabilistic Robotics,
        section 5.4.
    """
    driven = jnp.stack([range_bearing(increment[:2])[0], jnp.abs(increment[2])])
    var_d, var_t = coefficients[:2] ** 2 @ driven, coefficients[2:] ** 2 @ driven
    zero = jnp.zeros_like(increment[:1])
    sideways = jnp.concatenate([-increment[1:2], increment[:1], zero])
    directions = jnp.stack(
        [
            jnp.concatenate([unit_vector(increment[2] / 2), zero]),
            sideways / 2 + jnp.concatenate([zero, zero, zero + 1]),
            sideways,
        ]
    )
    return directions.T @ (jnp.stack([var_d, var_t, var_t / 12])[:, None] * directions)


def wheel_coefficients(wheel_base: float, encoder_noise: float) -> Array:
    """Coefficients (4,) of `odometry_cov` for the encoder noise of a robot's wheels.

    The error of a wheel that rolls a distance w has standard deviation k sqrt(|w|), so
    var_d = k^2 (|l| + |r|) / 4 and var_t = k^2 (|l| + |r|) / base^2. Driving straight |l| + |r| is
    2 d, turning in place it is base |t|; on an arc the sum of the two is an upper bound, and the
    small correlation of distance with heading is neglected.
    """
    squares = jnp.array([1 / 2, wheel_base / 4, 2 / wheel_base**2, 1 / wheel_base])
    return encoder_noise * jnp.sqrt(squares)
