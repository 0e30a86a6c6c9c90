"""Closed form of wheels and mount from increments, written to be read beside the paper.

Censi, Franchi, Marchionni, Oriolo (2013), Simultaneous calibration of odometry and sensor
parameters for mobile robots, section V; equations without weights.
"""

import numpy as np


def censi(wheels, scanner):
    """Radii of the wheels, their distance, and the pose of the scanner on the robot.

    Args:
        wheels: (T, 2) what the left and the right wheel turn by in each interval.
        scanner: (T, 3) motion of the scanner in each interval, in its frame before it.

    Returns:
        (6,) radius left, radius right (true distance per unit of `wheels`), distance between the
        wheels, and x, y and yaw of the scanner.
    """
    # Step 1: the rotation is linear in J21 = -r_left / b and J22 = r_right / b.
    normal, right_side = np.zeros((2, 2)), np.zeros(2)
    for both, motion in zip(wheels, scanner, strict=True):
        normal += np.outer(both, both)
        right_side += both * motion[2]
    j21, j22 = np.linalg.solve(normal, right_side)

    # Step 2: with r the motion of the robot, r = b (c_x, c_y), and l the scanner's position,
    #     R(yaw) s = r + (R(turn) - 1) l,
    # which is linear in (b, l_x, l_y, cos yaw, sin yaw).
    quadratic = np.zeros((5, 5))
    for (left, right), (s_x, s_y, _) in zip(wheels, scanner, strict=True):
        turn = j21 * left + j22 * right
        half = (-j21 * left + j22 * right) / 2
        near_zero = abs(turn) < 1e-8
        c_x = half * (1.0 if near_zero else np.sin(turn) / turn)
        c_y = half * (turn / 2 if near_zero else (1 - np.cos(turn)) / turn)
        cos, sin = np.cos(turn) - 1, np.sin(turn)
        rows = np.array([[c_x, cos, -sin, -s_x, s_y], [c_y, sin, cos, -s_y, -s_x]])
        quadratic += rows.T @ rows

    # Least x^T M x where x4^2 + x5^2 = 1: (M + lambda W) x = 0 with W = diag(0, 0, 0, 1, 1), and
    # det(M + lambda W) = 0 is a polynomial of second degree, by minors of M.
    def minor(*without):
        kept = [i for i in range(5) if i not in without]
        return np.linalg.det(quadratic[np.ix_(kept, kept)])

    weights = np.diag([0.0, 0.0, 0.0, 1.0, 1.0])
    candidates = []
    for root in np.roots([minor(3, 4), minor(3) + minor(4), minor()]):
        _, _, vectors = np.linalg.svd(quadratic + root.real * weights)
        x = vectors[-1] / np.hypot(*vectors[-1][3:])
        x *= np.copysign(1.0, x[0])  # the distance between the wheels is above 0
        candidates.append((x @ quadratic @ x, x))
    base, x, y, cos, sin = min(candidates, key=lambda one: one[0])[1]
    return np.array([-base * j21, base * j22, base, x, y, np.arctan2(sin, cos)])
