"""Noise parameters of the filter: process noise Q of odometry, measurement noise R of features."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.batching import on_device
from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import WALL, Array
from jaxslam.filtering import measurement_model
from jaxslam.filtering.heteroscedastic import (
    MeasurementWeights,
    OdometryWeights,
    measurement_factors,
    odometry_factors,
)
from jaxslam.filtering.motion_model import odometry_cov, odometry_rate_cov, wheel_coefficients
from jaxslam.filtering.noise_model import NoiseModel, change_measurement_cov, change_odometry_cov
from jaxslam.matching import odometry_fusion


class NoiseParams(NamedTuple):
    """Standard deviations that the filter assumes; traced, so that gradients can tune them.

    Every field up to `scan_match_std_scale` is a standard deviation or a factor on one, never a
    variance. Those after it are options; None is off, which costs nothing.

    Attributes:
        odometry_coefficients: (4,) coefficients of Q in `motion_model.odometry_cov`, standard
            deviations that grow with the root of what was driven: distance per distance
            [m / sqrt(m)], distance per rotation [m / sqrt(rad)], heading per distance
            [rad / sqrt(m)], heading per rotation [rad / sqrt(rad)]; 0 for none.
        range_std: () [m] of a point feature's range, added (as a variance) to the feature's own
            covariance from the front end.
        bearing_std: () [rad] of a point feature's bearing, added likewise.
        feature_std_scale: () [-] factor on the front end's own standard deviation of a feature.
        wall_angle_std: () [rad] of a wall's direction, added likewise to the wall's own variance.
        scan_match_std_scale: () [-] factor on the standard deviation of scan-matched odometry; None
            where no scans are matched.
        odometry_cov_rate: (3, 3) covariance per metre of errors of x, y and heading, in addition
            to the coefficients; positive semi-definite (`motion_model.odometry_rate_cov`).
        odometry_weights: Weights of factors on the standard deviations of Q, that depend on the
            step; any sign (`heteroscedastic`).
        measurement_weights: Likewise of R.
        student_dof: () degrees of freedom of a Student t distribution that the innovations of
            features have instead of a Gaussian (`robust`); Q and R are then scales.
        odometry_bias_walk: (3,) growth of the standard deviations of the biases of odometry, per
            root of a metre (`odometry_bias`); None: they are constant. 0 for one that is.
        custom: Parameters of `FilterConfig.noise_model`: any tree of arrays, of any sign.
    """

    odometry_coefficients: Array
    range_std: Array
    bearing_std: Array
    feature_std_scale: Array
    wall_angle_std: Array
    scan_match_std_scale: Array | None = None
    odometry_cov_rate: Array | None = None
    odometry_weights: OdometryWeights | None = None
    measurement_weights: MeasurementWeights | None = None
    student_dof: Array | None = None
    odometry_bias_walk: Array | None = None
    custom: Any = None

    @classmethod
    def for_simulated_robot(
        cls, wheel_base: float = 0.4, encoder_noise: float = 0.005
    ) -> "NoiseParams":
        """Noise of a simulated robot: its encoders, and the errors of the front end on its scans.

        Args:
            wheel_base: [m] between the wheels.
            encoder_noise: [m / sqrt(m)] standard deviation of an encoder.

        Raises:
            ValueError: One of them is not positive and finite.
        """
        for name, value in (("wheel_base", wheel_base), ("encoder_noise", encoder_noise)):
            if not (isinstance(value, jax.core.Tracer) or 0.0 < value < math.inf):
                raise ValueError(f"{name} is {value!r}, not positive and finite")
        odometry = wheel_coefficients(wheel_base, encoder_noise)
        return cls(*_arrays(odometry, 0.002, 0.001, 0.85, 0.0001))

    @classmethod
    def for_laser_log(cls, *, match_scans: bool = False) -> "NoiseParams":
        """Noise for recorded laser logs of unknown robots: conservative.

        Args:
            match_scans: Whether odometry is fused with scan matching. Odometry is then trusted
                less: where the robot slips, it must not bias the heading that the scans determine.
        """
        if match_scans:
            return cls(*_arrays([0.1, 0.1, 0.2, 0.4], 0.05, 0.01, 1.5, 0.03, 0.3))
        return cls(*_arrays([0.05, 0.05, 0.05, 0.05], 0.05, 0.01, 1.5, 0.03))

    @classmethod
    def for_landmark_sensor(cls, *, student_dof: float | None = None) -> "NoiseParams":
        """Hand-set noise for a small robot that measures range and bearing of known landmarks.

        Args:
            student_dof: Of innovations with heavy tails, as where the sensor takes one landmark for
                another now and then: 4, for example. None: they are Gaussian.
        """
        params = cls(*_arrays([0.1, 0.1, 0.1, 0.1], 0.15, 0.03, 1.0, 0.03))
        return (
            params
            if student_dof is None
            else params._replace(student_dof=jnp.asarray(student_dof, float))
        )


def _arrays(*numbers: Any) -> Iterator[Any]:
    """Numbers as arrays of JAX's default float type."""
    return (
        jnp.asarray(x, float) if isinstance(x, jax.Array) else on_device(np.asarray(x, float))
        for x in numbers
    )


def measurement_cov(
    params: NoiseParams,
    features: Features,
    measurement: Measurement,
    *,
    untrusted_inflation: float = 1.0,
    noise_model: NoiseModel | None = None,
) -> Array:
    """Measurement covariance R (M, 2, 2) of the features of a scan.

        point:  R = k^2 (f^2 J C J^T + diag(s_range, s_bearing)^2)     [m, rad]
        wall:   R = diag(f^2 v + s_wall^2, 1)                          [rad, -]

    C is the front end's covariance of the position, J the Jacobian of range and bearing, v the
    front end's variance of a wall's direction, f the factor `params.feature_std_scale`, and s_ the
    standard deviations in `params`. k is 1 for a trusted point and `untrusted_inflation` for
    another. The second number of a wall's measurement is always 0; its variance 1 is a placeholder.
    With `params.measurement_weights` each standard deviation has a factor (`heteroscedastic`).

    Args:
        params: Noise parameters.
        features: Features of a scan, of the configured kinds.
        measurement: Of the step, whose features they are.
        untrusted_inflation: Factor on the standard deviation of points that are not trusted.
        noise_model: Functions that change R, if any.
    """
    own = jax.vmap(measurement_model.polar_cov)(features.xy, features.cov)
    added = jnp.diag(jnp.stack([params.range_std, params.bearing_std]) ** 2)
    inflation = jnp.where(features.trusted, 1.0, untrusted_inflation**2).astype(own.dtype)
    point = (params.feature_std_scale**2 * own + added[None]) * inflation[:, None, None]
    angle = params.feature_std_scale**2 * features.direction_variance + params.wall_angle_std**2
    zero = jnp.zeros_like(angle)
    if params.measurement_weights is not None:
        factors = measurement_factors(params.measurement_weights, features, measurement)
        point *= factors[:, :2, None] * factors[:, None, :2]
        angle *= factors[:, 2] ** 2
    wall = jnp.stack([jnp.stack([angle, zero], -1), jnp.stack([zero, zero + 1.0], -1)], axis=1)
    R = jnp.where((features.kind == WALL)[:, None, None], wall, point)
    if noise_model is None:
        return R
    return change_measurement_cov(noise_model, params.custom, features, measurement, R)


def motion_estimate(
    params: NoiseParams, measurement: Measurement, *, noise_model: NoiseModel | None = None
) -> tuple[Array, Array]:
    """Odometry increment of a step, fused with scan matching where there is any.

    Args:
        params: Noise parameters.
        measurement: Odometry, and scan matching if any.
        noise_model: Functions that change Q, if any.

    Returns:
        The increment (3,) [m, m, rad] since the step before, in the frame of that pose, and its
        covariance (3, 3).

    Raises:
        ValueError: There is scan matching, and `params.scan_match_std_scale` is None; while
            tracing.
    """
    coefficients, rate = params.odometry_coefficients, params.odometry_cov_rate
    scan_match_std_scale = params.scan_match_std_scale
    if params.odometry_weights is not None:
        distance, heading, matching = odometry_factors(params.odometry_weights, measurement)
        coefficients *= jnp.stack([distance, distance, heading, heading])
        if rate is not None:
            each = jnp.stack([distance, distance, heading])
            rate *= each[:, None] * each[None]
        if scan_match_std_scale is not None:
            scan_match_std_scale *= matching
    motion_cov = odometry_cov(coefficients, measurement.odometry)
    if rate is not None:
        motion_cov += odometry_rate_cov(rate, measurement.odometry)
    if noise_model is not None:
        motion_cov = change_odometry_cov(noise_model, params.custom, measurement, motion_cov)
    if measurement.scan_match is None:
        return measurement.odometry, motion_cov
    if scan_match_std_scale is None:
        raise ValueError("params.scan_match_std_scale is None, but measurement.scan_match is given")
    return odometry_fusion.fuse_odometry(
        scan_match_std_scale, measurement.odometry, motion_cov, measurement.scan_match
    )
