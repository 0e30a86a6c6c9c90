"""Noise parameters of the filter: process noise Q of odometry, measurement noise R of features."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import sensor
from jaxslam.motion import Robot, wheel_coefficients
from jaxslam.nodes import Nodes
from jaxslam.types import WALL, Array


class Noise(NamedTuple):
    """Standard deviations that the filter assumes; traced, so that gradients can tune them.

    Every field is a standard deviation or a factor on one, never a variance.

    Attributes:
        odometry: (4,) coefficients of Q in `motion.process_noise`, standard deviations that grow
            with the root of what was driven: distance per distance [m / sqrt(m)], distance per
            rotation [m / sqrt(rad)], heading per distance [rad / sqrt(m)], heading per rotation
            [rad / sqrt(rad)].
        range: () [m] of a point feature's range, added (as a variance) to the feature's own
            covariance from the front end.
        bearing: () [rad] of a point feature's bearing, added likewise.
        scale: () [-] factor on the front end's own standard deviation of a feature.
        wall: () [rad] of a wall's direction, added likewise to the wall's own variance.
        alignment: () [-] factor on the standard deviation of scan-matched odometry; None where no
            scans are matched.
    """

    odometry: Array
    range: Array
    bearing: Array
    scale: Array
    wall: Array
    alignment: Array | None = None


def sensor_noise(noise: Noise, nodes: Nodes, *, doubt: float = 1.0) -> Array:
    """Measurement covariance R (M, 2, 2) of the features of a scan.

        point:  R = k^2 (f^2 J C J^T + diag(s_range, s_bearing)^2)     [m, rad]
        wall:   R = diag(f^2 v + s_wall^2, 1)                          [rad, -]

    C is the front end's covariance of the position, J the Jacobian of range and bearing, v the
    front end's variance of a wall's direction, f the factor `noise.scale`, and s_ the standard
    deviations in `noise`. k is 1 for a trusted point and `doubt` for another. The second number of
    a wall's measurement is always 0; its variance 1 is a placeholder.

    Args:
        noise: Noise parameters.
        nodes: Features of a scan.
        doubt: Inflation factor on the standard deviation of points that are not trusted.
    """
    own = jax.vmap(sensor.polar_cov)(nodes.xy, nodes.cov)
    added = jnp.diag(jnp.stack([noise.range, noise.bearing]) ** 2)
    inflation = jnp.where(nodes.trusted, 1.0, doubt**2).astype(own.dtype)
    point = (noise.scale**2 * own + added[None]) * inflation[:, None, None]
    angle = noise.scale**2 * nodes.variance + noise.wall**2
    zero = jnp.zeros_like(angle)
    wall = jnp.stack([jnp.stack([angle, zero], -1), jnp.stack([zero, zero + 1.0], -1)], axis=1)
    return jnp.where((nodes.kind == WALL)[:, None, None], wall, point)


def wheel_noise(robot: Robot) -> Noise:
    """Noise of a simulated robot: its encoders, and the errors of the front end on its scans."""
    return _as_arrays(
        Noise(wheel_coefficients(robot), range=0.002, bearing=0.001, scale=0.85, wall=0.0001)
    )


def log_noise(*, aligned: bool = False) -> Noise:
    """Noise for recorded laser logs of unknown robots: conservative.

    Args:
        aligned: Whether odometry is fused with scan matching. Odometry is then trusted less: where
            the robot slips, it must not bias the heading that the scans determine.
    """
    odometry = [0.1, 0.1, 0.2, 0.4] if aligned else [0.05, 0.05, 0.05, 0.05]
    return _as_arrays(
        Noise(
            jnp.array(odometry, float),
            range=0.05,
            bearing=0.01,
            scale=1.5,
            wall=0.03,
            alignment=0.3 if aligned else None,
        )
    )


def sighting_noise() -> Noise:
    """Hand-set noise for a small robot that measures range and bearing of known landmarks."""
    return _as_arrays(Noise(jnp.full(4, 0.1), range=0.15, bearing=0.03, scale=1.0, wall=0.03))


def _as_arrays(noise: Noise) -> Noise:
    """The same noise, each of its numbers an array of the default float type."""
    return jax.tree.map(lambda value: jnp.asarray(value, float), noise)
