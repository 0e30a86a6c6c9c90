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

A pose (3,) is x [m], y [m], heading [rad] of the robot frame in odom, map or world. An increment
(3,), or odometry increment, is a pose in the frame of the pose before it.

Grids: cell [i, j] covers a square of the robot frame; i grows with x, j with y.
"""

import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array
"""Any array; its shape, unit and frame are in the docstring of what uses it."""

AnyArray = jax.Array | np.ndarray
"""An array of JAX or of NumPy, where both are taken as they are."""

Key = jax.Array
"""A key made by `jax.random.key`."""

JUNCTION, CORNER, WALL = 0, 1, 2
"""Kinds of landmarks: junction of the Voronoi diagram, corner of two walls, wall direction."""

FAR_JUNCTION = 3
"""Kind of a feature that is no landmark: a junction that a coarser grid of the scan holds."""


def check_type(name: str, x: Any, wanted: type, *, advice: str = "") -> None:
    """Raise ValueError unless an argument is a record of this type.

    Args:
        name: Name of `x`, for the message.
        x: The record.
        wanted: Its type.
        advice: Ends the message.
    """
    if not isinstance(x, wanted):
        raise ValueError(f"{name} is {type(x).__name__}, not {wanted.__name__}{advice}")


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
    sizes, dtype = np.shape(x), x.dtype if hasattr(x, "dtype") else jnp.result_type(x)
    wanted_sizes = shape[1:] if shape[:1] == (...,) else shape
    num_leading = 0 if wanted_sizes is shape else max(0, len(sizes) - len(wanted_sizes))
    trailing = sizes[num_leading:]
    fits = len(trailing) == len(wanted_sizes) and all(
        isinstance(wanted, str) or size == wanted
        for size, wanted in zip(trailing, wanted_sizes, strict=True)
    )
    if not fits or not (kind is None or jnp.issubdtype(dtype, kind)):
        listed = ", ".join("..." if n is ... else str(n) for n in shape)
        listed += "," if len(shape) == 1 else ""
        prefix = "" if kind is None else _dtype_name(kind) + " "
        raise ValueError(f"{name} is {dtype} {sizes}, not {prefix}({listed})")


def as_float(name: str, x: Any, shape: tuple[Any, ...]) -> Array:
    """A JAX array of floats made of a NumPy array, a list or a JAX array of numbers, checked.

    Args:
        name: Name of `x`, for the message.
        x: Numbers; what is not a JAX array of floats becomes one of JAX's default precision.
        shape: As of `check_array`.

    Raises:
        ValueError: It holds no numbers or has another shape; the message states both.
    """
    x = _as_numbers(name, x)
    if not (isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating)):
        x = jnp.asarray(x, float)
    check_array(name, x, shape, jnp.floating)
    return x


def as_float64(name: str, x: Any, shape: tuple[Any, ...]) -> np.ndarray:
    """As `as_float`, but a NumPy array in float64, for what is computed on the host."""
    x = np.asarray(_as_numbers(name, x), np.float64)
    check_array(name, x, shape)
    return x


def as_count(name: str, x: Any, *, least: int = 1) -> int:
    """A whole number of Python, of one of Python or NumPy; raise ValueError if it is below `least`.

    Args:
        name: Name of `x`, for the message.
        x: The number; bools, and floats without a fraction, are refused.
        least: The least that is accepted.
    """
    wanted = f"{name} is {x!r}, not a whole number of at least {least}"
    try:
        number = operator.index(x)
    except TypeError:
        raise ValueError(wanted) from None
    if isinstance(x, bool) or number < least:
        raise ValueError(wanted)
    return number


def as_bool(name: str, x: Any, shape: tuple[Any, ...]) -> Array:
    """A JAX array of bools made of a NumPy array, a list or a JAX array of bools, checked.

    Args:
        name: Name of `x`, for the message.
        x: Bools; numbers are refused.
        shape: As of `check_array`.

    Raises:
        ValueError: It holds no bools or has another shape; the message states both.
    """
    x = as_array(name, x)
    check_array(name, x, shape, jnp.bool_)
    return jnp.asarray(x)


def as_array(name: str, x: Any) -> AnyArray:
    """An array made of anything array-like; raise ValueError, naming it, if it is none."""
    if isinstance(x, jax.Array):
        return x
    try:
        return np.asarray(x)
    except ValueError:
        raise ValueError(f"{name} is not an array: its parts differ in shape") from None


def _as_numbers(name: str, x: Any) -> AnyArray:
    """An array of floats or integers; raise ValueError if it is none."""
    x = as_array(name, x)
    if not (jnp.issubdtype(x.dtype, jnp.floating) or jnp.issubdtype(x.dtype, jnp.integer)):
        raise ValueError(f"{name} is {x.dtype} {x.shape}, not numbers")
    return x


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
