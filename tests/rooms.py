"""Rooms whose junctions are known, and where the robot stands in them."""

import numpy as np

from jaxslam.simulation import worlds

LEG = 3 * np.sqrt(3)  # [m] height of a triangle with sides of 6 m
TRIANGLE = worlds.polyline([(0, 0), (LEG, -3), (LEG, 3), (0, 0)])
CENTRE, RADIUS = np.array([2 * LEG / 3, 0.0]), LEG / 3
IN_TRIANGLE = np.array([1.5, 0.3, 0.05])
