"""Which motion is expected of a scan: that of the wheels, as far as they have been right of late.

A robot is heavy: from scan to scan its motion changes little. Where the wheels contradict the scans
again and again, the motion is expected to be as before; else as the wheels say. Both predictions
are Gaussian, and are combined by their information:

    trust = 1 - distrust,    distrust = running mean of "the wheels contradicted the scan"
    information = trust / std_odometry^2 + distrust / std_change^2
"""

from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.core.se2 import wrap_angle
from jaxslam.core.types import Array
from jaxslam.matching.icp import MotionHistory, ScanMatchSpec
from jaxslam.matching.mount import mount_variance

MEMORY = 0.9
"""Weight of the past in running means of what is usual; ten scans."""

TRUST_MEMORY = 0.8
"""The same of contradictions; five scans."""

CONTRADICTION_STD = 3.0
"""Standard deviations beyond which an increment contradicts what was expected."""

LEAST_CHANGE = (0.02, 0.02)
"""[m], [rad] by which the motion may always change from scan to scan."""


class ExpectedMotion(NamedTuple):
    """Expected increment since the scan before, in the frame of its pose.

    Attributes:
        increment: (3,) [m, m, rad].
        information: (3,) inverse variances.
        trust: () 0 to 1, weight of the wheels.
    """

    increment: Array
    information: Array
    trust: Array


def first_history() -> MotionHistory:
    """Before the first scan: a robot at rest, wheels that are trusted, changes as of any robot."""
    return MotionHistory(jnp.zeros(3), jnp.array([0.1, 0.1]), jnp.zeros(()), jnp.ones(()))


def expected_motion(
    spec: ScanMatchSpec, history: MotionHistory, odometry: Array, distrust: Array
) -> ExpectedMotion:
    """Expected increment of the next scan.

    Args:
        spec: Options.
        history: Of the scans before.
        odometry: (3,) [m, m, rad] increment by the wheels.
        distrust: () 0 to 1, of these wheels.
    """
    trust = (1.0 - distrust) if spec.use_odometry else jnp.zeros_like(distrust)
    by_wheels = trust / odometry_variance(spec, odometry)
    as_before = (1.0 - trust) / _per_axis(2.0 * history.usual_change) ** 2
    information = by_wheels + as_before
    step = difference(odometry, history.increment)
    return ExpectedMotion(odometry + as_before / information * step, information, trust)


def odometry_variance(spec: ScanMatchSpec, odometry: Array) -> Array:
    """Variances (3,) of an odometry increment: a floor, slip, and a scanner off the wheels' centre."""
    moved = magnitude(odometry)
    std = jnp.array(spec.odometry_std_floor), jnp.array(spec.odometry_slip) * moved
    variance = _per_axis(std[0] ** 2 + std[1] ** 2)
    return variance + jnp.diagonal(mount_variance(odometry))


def is_leap(history: MotionHistory, odometry: Array) -> Array:
    """Whether the wheels report a change of the motion far beyond what is usual; () bool."""
    change = magnitude(difference(history.increment, odometry))
    return jnp.any(change > CONTRADICTION_STD * history.usual_change + 2.5 * jnp.array(LEAST_CHANGE))


def contradicts(spec: ScanMatchSpec, odometry: Array, increment: Array) -> Array:
    """Whether an increment (3,) is one that the wheels rule out; () bool."""
    off = difference(odometry, increment)
    return jnp.any(off**2 > CONTRADICTION_STD**2 * odometry_variance(spec, odometry))


def next_history(
    history: MotionHistory, increment: Array, inlier_fraction: Array, contradicted: Array
) -> MotionHistory:
    """The history after a scan."""
    change = magnitude(difference(history.increment, increment))
    # A single wrong match must not make leaps usual.
    change = jnp.clip(change, jnp.array(LEAST_CHANGE), 3.0 * history.usual_change)
    return MotionHistory(
        increment,
        MEMORY * history.usual_change + (1.0 - MEMORY) * change,
        TRUST_MEMORY * history.distrust + (1.0 - TRUST_MEMORY) * contradicted,
        MEMORY * history.usual_inliers + (1.0 - MEMORY) * inlier_fraction,
    )


def difference(start: Array, end: Array) -> Array:
    """end - start (3,) of two increments, the angle wrapped."""
    off = end - start
    return off.at[2].set(wrap_angle(off[2]))


def magnitude(increment: Array) -> Array:
    """Distance [m] and turn [rad] of an increment (3,): (2,)."""
    return jnp.stack([jnp.hypot(increment[0], increment[1]), jnp.abs(increment[2])])


def _per_axis(x: Array) -> Array:
    """(3,) of numbers (2,) for distance and turn."""
    return x[jnp.array([0, 0, 1])]
