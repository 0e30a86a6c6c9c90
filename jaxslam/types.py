"""Array aliases, and the letters, units and frames used everywhere.

Letters: S walls, R beams, H x W cells, K runs, M features of a scan, L landmarks, A arcs,
D = 3 + 2 L state, T steps, B runs of the robot.

Units: metres and radians. Frames: *world* (or *map*: the world as the robot estimates it) and
*robot* (x ahead, y to the left, heading counter-clockwise from x). A pose (3,) is x, y, heading
in the world; a motion (3,) is a pose in the frame of the pose before it.

Grids: cell [i, j] covers a square of the robot frame; i grows with x (ahead), j with y (left).
"""

import jax

Array = jax.Array
"""Any array; its shape, unit and frame stand in the docstring of what uses it."""

Key = jax.Array
"""A key made by `jax.random.key`."""

NODE, CORNER, WALL = 0, 1, 2
"""The kinds of landmark: junction of the Voronoi diagram, corner of two walls, wall direction."""
