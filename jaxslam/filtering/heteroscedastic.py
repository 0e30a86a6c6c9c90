"""Noise that depends on what is known at the step: factors on the standard deviations of Q and R.

A factor is exp(w . f) with features f of the step, which are data, and weights w, which are tuned
like the noise itself. Weights of zero are constant noise, exactly. Each standard deviation has its
own weights, which may have any sign:

    R of a point  =  S R S,   S = diag(factor of the range, factor of the bearing)
    R of a wall   =  that of its direction, times the square of its factor
    Q             :  the standard deviations of distance and heading, and of scan matching

The exponent is limited to `MAX_EXPONENT`, so that no noise overflows on its path to better weights.

References:
    Harvey (1976), Estimating regression models with multiplicative heteroscedasticity.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement
from jaxslam.core.se2 import range_bearing
from jaxslam.core.types import CORNER, JUNCTION, Array

MAX_EXPONENT = 10.0  # a factor of 20 000 on a standard deviation


class MeasurementWeights(NamedTuple):
    """Weights of R, each (3,): of the range, of the bearing, of the direction of a wall.

    Those that are None are not used; the others are tuned.

    Attributes:
        range: [1 / m] of the distance to a point; 0 for a wall.
        incidence: [1 / rad] of the largest angle between the beam and the normals of the walls of
            a feature, 0 to pi / 2: `Features.incidence`, or that of a corner, and 0 for other
            kinds, where the front end does not state it (`incidence`).
        turn: [1 / rad] of the angle by which the robot turned since the step before.
        clearance: [1 / m] of the clearance of a junction; 0 for other kinds.
        unexplained: [-] of the fraction of the scan's points that scan matching does not explain;
            0 where no scans are matched.
    """

    range: Array | None = None
    incidence: Array | None = None
    turn: Array | None = None
    clearance: Array | None = None
    unexplained: Array | None = None


class OdometryWeights(NamedTuple):
    """Weights of Q, each (3,): of the error of distance, of heading, and of scan matching.

    Those that are None are not used; the others are tuned.

    Attributes:
        distance: [1 / m] of the distance driven since the step before.
        turn: [1 / rad] of the angle by which the robot turned since the step before.
        clearance: [1 / m] of the mean clearance of the junctions in sight; 0 where there is none.
        unexplained: [-] of the fraction of the scan's points that scan matching does not explain;
            0 where no scans are matched.
    """

    distance: Array | None = None
    turn: Array | None = None
    clearance: Array | None = None
    unexplained: Array | None = None


WEIGHTS = {"odometry_weights": OdometryWeights, "measurement_weights": MeasurementWeights}
"""Types of weights by the fields of `NoiseParams` that hold them."""


def incidence(features: Features) -> Array:
    """Largest angle (M,) [rad] between the beam to a feature and the normals of its walls.

    That of the front end, if `FeatureSpec.incidence` is on. Otherwise that of corners, and 0 for
    other kinds: a corner's walls leave it at its direction plus and minus half the angle of its
    free side, and the sine of the angle between beam and wall is the cosine of the incidence.
    """
    if features.incidence is not None:
        return jnp.where(features.valid, features.incidence, 0.0)
    bearing = jax.vmap(range_bearing)(features.xy)[:, 1]
    half = features.descriptor / 2
    walls = jnp.stack([features.direction - half, features.direction + half])
    grazing = jnp.min(jnp.abs(jnp.sin(walls - bearing[None])), axis=0)
    is_corner = features.valid & (features.kind == CORNER)
    return jnp.where(is_corner, jnp.arccos(jnp.minimum(grazing, 1.0)), 0.0)


def measurement_factors(
    weights: MeasurementWeights, features: Features, measurement: Measurement
) -> Array:
    """Factors (M, 3) on the standard deviations of range, bearing and direction of a wall.

    Args:
        weights: Weights of R.
        features: Features of the scan, of the configured kinds.
        measurement: Of the step.
    """
    exponent = jnp.zeros((features.kind.size, 3), features.xy.dtype)
    if weights.range is not None:
        distance = jax.vmap(range_bearing)(features.xy)[:, 0]
        exponent += distance[:, None] * weights.range[None]
    if weights.incidence is not None:
        exponent += incidence(features)[:, None] * weights.incidence[None]
    if weights.turn is not None:
        exponent += (_turn(measurement) * weights.turn)[None]
    if weights.clearance is not None:
        exponent += _clearance(features)[:, None] * weights.clearance[None]
    if weights.unexplained is not None:
        exponent += (_unexplained(measurement) * weights.unexplained)[None]
    return jnp.exp(jnp.clip(exponent, -MAX_EXPONENT, MAX_EXPONENT))


def odometry_factors(weights: OdometryWeights, measurement: Measurement) -> Array:
    """Factors (3,) on the standard deviations of distance, heading and scan matching.

    Args:
        weights: Weights of Q.
        measurement: Of the step.
    """
    exponent = jnp.zeros(3, measurement.odometry.dtype)
    if weights.distance is not None:
        exponent += range_bearing(measurement.odometry[:2])[0] * weights.distance
    if weights.turn is not None:
        exponent += _turn(measurement) * weights.turn
    if weights.clearance is not None:
        clearance = _clearance(measurement.features)
        count = jnp.maximum(jnp.sum(clearance > 0.0), 1).astype(clearance.dtype)
        exponent += jnp.sum(clearance) / count * weights.clearance
    if weights.unexplained is not None:
        exponent += _unexplained(measurement) * weights.unexplained
    return jnp.exp(jnp.clip(exponent, -MAX_EXPONENT, MAX_EXPONENT))


def _turn(measurement: Measurement) -> Array:
    """Angle () [rad], not negative, by which the robot turned in the step."""
    return jnp.abs(measurement.odometry[2])


def _clearance(features: Features) -> Array:
    """Clearance (M,) [m] of junctions; 0 for other kinds."""
    is_junction = features.valid & (features.kind == JUNCTION)
    return jnp.where(is_junction & jnp.isfinite(features.descriptor), features.descriptor, 0.0)


def _unexplained(measurement: Measurement) -> Array:
    """Fraction () of the points that scan matching does not explain; 0 without any."""
    match = measurement.scan_match
    if match is None:
        return jnp.zeros((), measurement.odometry.dtype)
    return jnp.clip(1.0 - match.inlier_fraction, 0.0, 1.0)
