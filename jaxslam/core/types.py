"""Array aliases, shape checks, and the glossary of letters, units and frames used everywhere.

Letters (sizes of axes):
    S walls of the world, R beams of a scan, H x W cells of a grid, K straight segments of a scan,
    M features of a scan, L landmarks of the map, A arcs of the topological map, D = 3 + 2 L
    dimension of the filter's state, T time steps of a log, B trials of a Monte-Carlo experiment.

Units: metres, radians and seconds; angles are counter-clockwise.

Frames, as in ROS REP 105:
    base_link, here the *robot frame*: x forward, y to the left, origin at the lidar.
    odom: dead reckoning by odometry alone; continuous, but it drifts.
    map: the estimate of the filter or of the smoother; corrected, so it may jump.
    world: the ground truth, of a simulation or of a reference log.

A pose (3,) is x [m], y [m], heading [rad] of the robot frame in odom, map or world. A motion, or
odometry increment, (3,) is a pose in the frame of the pose before it.

Grids: cell [i, j] covers a square of the robot frame; i grows with x, j with y.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array
"""Any array; its shape, unit and frame are in the docstring of what uses it."""

Key = jax.Array
"""A key made by `jax.random.key`."""

JUNCTION, CORNER, WALL = 0, 1, 2
"""Kinds of landmarks: junction of the Voronoi diagram, corner of two walls, wall direction."""


def check_array(name: str, x: Any, shape: tuple[Any, ...], kind: Any = None) -> None:
    """Check shape and dtype of an array; while tracing, so it costs nothing at run time.

    Args:
        name: Name of `x`, for the message.
        x: The array.
        shape: Its sizes; a string stands for any size, a leading `...` for any leading sizes.
        kind: Its dtype or a family of dtypes such as `jnp.floating`; None for any.

    Raises:
        ValueError: Shape or dtype differ; the message states both.
    """
    sizes, dtype = np.shape(x), jnp.result_type(x)
    wanted_sizes = shape[1:] if shape[:1] == (...,) else shape
    trailing = sizes if wanted_sizes is shape else sizes[-len(wanted_sizes) :]
    fits = len(trailing) == len(wanted_sizes) and all(
        isinstance(wanted, str) or size == wanted
        for size, wanted in zip(trailing, wanted_sizes, strict=True)
    )
    if not fits or not (kind is None or jnp.issubdtype(dtype, kind)):
        listed = ", ".join("..." if n is ... else str(n) for n in shape)
        listed += "," if len(shape) == 1 else ""
        prefix = "" if kind is None else _dtype_name(kind) + " "
        raise ValueError(f"{name} is {dtype} {sizes}, not {prefix}({listed})")


def _dtype_name(kind: Any) -> str:
    """Name of a dtype or of a family of dtypes."""
    return str(np.dtype(kind)) if kind is jnp.bool_ else kind.__name__


def check_covariance(name: str, cov: Array, *, definite: bool = True) -> None:
    """Check that covariance matrices are finite, symmetric and positive definite.

    Nothing is checked while tracing, when there are no values.

    Args:
        name: Name of `cov`, for the message.
        cov: (..., n, n) the matrices.
        definite: False also accepts semi-definite ones: something known for certain.

    Raises:
        ValueError: One is not; the message states which, and why.
    """
    if isinstance(cov, jax.core.Tracer):
        return
    matrices = np.asarray(cov, float)
    for index in np.ndindex(matrices.shape[:-2]):
        matrix, label = matrices[index], name + (str(list(index)) if index else "")
        if not np.isfinite(matrix).all():
            raise ValueError(f"{label} holds numbers that are not finite")
        scale = np.abs(matrix).max()
        asymmetry = np.abs(matrix - matrix.T)
        if asymmetry.max() > 1e-5 * scale:
            i, j = np.unravel_index(np.argmax(asymmetry), matrix.shape)
            upper, lower = matrix[i, j], matrix[j, i]
            raise ValueError(
                f"{label} is not symmetric: [{i}, {j}] is {upper:g}, [{j}, {i}] {lower:g}"
            )
        smallest = np.linalg.eigvalsh((matrix + matrix.T) / 2)[0]
        if not (smallest > 0.0 if definite else smallest >= -1e-6 * scale):
            wanted = "positive definite" if definite else "positive semi-definite"
            raise ValueError(f"{label} is not {wanted}: its smallest eigenvalue is {smallest:g}")
