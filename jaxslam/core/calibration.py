"""Systematic errors of a robot: its wheels, where the scanner is on it, and the clocks of both.

Odometry that is off by 5 % is off by 5 % at every step, and no noise says so. A `Calibration` does,
by numbers that are the same throughout a drive. It turns the increments that the wheels report into
increments of the scanner; everything after it works on these:

    reported  --scales-->  --shift in time-->  true motion u of the robot  -->  M^-1 (+) u (+) M

with M the pose of the scanner on the robot. The scales come first, because the wheels roll on an
arc between two scans; the motion between two shifted times, of parts of two arcs, is on none. All
of it is differentiable. The functions take arrays of NumPy (float64, for logs) and of JAX alike,
and return what they are given.

References:
    Borenstein, Feng (1996), Measurement and correction of systematic odometry errors in mobile
    robots. Censi, Franchi, Marchionni, Oriolo (2013), Simultaneous calibration of odometry and
    sensor parameters for mobile robots.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxslam.core import se2, se2_np
from jaxslam.core.types import AnyArray


class Calibration(NamedTuple):
    """Systematic errors of odometry and scanner; each a leaf that gradients can tune.

    Attributes:
        distance_scale: () [-] true distance per reported distance.
        turn_scale: () [-] true rotation per reported rotation.
        turn_per_distance: () [rad / m] true rotation to the left per reported distance, in
            addition; wheels of different size turn a robot that goes straight by its encoders.
        mount: (3,) [m, m, rad] pose of the scanner in the frame where it was taken to be.
        time_offset: () [s] by which the clock of the odometry is ahead: a scan at t was taken
            where the odometry has the robot at t + time_offset.
    """

    distance_scale: AnyArray
    turn_scale: AnyArray
    turn_per_distance: AnyArray
    mount: AnyArray
    time_offset: AnyArray

    @classmethod
    def identity(cls) -> "Calibration":
        """A robot without systematic errors, in NumPy."""
        one, zero = np.ones(()), np.zeros(())
        return cls(one, one, zero, np.zeros(3), zero)

    @classmethod
    def of_wheels(cls, left: Any, right: Any, base: Any, *, wheel_base: float) -> "Calibration":
        """Calibration of two wheels, the rest as in `identity`.

        Args:
            left: () true distance per reported distance of the left wheel.
            right: () likewise, of the right wheel.
            base: () true distance between the wheels per `wheel_base`.
            wheel_base: [m] between the wheels, as the odometry assumes.
        """
        distance = (left + right) / 2
        drift = (right - left) / (base * wheel_base)
        return cls.identity()._replace(
            distance_scale=distance, turn_scale=distance / base, turn_per_distance=drift
        )

    def wheels(self, wheel_base: float) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Scales of the left wheel, of the right one, and of their distance.

        The inverse of `of_wheels`.

        Args:
            wheel_base: [m] between the wheels, as the odometry assumes.
        """
        base = self.distance_scale / self.turn_scale
        difference = self.turn_per_distance * base * wheel_base / 2
        return self.distance_scale - difference, self.distance_scale + difference, base

    def without_base(self, wheel_base: float) -> "Calibration":
        """The calibration that does without `wheel_base` what this one does with it.

        Wheels of different size move the middle between them by s per turn (`scale_increments`).
        The point of their axle at y to the left of it, which a turn that they report does not move
        ahead, has

            y = s / turn_scale,   distance_scale' = distance_scale - y turn_per_distance

        A log does not say how far apart the wheels are: what is found from it is of that point.

        Args:
            wheel_base: [m] between the wheels, as the odometry assumes.
        """
        y = self._motion_per_turn(wheel_base) / self.turn_scale
        xp = self.mount.__array_namespace__()
        return self._replace(
            distance_scale=self.distance_scale - y * self.turn_per_distance,
            mount=self.mount - y * xp.asarray([0.0, 1.0, 0.0], dtype=self.mount.dtype),
        )

    def _motion_per_turn(self, wheel_base: float) -> AnyArray:
        """Motion () [m / rad] ahead of the middle between the wheels, per reported rotation."""
        base = wheel_base**2 * self.distance_scale / self.turn_scale / 4
        return self.turn_per_distance * base


def calibrate_odometry(
    calibration: Calibration,
    odometry: Any,
    *,
    times: Any = None,
    mount: Any = None,
    wheel_base: float = 0.0,
) -> Any:
    """Increments of the scanner from those of odometry, with systematic errors removed.

    Args:
        calibration: The robot's.
        odometry: (T, 3) [m, m, rad] increments since the scan before, zero at the first, of the
            scanner at `mount` on a robot without systematic errors.
        times: (T,) [s] of the scans, not decreasing; None: `time_offset` is not used.
        mount: (3,) [m, m, rad] where the scanner was taken to be on the robot; the origin between
            the wheels by default.
        wheel_base: [m] between the wheels, as the odometry assumes; with wheels of different size
            a robot that turns on the spot also moves, by a part that grows with its square. 0
            leaves that out.

    Returns:
        (T, 3) increments of the scanner at `mount` (+) `calibration.mount`, zero at the first.
    """
    xp = odometry.__array_namespace__()
    taken = xp.zeros(3, dtype=odometry.dtype) if mount is None else xp.asarray(mount)
    of_robot = _change_frame(odometry, _inverse(taken))
    of_robot = scale_increments(calibration, of_robot, wheel_base=wheel_base)
    if times is not None:
        of_robot = _shift(of_robot, times, calibration.time_offset)
    true = _compose(taken, xp.asarray(calibration.mount, dtype=odometry.dtype))
    moved = _change_frame(of_robot, true)
    return xp.where(xp.arange(len(moved))[:, None] > 0, moved, xp.zeros_like(moved))


def scale_increments(calibration: Calibration, odometry: Any, *, wheel_base: float = 0.0) -> Any:
    """Increments (..., 3) of the robot, of which the wheels report `odometry` (..., 3).

    With d the length of an increment's arc, and t its turn,

        d' = distance_scale d + s t         t' = turn_scale t + turn_per_distance d

    where s, the motion of the middle per turn, follows from wheels of different size, and the part
    that goes sideways is scaled as the distance.
    """
    xp = odometry.__array_namespace__()
    turn = odometry[..., 2]
    chord = along_arc(odometry)
    per_turn = calibration._motion_per_turn(wheel_base)
    along = calibration.distance_scale * chord[..., 0] + per_turn * turn
    turned = calibration.turn_scale * turn + calibration.turn_per_distance * chord[..., 0]
    sideways = calibration.distance_scale * chord[..., 1]
    straight = xp.stack([along, sideways], axis=-1) * xp.sinc(turned / (2 * np.pi))[..., None]
    moved = _rotate(straight, turned / 2)
    return xp.concat([moved, turned[..., None]], axis=-1)


def along_arc(increments: Any) -> Any:
    """Motion (..., 2) [m] ahead and to the left along the arcs of increments (..., 3).

    An arc is longer than its chord by (turn / 2) / sin(turn / 2), and leads along turn / 2.
    """
    turn = increments[..., 2]
    chord = _rotate(increments[..., :2], -turn / 2)
    return chord / increments.__array_namespace__().sinc(turn / (2 * np.pi))[..., None]


def _shift(odometry: Any, times: Any, offset: Any) -> Any:
    """Increments (T, 3) between the times `times` + `offset`, on arcs between two scans.

    Before the first scan, and after the last one, the robot stands still.
    """
    xp = odometry.__array_namespace__()
    if len(odometry) < 2:
        return odometry
    wanted = xp.clip(times + offset, times[0], times[-1])
    after = xp.clip(xp.searchsorted(times, wanted, side="right"), 1, len(times) - 1)
    begin, end = times[after - 1], times[after]
    apart = end > begin
    fraction = xp.where(apart, (wanted - begin) / xp.where(apart, end - begin, 1.0), 0.0)
    poses = reckon(odometry)
    inside = _part(odometry[after], fraction.astype(odometry.dtype))
    shifted = _compose(poses[after - 1], inside)
    moved = _relative(shifted[:-1], shifted[1:])
    return xp.concat([xp.zeros((1, 3), dtype=odometry.dtype), moved])


def reckon(increments: Any) -> Any:
    """`se2.dead_reckoning` (T, 3) from the origin in either namespace; in NumPy by sums, for speed.

    Args:
        increments: (T, 3) [m, m, rad].
    """
    xp = increments.__array_namespace__()
    if xp is not np:  # sums of T numbers take long to compile
        return se2.dead_reckoning(xp.zeros_like(increments[0]), increments)
    heading = xp.cumsum(increments[:, 2])
    moved = _rotate(increments[:, :2], heading - increments[:, 2])
    return xp.concat([xp.cumsum(moved, axis=0), heading[:, None]], axis=1)


def _part(increments: Any, fraction: Any) -> Any:
    """The first part of increments (..., 3), each an arc, by fractions (...)."""
    xp = increments.__array_namespace__()
    turn = increments[..., 2]
    along = fraction * xp.sinc(fraction * turn / (2 * np.pi)) / xp.sinc(turn / (2 * np.pi))
    moved = _rotate(increments[..., :2], (fraction - 1) * turn / 2) * along[..., None]
    return xp.concat([moved, (fraction * turn)[..., None]], axis=-1)


def _change_frame(increments: Any, frame: Any) -> Any:
    """Increments (..., 3) of a frame (3,) that is fixed to what moves by `increments`."""
    return _compose(_inverse(frame), _compose(increments, frame))


def _inverse(pose: Any) -> Any:
    """Pose (3,) of the outer frame in the inner one."""
    xp = pose.__array_namespace__()
    return _relative(pose, xp.zeros_like(pose))


def _compose(pose: Any, increment: Any) -> Any:
    """`se2.compose` of (..., 3) in either namespace."""
    xp = pose.__array_namespace__()
    moved = _rotate(increment[..., :2], pose[..., 2])
    x, y = pose[..., 0] + moved[..., 0], pose[..., 1] + moved[..., 1]
    wrap = se2_np.wrap_angle if xp is np else se2.wrap_angle
    return xp.stack([x, y, wrap(pose[..., 2] + increment[..., 2])], axis=-1)


def _relative(a: Any, b: Any) -> Any:
    """`se2.relative` of (..., 3) in either namespace."""
    xp = a.__array_namespace__()
    gap = _rotate(b[..., :2] - a[..., :2], -a[..., 2])
    wrap = se2_np.wrap_angle if xp is np else se2.wrap_angle
    return xp.concat([gap, wrap(b[..., 2:] - a[..., 2:])], axis=-1)


def _rotate(xy: Any, angle: Any) -> Any:
    """Vectors (..., 2) turned by angles (...)."""
    xp = xy.__array_namespace__()
    cos, sin = xp.cos(angle), xp.sin(angle)
    x, y = xy[..., 0], xy[..., 1]
    return xp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
