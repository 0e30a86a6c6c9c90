"""Motion model of odometry: the process noise Q of an increment."""

import jax.numpy as jnp

from jaxslam.core.se2 import range_bearing, rotation, unit_vector
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


def odometry_rate_cov(rate: Array, increment: Array) -> Array:
    """Process noise Q (3, 3) of errors that grow with the distance, in the frame of `odometry_cov`.

    While the robot drives, errors of x, y and heading are added all the time, white, of covariance
    `rate` per metre: it may hold sideways slip, and a correlation of distance with heading, which
    four coefficients do not. An error at the fraction s = 0..1 of the increment is turned to its
    mean direction T = diag(R(t / 2), 1), and its heading swings the rest of the increment: with p
    as in `odometry_cov` and N = (p, 0) (0, 0, 1),

        A = T rate T^T,      Q = d  integral of (I + (1 - s) N) A (I + (1 - s) N)^T  over s = 0..1
                               = d (A + (N A + A N^T) / 2 + N A N^T / 3)

    which is positive semi-definite if `rate` is, and exactly that of the coefficients
    (o0, 0, o2, 0) if `rate` = diag(o0^2, 0, o2^2). A robot that turns in place gets none.

    Args:
        rate: (3, 3) covariance per distance driven [m^2, m rad, rad^2 per m]; frame of the robot,
            x forward.
        increment: (3,) the increment [m, m, rad].
    """
    distance = range_bearing(increment[:2])[0]
    turned = jnp.eye(3, dtype=rate.dtype).at[:2, :2].set(rotation(increment[2] / 2))
    cov = turned @ rate @ turned.T
    sideways = jnp.stack([-increment[1], increment[0], jnp.zeros_like(distance)])
    swung = sideways[:, None] * cov[2][None]  # N A
    both = cov[2, 2] * sideways[:, None] * sideways[None]  # N A N^T
    return distance * (cov + (swung + swung.T) / 2 + both / 3)


def wheel_coefficients(wheel_base: float, encoder_noise: float) -> Array:
    """Coefficients (4,) of `odometry_cov` for the encoder noise of a robot's wheels.

    The error of a wheel that rolls a distance w has standard deviation k sqrt(|w|), so
    var_d = k^2 (|l| + |r|) / 4 and var_t = k^2 (|l| + |r|) / base^2. Driving straight |l| + |r| is
    2 d, turning in place it is base |t|; on an arc the sum of the two is an upper bound, and the
    small correlation of distance with heading is neglected.
    """
    squares = jnp.array([1 / 2, wheel_base / 4, 2 / wheel_base**2, 1 / wheel_base])
    return encoder_noise * jnp.sqrt(squares)
