"""What the entry points of this package refuse, before anything is compiled."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.arguments import as_array, as_bool, as_float
from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.types import Array, check_array
from jaxslam.matching.icp import ScanMatchSpec, Submap


def check_static(name: str, value: Any, record: type) -> None:
    """Check that a static argument is a record of options and hashable, as `jax.jit` wants it.

    Args:
        name: Name of the argument, for the message.
        value: The argument.
        record: Type that it has to be of.

    Raises:
        ValueError: It is something else, or holds for instance a list in place of a tuple.
    """
    if not isinstance(value, record):
        raise ValueError(f"{name} is a {type(value).__name__}, not a {record.__name__}")
    try:
        hash(value)
    except TypeError as error:
        raise ValueError(f"{name} must hold tuples in place of lists: {error}") from None


def check_at_least(name: str, value: float, least: float) -> None:
    """Check an option.

    Raises:
        ValueError: It is less than `least`, or NaN; the message names it.
    """
    if not value >= least:
        raise ValueError(f"{name} is {value}, not {least:g} or more")


def check_positive(name: str, value: float) -> None:
    """Check an option.

    Raises:
        ValueError: It is not a finite number above zero; the message names it.
    """
    if not 0.0 < value < np.inf:
        raise ValueError(f"{name} is {value}, not a finite number above 0")


def check_scan_match_spec(spec: ScanMatchSpec, name: str = "spec") -> None:
    """Check the options of scan matching.

    Args:
        spec: The options.
        name: Name of the argument that they came in, for the message.

    Raises:
        ValueError: One is out of range, or there is no gate.
    """
    check_static(name, spec, ScanMatchSpec)
    for field in ("window_scans", "max_beams", "track_scans", "coarse_stride"):
        check_at_least(f"{name}.{field}", getattr(spec, field), 1)
    for field in ("beam_window", "inner_iterations"):
        check_at_least(f"{name}.{field}", getattr(spec, field), 0)
    for field in ("track_gates", "coarse_gates", "fine_gates"):
        if len(getattr(spec, field)) == 0:
            raise ValueError(f"{name}.{field} is empty; it takes one number or more")
    check_positive(f"{name}.point_std", spec.point_std)
    if len(spec.track_kernels) != len(spec.track_gates):
        raise ValueError(
            f"{name}.track_kernels has {len(spec.track_kernels)} numbers and {name}.track_gates "
            f"{len(spec.track_gates)}; one for each is expected"
        )
    for scale in spec.track_kernels:
        check_positive(f"{name}.track_kernels", scale)
    for scale in spec.kernel_scales:
        check_positive(f"{name}.kernel_scales", scale)


def as_scans(name: str, lidar: Lidar, scans: Scan, leading: tuple[Any, ...] = ()) -> Scan:
    """A scan, or scans, in JAX arrays of the default precision, checked.

    Args:
        name: Name of the argument, for the message.
        lidar: The scanner, which states the number of beams R.
        scans: Ranges [m] and hits, (..., R) each: JAX, NumPy or lists.
        leading: Sizes before R, as of `check_array`; none for a single scan.

    Raises:
        ValueError: It is no `Scan`, or ranges or hits are of another shape or kind.
    """
    if not isinstance(scans, Scan):
        raise ValueError(
            f"{name} is a {type(scans).__name__}, not a Scan; `to_scan` makes one of ranges"
        )
    ranges = as_default_float(f"{name}.ranges", scans.ranges, (*leading, lidar.num_beams))
    return Scan(ranges, as_bool(f"{name}.hit", scans.hit, ranges.shape))


def as_default_float(name: str, x: Any, shape: tuple[Any, ...]) -> Array:
    """`as_float`, in JAX's default precision whatever was given."""
    return jnp.asarray(as_float(name, x, shape), float)


def as_submap(spec: ScanMatchSpec, lidar: Lidar, submap: Submap) -> Submap:
    """A submap in JAX arrays, checked to be one of these options and of this scanner.

    Raises:
        ValueError: It holds another number of keyframes or of beams.
    """
    check_lidar(lidar)
    if not isinstance(submap, Submap):
        raise ValueError(f"submap is a {type(submap).__name__}, not a Submap")
    size = spec.window_scans, lidar.num_beams
    check_array("submap.poses", submap.poses, (spec.window_scans, 3), jnp.floating)
    check_array("submap.oriented_points.valid", submap.oriented_points.valid, size, jnp.bool_)
    check_array("submap.last_pose", submap.last_pose, (3,), jnp.floating)
    return jax.tree.map(jnp.asarray, submap)


def as_count(name: str, count: Any, most: int) -> Array:
    """A number of items, () int32, checked.

    Raises:
        ValueError: It is not a whole number from 0 to `most`.
    """
    number = as_array(name, count)
    if number.shape or not jnp.issubdtype(number.dtype, jnp.integer):
        raise ValueError(f"{name} is {count}, not a whole number")
    if not isinstance(number, jax.core.Tracer) and not 0 <= int(number) <= most:
        raise ValueError(f"{name} is {count}, not 0 to {most}")
    return jnp.asarray(number, jnp.int32)
