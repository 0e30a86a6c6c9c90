"""Arguments of the pipeline: taken as lists, NumPy or JAX arrays, and checked before any compiling.

All of this runs on the host, on concrete values; an argument that is refused raises ValueError,
which names it, what was given, and what is expected.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.arguments import as_bool
from jaxslam.core.batching import on_device
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import as_float64, check_array, check_type
from jaxslam.filtering.inputs import check_params
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.lidar import to_scan
from jaxslam.pipeline.config import Config

scans_of_log = jax.jit(to_scan, static_argnums=0)
"""`to_scan` as one program, not one for each of its operations."""

ZERO_ROW = 1e-6  # [m], [rad] what counts as zero in the first row of odometry
POSE_RANGE = 2.0  # [m] increments are shorter than this; poses of a drive are further off
POSE_STEP = 0.25  # consecutive poses differ by less than this fraction of the farthest pose

INCREMENTS = (
    "increments are expected: each row the motion since the scan before, in the frame of the pose "
    "before, the first row zero; make them from poses by jaxslam.core.se2_np.increments(poses)"
)


def as_start(start: Any) -> jax.Array:
    """First pose (3,) [m, m, rad] in JAX's precision; zero where None is given.

    Raises:
        ValueError: It is no pose, or not finite.
    """
    pose = np.zeros(3) if start is None else as_float64("start", start, (3,))
    if not np.isfinite(pose).all():
        raise ValueError(f"start is {pose.tolist()}, which is not finite")
    return on_device(pose)


def as_odometry(odometry: Any, *, name: str = "odometry") -> np.ndarray:
    """Odometry increments (T, 3) [m, m, rad] of some scans, T at least 1.

    Raises:
        ValueError: They have another shape, or are not finite.
    """
    increments = as_float64(name, odometry, ("T", 3))
    if not len(increments):
        raise ValueError(f"{name} has no rows; one for each scan is expected")
    bad = np.flatnonzero(~np.isfinite(increments).all(axis=1))
    if bad.size:
        raise ValueError(f"{name}[{bad[0]}] is {increments[bad[0]].tolist()}, which is not finite")
    return increments


def as_log_odometry(odometry: Any, *, name: str = "odometry") -> np.ndarray:
    """Odometry increments (T, 3) [m, m, rad] of a whole log, zero at the first scan.

    Poses in their place are refused. They are known by a first row that is not zero, or by this:
    they get metres away from zero, and do so in steps that are short beside that.

    Raises:
        ValueError: They have another shape, are not finite, or are poses.
    """
    increments = as_odometry(odometry, name=name)
    if np.abs(increments[0]).max() > ZERO_ROW:
        raise ValueError(f"{name}[0] is {increments[0].tolist()}, not zero: {INCREMENTS}")
    farthest = np.hypot(*increments[:, :2].T).max()
    longest_step = np.hypot(*np.diff(increments[:, :2], axis=0).T).max(initial=0.0)
    if farthest > POSE_RANGE and longest_step < POSE_STEP * farthest:
        raise ValueError(
            f"{name} looks like absolute poses: its rows measure up to {farthest:.1f} m, and "
            f"consecutive ones differ by {longest_step:.2f} m at most; {INCREMENTS}"
        )
    return increments


def as_flags(name: str, flags: Any, num_scans: int) -> np.ndarray:
    """What is said of each scan, (T,) bool; of none where None is given.

    Args:
        name: Name of the argument, for the message.
        flags: Bools, or None.
        num_scans: T.

    Raises:
        ValueError: They are no bools, or not as many as scans.
    """
    if flags is None:
        return np.zeros(num_scans, bool)
    return np.array(as_bool(name, flags, (num_scans,)))


def as_scans(lidar: Lidar, ranges: Any, num_scans: int) -> Scan:
    """Scans [T], NumPy, of raw ranges or of scans.

    Args:
        lidar: The scanner.
        ranges: (T, R) raw ranges [m]; NaN, infinite, not above zero or not below `range_max` is no
            return. Or a `Scan` [T].
        num_scans: T.

    Raises:
        ValueError: They are not T scans of this scanner, or no beam of any of them hit anything.
    """
    is_scan = isinstance(ranges, Scan)
    name = "ranges.ranges" if is_scan else "ranges"
    array = as_float64(name, ranges.ranges if is_scan else ranges, ("T", "R"))
    if array.shape[1] != lidar.num_beams:
        raise ValueError(
            f"{name} has {array.shape[1]} beams, config.frontend.lidar {lidar.num_beams}"
        )
    if len(array) != num_scans:
        raise ValueError(
            f"odometry has {num_scans} rows and {name} {len(array)} scans; "
            "one row for each scan is expected"
        )
    if is_scan:
        check_array("ranges.hit", ranges.hit, array.shape, jnp.bool_)
        scans = Scan._make((array.astype(jnp.zeros(()).dtype), np.asarray(ranges.hit)))
    else:
        scans = jax.tree.map(np.asarray, scans_of_log(lidar, on_device(array)))
    if not scans.hit.any():
        raise ValueError(
            f"{name}: no beam of {num_scans} scans hit anything between 0 and {lidar.range_max} m, "
            "config.frontend.lidar.range_max; are they in metres?"
        )
    return scans


def as_params(params: Any, *, match_scans: bool) -> NoiseParams:
    """Noise parameters as JAX arrays, checked.

    Args:
        params: `NoiseParams` of numbers, lists or arrays.
        match_scans: Whether scans are matched, so that there must be a factor on that noise.

    Raises:
        ValueError: They are something else, out of range, or lack what is needed.
    """
    params = check_params(params)
    if match_scans and params.scan_match_std_scale is None:
        raise ValueError(
            "params.scan_match_std_scale is None, but scans are matched; take "
            "NoiseParams.for_laser_log(match_scans=True), or match_scans=False"
        )
    return params


def check_config(config: Any) -> None:
    """Raise unless the configuration is that of the pipeline, and its stages fit each other.

    Raises:
        ValueError: It is something else, or `Config.check` refuses it.
    """
    check_type("config", config, Config)
    config.check()
