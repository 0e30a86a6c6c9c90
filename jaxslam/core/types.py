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
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import jax

    Array = jax.Array
    """Any array; its shape, unit and frame are in the docstring of what uses it."""

    AnyArray = jax.Array | np.ndarray
    """An array of JAX or of NumPy, where both are taken as they are."""

    Key = jax.Array
    """A key made by `jax.random.key`."""

Metrics = dict[str, Any]
"""Content of `metrics.json`, or a part of it."""

JUNCTION, CORNER, WALL = 0, 1, 2
"""Kinds of landmarks: junction of the Voronoi diagram, corner of two walls, wall direction."""

FAR_JUNCTION = 3
"""Kind of a feature that is no landmark: a junction that a coarser grid of the scan holds."""


def __getattr__(name: str) -> Any:
    """An alias of JAX's arrays; JAX is imported when one is first used, because that is slow."""
    if name not in ("Array", "AnyArray", "Key"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import jax

    globals().update(Array=jax.Array, AnyArray=jax.Array | np.ndarray, Key=jax.Array)
    return globals()[name]


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
        kind: Its dtype or a family of dtypes such as `np.floating`; None for any.

    Raises:
        ValueError: Shape or dtype differ; the message states both.
    """
    sizes, dtype = np.shape(x), x.dtype if hasattr(x, "dtype") else np.asarray(x).dtype
    wanted_sizes = shape[1:] if shape[:1] == (...,) else shape
    num_leading = 0 if wanted_sizes is shape else max(0, len(sizes) - len(wanted_sizes))
    trailing = sizes[num_leading:]
    fits = len(trailing) == len(wanted_sizes) and all(
        isinstance(wanted, str) or size == wanted
        for size, wanted in zip(trailing, wanted_sizes, strict=True)
    )
    if not fits or not (kind is None or _is_kind(dtype, kind)):
        listed = ", ".join("..." if n is ... else str(n) for n in shape)
        listed += "," if len(shape) == 1 else ""
        prefix = "" if kind is None else kind.__name__.rstrip("_") + " "
        raise ValueError(f"{name} is {dtype} {sizes}, not {prefix}({listed})")


def as_float64(name: str, x: Any, shape: tuple[Any, ...]) -> np.ndarray:
    """A NumPy array in float64 made of an array or a list of numbers, checked.

    Args:
        name: Name of `x`, for the message.
        x: Numbers.
        shape: As of `check_array`.

    Raises:
        ValueError: It holds no numbers or has another shape; the message states both.
    """
    x = as_numpy(name, x)
    check_numbers(name, x)
    x = x.astype(np.float64, copy=False)
    check_array(name, x, shape)
    return x


def as_size(
    name: str,
    x: Any,
    *,
    least: float = 0.0,
    most: float = np.inf,
    positive: bool = False,
    unit: str = "metres",
) -> float:
    """A finite float made of one number of any kind, checked.

    Args:
        name: Name of `x`, for the message.
        x: The number, of Python or an array without axes; bools are refused.
        least: The least that is accepted.
        most: The most that is accepted.
        positive: Whether `least` itself is refused.
        unit: What it counts, for the message.

    Raises:
        ValueError: It is no number, not finite or out of range; the message states both.
    """
    size = float(as_float64(name, x, ()))
    if not least <= size <= most or np.isinf(size) or (positive and size == least):
        number = f"a {'positive ' if positive else ''}number of {unit}"
        limits = "" if positive else f" >= {least:g}"
        limits = limits if np.isinf(most) else f" between {least:g} and {most:g}"
        raise ValueError(f"{name} is {size}, not {number}{limits}")
    return size


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


def as_numpy(name: str, x: Any) -> np.ndarray:
    """A NumPy array made of anything array-like; raise ValueError, naming it, if it is none."""
    try:
        return np.asarray(x)
    except ValueError:
        raise ValueError(f"{name} is not an array: its parts differ in shape") from None


def check_numbers(name: str, x: Any) -> None:
    """Raise ValueError, naming it, unless an array holds floats or integers."""
    if not (_is_kind(x.dtype, np.floating) or _is_kind(x.dtype, np.integer)):
        raise ValueError(f"{name} is {x.dtype} {x.shape}, not numbers")


def _is_kind(dtype: Any, kind: Any) -> bool:
    """Whether a dtype is `kind`, or of that family; NumPy has bfloat16 of JAX in no family."""
    return np.issubdtype(np.float16 if dtype.name == "bfloat16" else dtype.type, kind)
