"""Wheels and mount in closed form: the peer of `experiments.calibration`.

It takes increments of the wheels and of the scanner, as scan matching gives them. It knows neither
noise nor clocks, so it is what a calibration by gradient is compared with, and where one may start.

References:
    Censi, Franchi, Marchionni, Oriolo (2013), Simultaneous calibration of odometry and sensor
    parameters for mobile robots, section V.
"""

import jax
import numpy as np

from jaxslam.core.calibration import Calibration
from jaxslam.simulation.robot import wheel_distances


def closed_form(odometry: np.ndarray, scanner: np.ndarray, *, wheel_base: float) -> Calibration:
    """Wheels and mount of a robot by two linear least squares.

        t = J21 l + J22 r,    R(yaw) s = b (c_x, c_y) + (R(t) - 1) (x, y)

    with l, r what the wheels report, t the turn and s the motion of the scanner, and c that of the
    robot for wheels 1 m apart. The second has cos yaw and sin yaw as unknowns on a circle: the
    others are eliminated, and what remains is an eigenvector of a matrix (2, 2).

    Args:
        odometry: (N, 3) [m, m, rad] increments that the wheels report, on arcs.
        scanner: (N, 3) [m, m, rad] increments of the scanner in the same intervals.
        wheel_base: [m] between the wheels, as the odometry assumes.

    Returns:
        The calibration, its time offset 0.
    """
    both = jax.vmap(lambda motion: wheel_distances(motion, wheel_base))(odometry)
    wheels = np.stack([np.asarray(x, np.float64) for x in both], axis=1)
    scanner = np.asarray(scanner, np.float64)
    j = np.linalg.lstsq(wheels, scanner[:, 2])[0]
    turn, along = wheels @ j, wheels @ (j * [-0.5, 0.5])
    cx, cy = along * np.sinc(turn / np.pi), along * np.sinc(turn / 2 / np.pi) * np.sin(turn / 2)
    cos, sin = np.cos(turn) - 1, np.sin(turn)
    others = np.concatenate([np.stack(x, axis=1) for x in ((cx, cos, -sin), (cy, sin, cos))])
    x, y = scanner[:, 0], scanner[:, 1]
    yaw = np.concatenate([np.stack(pair, axis=1) for pair in ((x, -y), (y, x))])
    solved = np.linalg.lstsq(others, yaw)[0]  # (3, 2): base, x, y by cos and sin
    residual = yaw - others @ solved
    unit = np.linalg.eigh(residual.T @ residual)[1][:, 0]
    base, *position = solved @ unit
    sign = np.copysign(1.0, base)
    base, unit, position = base * sign, unit * sign, np.array(position) * sign
    own = Calibration.of_wheels(-base * j[0], base * j[1], base / wheel_base, wheel_base=wheel_base)
    return own._replace(mount=np.array([*position, np.arctan2(unit[1], unit[0])]))
