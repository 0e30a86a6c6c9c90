"""Which motion is expected of a scan: that of the wheels, or one as before where these are wrong.

Wheels are right nearly always, to a few centimetres; and sometimes they are wrong by anything: they
slip, hang, or repeat old values. A robot is heavy, so then its motion is about as it was from the
scan before to the last one. With the probability o that the wheels are wrong, the pose of the scan
has the density

    p(pose) = (1 - u) ((1 - o) N(pose; as the wheels say) + o t(pose; as before))
              + u N(pose; as the wheels say, but backwards)

of Gaussians for wheels that are right, and a Student t distribution, as a motion changes now and
then by several standard deviations. Here o is how often of late the scans contradicted the wheels,
at least `MIN_OUTLIER`, and `GUESSED_OUTLIER` where the log itself says that an increment is a
guess. Some robots report the speed without its sign; so u is `MIN_OUTLIER` until the wheels first
report driving backwards, and then 0.

The quick match needs one Gaussian near the right place: what the wheels say and the motion before
are combined by their information, weighted by 1 - o and o.

Wheels may also be wrong by the same factor all the time: a tyre that is worn or soft makes every
distance some percent too long. The scale is learned during the drive, by a Kalman filter of one
number, from scans that show the motion ahead; where a corridor does not, the wheels are used with
what was learned before.
"""

from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.core.se2 import compose, wrap_angle
from jaxslam.core.types import Array
from jaxslam.matching.icp import MotionHistory, ScanMatchSpec
from jaxslam.matching.odometry_fusion import DEGREES_OF_FREEDOM, mount_cov

MEMORY = 0.9
"""Weight of the past in the running means of what is usual: ten scans."""

OUTLIER_MEMORY = 0.8
"""The same for contradictions: five scans."""

MIN_OUTLIER = 0.01
"""Least probability that the wheels are wrong."""

GUESSED_OUTLIER = 0.5
"""Probability that an increment is wrong which the log itself only guesses."""

MIN_CONTRADICTED = 0.3
"""How often the wheels were contradicted of late, from which on they may be wrong again: two scans
of the last five."""

MAX_STD = 3.0
"""Standard deviations beyond which an increment contradicts what was expected."""

SCALE_STD = 0.01
"""Standard deviation of the scale of the wheels' distances before any scan."""

SURFACE_TILT_STD = 0.1
"""[rad] std of the directions of normals, which makes a bare wall seem to show motion along it."""

LEAST_CHANGE = (0.02, 0.02)
"""[m], [rad] by which a motion may always change: errors of two matches."""

ICP_REACH = (0.2, 0.2)
"""[m], [rad] within which ICP finds a pose from another one."""

LEAST_REVERSE = -0.002
"""[m] increment ahead below which the wheels report driving backwards, not a rounding."""

HEAVY_TAILED = (False, True, False)  # of the hypotheses: wheels, as before, wheels backwards

FIRST_CHANGE = (0.1, 0.1)
"""[m], [rad] usual change before there is any: robots of these logs accelerate by 1 m/s^2."""


class WheelMotion(NamedTuple):
    """What the wheels say of the motion since the scan before.

    Attributes:
        increment: (3,) [m, m, rad] in the frame of the pose before.
        variance: (3,) [m^2, m^2, rad^2] of it where they are right.
        outlier_probability: () 0 to 1, that they are wrong.
    """

    increment: Array
    variance: Array
    outlier_probability: Array


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


class PoseHypotheses(NamedTuple):
    """Density of the pose of a scan before it is matched: a mixture of E distributions.

    Those of the wheels are Gaussian, that of the motion before is a Student t distribution.

    Attributes:
        poses: (E, 3) [m, m, rad] their means, in the frame of the submap.
        variances: (E, 3) [m^2, m^2, rad^2] their squared scales along and across the robot's
            heading before, and of the turn.
        weights: (E,) their probabilities.
        heading: () [rad] of the robot before, in the frame of the submap.
    """

    poses: Array
    variances: Array
    weights: Array
    heading: Array


def first_history() -> MotionHistory:
    """Before the first scan: a robot at rest, and wheels that are trusted."""
    return MotionHistory(
        increment=jnp.zeros(3),
        usual_change=jnp.array(FIRST_CHANGE),
        contradicted=jnp.zeros(()),
        usual_inliers=jnp.ones(()),
        wheel_scale=jnp.ones(()),
        scale_information=jnp.full((), SCALE_STD**-2, float),
        wheels_reverse=jnp.zeros((), bool),
    )


def wheel_motion(
    spec: ScanMatchSpec, history: MotionHistory, odometry: Array, guessed: Array
) -> WheelMotion:
    """The wheels' increment, how far off it may be, and how likely it is wrong.

    Args:
        spec: Options; without `use_odometry` the wheels are wrong for certain.
        history: Of the scans before.
        odometry: (3,) [m, m, rad] increment by the wheels.
        guessed: () bool, whether the log only guesses it, as a share of a longer motion: it is then
            off by the usual change from scan to scan as well.
    """
    if not spec.use_odometry:
        return WheelMotion(history.increment, change_variance(history), jnp.ones(()))
    odometry = odometry.at[:2].multiply(history.wheel_scale)
    variance = odometry_variance(spec, odometry)
    variance = jnp.where(guessed, variance + change_variance(history), variance)
    least = jnp.where(guessed, GUESSED_OUTLIER, 0.0)
    return WheelMotion(odometry, variance, jnp.maximum(history.contradicted, least))


def expected_motion(history: MotionHistory, wheels: WheelMotion) -> ExpectedMotion:
    """Expected increment of the next scan, as one Gaussian.

    Args:
        history: Of the scans before.
        wheels: What the wheels say.
    """
    weight = 1.0 - wheels.outlier_probability
    by_wheels = weight / wheels.variance
    as_before = (1.0 - weight) / change_variance(history)
    information = by_wheels + as_before
    change = difference(wheels.increment, history.increment)
    return ExpectedMotion(wheels.increment + as_before / information * change, information, weight)


def pose_hypotheses(history: MotionHistory, wheels: WheelMotion, before: Array) -> PoseHypotheses:
    """Density of the pose of the next scan; the module's docstring has the formula.

    Args:
        history: Of the scans before.
        wheels: What the wheels say.
        before: (3,) [m, m, rad] pose of the scan before.
    """
    outlier = jnp.maximum(wheels.outlier_probability, MIN_OUTLIER)
    backwards = wheels.increment.at[0].multiply(-1.0)
    unsigned = jnp.where(history.wheels_reverse, 0.0, MIN_OUTLIER)
    increments = [wheels.increment, history.increment, backwards]
    poses = jnp.stack([compose(before, increment) for increment in increments])
    variances = jnp.stack([wheels.variance, change_variance(history), wheels.variance])
    weights = jnp.stack([(1.0 - unsigned) * (1.0 - outlier), (1.0 - unsigned) * outlier, unsigned])
    return PoseHypotheses(poses, variances, weights, before[2])


def student_tail(square: Array) -> Array:
    """Logarithm of Student's t density at a squared Mahalanobis distance, relative to its peak."""
    return -0.5 * (DEGREES_OF_FREEDOM + 3.0) * jnp.log1p(square / DEGREES_OF_FREEDOM)


def log_density(hypotheses: PoseHypotheses, pose: Array) -> Array:
    """Logarithm () of the density at a pose (3,), relative to the greatest of one of its parts."""
    off = pose[None] - hypotheses.poses
    cos, sin = jnp.cos(hypotheses.heading), jnp.sin(hypotheses.heading)
    along, across = cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0]
    off = jnp.stack([along, across, wrap_angle(off[:, 2])], axis=-1)
    square = jnp.sum(off**2 / hypotheses.variances, axis=-1)
    peak = jnp.log(hypotheses.weights) - 0.5 * jnp.sum(jnp.log(hypotheses.variances), axis=-1)
    tail = student_tail(square)
    tail = jnp.where(jnp.array(HEAVY_TAILED), tail, -0.5 * square)
    logs = peak - jnp.max(peak) + tail
    return jnp.max(logs) + jnp.log(jnp.sum(jnp.exp(logs - jnp.max(logs))))


def odometry_variance(spec: ScanMatchSpec, odometry: Array) -> Array:
    """Variances (3,) of an odometry increment: a floor, slip, and an unknown mount."""
    slip = jnp.array(spec.odometry_slip) * magnitude(odometry)
    variance = jnp.array(spec.odometry_std_floor) ** 2 + slip**2
    return _per_axis(variance) + jnp.diagonal(mount_cov(odometry))


def change_variance(history: MotionHistory) -> Array:
    """Variances (3,) of the change of the motion from the last scan to the next."""
    return _per_axis(2.0 * history.usual_change) ** 2


def leap(spec: ScanMatchSpec, history: MotionHistory, wheels: WheelMotion) -> Array:
    """Whether trusted wheels report a change of the motion far beyond what is usual; () bool."""
    if not spec.use_odometry:
        return jnp.zeros((), bool)
    change = magnitude(difference(history.increment, wheels.increment))
    usual = MAX_STD * (history.usual_change + jnp.array(LEAST_CHANGE))
    far = change > jnp.maximum(usual, jnp.array(ICP_REACH))
    return jnp.any(far) & (wheels.outlier_probability < GUESSED_OUTLIER)


def wrong_again(spec: ScanMatchSpec, history: MotionHistory, wheels: WheelMotion) -> Array:
    """Whether the wheels were contradicted of late, and rule out the motion before; () bool."""
    if not spec.use_odometry:
        return jnp.zeros((), bool)
    return (history.contradicted > MIN_CONTRADICTED) & contradicts(wheels, history.increment)


def contradicts(wheels: WheelMotion, increment: Array) -> Array:
    """Whether an increment (3,) of the scans is one that the wheels rule out; () bool."""
    off = difference(wheels.increment, increment)
    return jnp.any(off**2 > MAX_STD**2 * wheels.variance)


def next_history(
    history: MotionHistory,
    wheels: WheelMotion,
    increment: Array,
    inlier_fraction: Array,
    contradicted: Array,
) -> MotionHistory:
    """The history after a scan, of an increment (3,)."""
    change = magnitude(difference(history.increment, increment))
    # One wrong match must not make leaps usual.
    change = jnp.clip(change, jnp.array(LEAST_CHANGE), MAX_STD * history.usual_change)
    contradiction = contradicted.astype(increment.dtype)
    return history._replace(
        increment=increment,
        usual_change=MEMORY * history.usual_change + (1.0 - MEMORY) * change,
        contradicted=OUTLIER_MEMORY * history.contradicted + (1.0 - OUTLIER_MEMORY) * contradiction,
        usual_inliers=MEMORY * history.usual_inliers + (1.0 - MEMORY) * inlier_fraction,
        wheels_reverse=history.wheels_reverse | (wheels.increment[0] < LEAST_REVERSE),
    )


def learn_scale(
    history: MotionHistory, wheels: WheelMotion, increment: Array, information: Array, use: Array
) -> MotionHistory:
    """The history with the scale of the wheels as a scan shows it.

    The distance ahead by the scan is m = s d + noise, with d that of the wheels and a variance that
    is the sum of theirs and of the scan's; the last is what is left of the information when
    sideways motion and turn are not known, less what tilted normals pretend. As d has noise, too,
    least squares would make s too small where motions are short. So s is estimated with an
    instrument z, the distance of the scan before with the sign of d: sum z (m - s d) / var = 0.

    Args:
        history: Before.
        wheels: What the wheels say, by the scale before.
        increment: (3,) [m, m, rad] that the scan matcher found.
        information: (3, 3) of the scan alone, in the same frame.
        use: () bool, whether these wheels are to be learned from.
    """
    rest = information[1:, 1:] + jnp.diag(1.0 / wheels.variance[1:])
    det = rest[0, 0] * rest[1, 1] - rest[0, 1] * rest[1, 0]
    a, b = information[0, 1], information[0, 2]
    explained = (a**2 * rest[1, 1] - 2.0 * a * b * rest[0, 1] + b**2 * rest[0, 0]) / det
    pretended = SURFACE_TILT_STD**2 * (information[0, 0] + information[1, 1])
    ahead = jnp.maximum(information[0, 0] - explained - pretended, 0.0)
    ahead = ahead / (1.0 + ahead * wheels.variance[0])
    distance = wheels.increment[0] / history.wheel_scale
    instrument = jnp.sign(distance) * jnp.abs(history.increment[0])
    gained = jnp.where(use, ahead * instrument * distance, 0.0)
    off = ahead * instrument * (increment[0] - wheels.increment[0])
    total = history.scale_information + gained
    return history._replace(
        wheel_scale=history.wheel_scale + jnp.where(use, off, 0.0) / total, scale_information=total
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
