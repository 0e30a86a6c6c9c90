"""Noise the filter assumes of odometry and features, for three kinds of robot."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import sensor
from jaxslam.motion import Robot, wheel_coefficients
from jaxslam.nodes import Nodes
from jaxslam.types import WALL, Array


class Noise(NamedTuple):
    """Standard deviations the filter assumes; traced, so that they can be tuned by gradient."""

    odometry: Array  # (4,) distance per m^.5, per rad^.5; heading per m^.5, per rad^.5
    range: Array  # () [m] of a landmark's range, beyond its own covariance
    bearing: Array  # () [rad] likewise
    scale: Array  # () factor on the landmark's own standard deviation
    wall: Array  # () [rad] of a wall's direction, beyond its own variance
    alignment: Array | None = None  # () factor on the standard deviation of aligned motions, if any


def sensor_noise(noise: Noise, nodes: Nodes, *, doubt: float = 1.0) -> Array:
    """Covariance (M, 2, 2) of the features in range and bearing, or in direction (and 0).

    Args:
        noise: What the filter assumes.
        nodes: Features of a scan.
        doubt: Factor on the standard deviation of places that are not trusted.
    """
    own = jax.vmap(sensor.polar_cov)(nodes.xy, nodes.cov)
    floor = jnp.diag(jnp.stack([noise.range, noise.bearing]) ** 2)
    unsure = jnp.where(nodes.trusted, 1.0, doubt**2).astype(own.dtype)
    point = (noise.scale**2 * own + floor[None]) * unsure[:, None, None]
    wall = noise.scale**2 * nodes.variance + noise.wall**2
    zero = jnp.zeros_like(wall)
    wall = jnp.stack([jnp.stack([wall, zero], -1), jnp.stack([zero, zero + 1.0], -1)], axis=1)
    return jnp.where((nodes.kind == WALL)[:, None, None], wall, point)


def wheel_noise(robot: Robot) -> Noise:
    """Noise of a simulated robot: its encoders, and how well the front end finds landmarks."""
    return _noise(wheel_coefficients(robot), range=0.002, bearing=0.001, scale=0.85, wall=0.0001)


def log_noise(*, aligned: bool = False) -> Noise:
    """Noise for recorded logs of unknown robots: cautious.

    Args:
        aligned: Whether scans are aligned, and their motions fused with the odometry.
    """
    rest = {"range": 0.05, "bearing": 0.01, "scale": 1.5, "wall": 0.03}
    if aligned:  # wheels that slip must not pull at the heading that scans show
        return _noise([0.1, 0.1, 0.2, 0.4], **rest, alignment=0.3)
    return _noise([0.05] * 4, **rest)


def sighting_noise() -> Noise:
    """Noise one would set by hand for a small robot that reads range and bearing of landmarks."""
    return _noise(jnp.full(4, 0.1), range=0.15, bearing=0.03, scale=1.0, wall=0.03)


def _noise(odometry: Array, **rest: float) -> Noise:
    odometry = jnp.asarray(odometry, float)
    return Noise(odometry, **{name: jnp.asarray(value, float) for name, value in rest.items()})
