"""Which motion is expected of a scan: that of the wheels, as far as they have been right of late.

A robot is heavy: its motion changes little from scan to scan. Where the scans contradict the wheels
again and again, the motion is expected to be as before; else as the wheels say. Both predictions
are Gaussian, and are combined by their information:

    distrust = running mean of "the scan contradicted the wheels"
    information = (1 - distrust) / std_odometry^2 + distrust / std_change^2

where std_change is twice the usual change of the motion from scan to scan.
"""

from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.core.se2 import wrap_angle
from jaxslam.core.types import Array
from jaxslam.matching.icp import MotionHistory, ScanMatchSpec
from jaxslam.matching.odometry_fusion import mount_cov

MEMORY = 0.9
"""Weight of the past in the running means of what is usual: ten scans."""

DISTRUST_MEMORY = 0.8
"""The same for contradictions: five scans."""

MAX_STD = 3.0
"""Standard deviations beyond which an increment contradicts what was expected."""

LEAST_CHANGE = (0.02, 0.02)
"""[m], [rad] by which a motion may always change: errors of two matches."""

FIRST_CHANGE = (0.1, 0.1)
"""[m], [rad] usual change before there is any: robots of these logs accelerate by 1 m/s^2."""


class ExpectedMotion(NamedTuple):
    """Expected increment since the scan before, in the frame of its pose.

    Attributes:
        increment: (3,) [m, m, rad].
        information: (3,) inverse variances.
        odometry_weight: () 0 to 1, of the wheels.
    """

    increment: Array
    information: Array
    odometry_weight: Array


def first_history() -> MotionHistory:
    """Before the first scan: a robot at rest, and wheels that are trusted."""
    return MotionHistory(jnp.zeros(3), jnp.array(FIRST_CHANGE), jnp.zeros(()), jnp.ones(()))


def expected_motion(
    spec: ScanMatchSpec, history: MotionHistory, odometry: Array, distrust: Array
) -> ExpectedMotion:
    """Expected increment of the next scan.

    Args:
        spec: Options; without `use_odometry` the motion is expected to be as before.
        history: Of the scans before.
        odometry: (3,) [m, m, rad] increment by the wheels.
        distrust: () 0 to 1, of these wheels.
    """
    weight = 1.0 - distrust if spec.use_odometry else jnp.zeros_like(distrust)
    by_wheels = weight / odometry_variance(spec, odometry)
    as_before = (1.0 - weight) / change_variance(history)
    information = by_wheels + as_before
    change = difference(odometry, history.increment)
    return ExpectedMotion(odometry + as_before / information * change, information, weight)


def odometry_variance(spec: ScanMatchSpec, odometry: Array) -> Array:
    """Variances (3,) of an odometry increment: a floor, slip, and an unknown mount."""
    slip = jnp.array(spec.odometry_slip) * magnitude(odometry)
    variance = jnp.array(spec.odometry_std_floor) ** 2 + slip**2
    return _per_axis(variance) + jnp.diagonal(mount_cov(odometry))


def change_variance(history: MotionHistory) -> Array:
    """Variances (3,) of the change of the motion from the last scan to the next."""
    return _per_axis(2.0 * history.usual_change) ** 2


def is_leap(history: MotionHistory, odometry: Array) -> Array:
    """Whether trusted wheels report a change of the motion far beyond what is usual; () bool."""
    change = magnitude(difference(history.increment, odometry))
    far = change > MAX_STD * (history.usual_change + jnp.array(LEAST_CHANGE))
    return jnp.any(far) & (history.distrust < 0.5)


def contradicts(spec: ScanMatchSpec, odometry: Array, increment: Array) -> Array:
    """Whether an increment (3,) of the scans is one that the wheels rule out; () bool."""
    off = difference(odometry, increment)
    return jnp.any(off**2 > MAX_STD**2 * odometry_variance(spec, odometry))


def next_history(
    history: MotionHistory, increment: Array, inlier_fraction: Array, contradicted: Array
) -> MotionHistory:
    """The history after a scan, of an increment (3,)."""
    change = magnitude(difference(history.increment, increment))
    # One wrong match must not make leaps usual.
    change = jnp.clip(change, jnp.array(LEAST_CHANGE), MAX_STD * history.usual_change)
    contradiction = contradicted.astype(increment.dtype)
    return MotionHistory(
        increment,
        MEMORY * history.usual_change + (1.0 - MEMORY) * change,
        DISTRUST_MEMORY * history.distrust + (1.0 - DISTRUST_MEMORY) * contradiction,
        MEMORY * history.usual_inliers + (1.0 - MEMORY) * inlier_fraction,
    )


def difference(start: Array, end: Array) -> Array:
    """End - start (3,) of two increments, the angle wrapped."""
    off = end - start
    return off.at[2].set(wrap_angle(off[2]))


def magnitude(increment: Array) -> Array:
    """Distance [m] and turn [rad] of an increment (3,): (2,)."""
    return jnp.stack([jnp.hypot(increment[0], increment[1]), jnp.abs(increment[2])])


def _per_axis(x: Array) -> Array:
    """(3,) of numbers (2,) for distance and turn."""
    return jnp.stack([x[0], x[0], x[1]])
