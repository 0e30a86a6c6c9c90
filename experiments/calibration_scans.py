"""Calibration of the simulated robot from recorded scans: what `run --calibrate` finds of a log.

The robot of `calibration_drives` drives through the office with a scanner of 180 beams whose ranges
are rounded to a centimetre. A log does not say how far apart the wheels are, so the truth is that
without their distance (`Calibration.without_base`).
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import common
from experiments.calibration_drives import HURT
from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import dead_reckoning
from jaxslam.core.types import Array, Key
from jaxslam.pipeline import log_input, self_calibration
from jaxslam.simulation import drives, path_following, ray_casting, worlds
from jaxslam.smoothing.odometry_calibration import NAMES, flat

WORLD = "office"
LIDAR = Lidar(num_beams=180, angle_min=-np.pi / 2, angle_increment=np.pi / 180, range_max=20.0)
DECIMALS = 2  # of the ranges [m] in the log


@partial(jax.jit, static_argnames="num_scans")
def _recorded(key: Key, path: Array, *, num_scans: int) -> tuple[Array, Scan]:
    """Increments (T, 3) that the wheels report, and the scans [T]."""
    own, world = jax.random.split(key), worlds.named(WORLD)
    truth, odometry = drives.drive(own[0], HURT, path, num_scans=num_scans)

    def scan(key: Key, pose: Array) -> Scan:
        return ray_casting.add_range_noise(key, LIDAR, ray_casting.cast(LIDAR, world, pose))

    return odometry, jax.vmap(scan)(jax.random.split(own[1], num_scans), truth)


def log_of(key: Key) -> LaserLog:
    """The log of one drive."""
    path = jnp.asarray(path_following.densify(worlds.waypoints(WORLD)), float)
    count = drives.num_scans_of_drive(HURT, path)
    odometry, scans = jax.tree.map(np.asarray, _recorded(key, path, num_scans=count))
    times, reported = HURT.scan_period * np.arange(count), dead_reckoning(np.zeros(3), odometry)
    ranges = np.where(scans.hit, np.round(scans.ranges, DECIMALS), np.inf)
    return LaserLog.from_arrays(times, reported, ranges, LIDAR)


def recover(seed: int, number: int) -> common.Numbers:
    """Errors (7,) of what is found from a log, and their standard errors."""
    log = log_of(jax.random.fold_in(jax.random.key(seed), number))
    given = log_input.from_laser_log(log)
    found = self_calibration.calibrate_log(log, given, mount=np.zeros(3))
    truth = flat(HURT.calibration().without_base(HURT.wheel_base))
    return {
        "off": flat(found.estimate.calibration) - truth,
        "standard_errors": flat(found.estimate.standard_errors),
        "rounds": found.num_rounds,
        "is_settled": found.is_settled,
    }


def summary(rows: list[Any]) -> common.Numbers:
    """Of all logs: errors in standard errors, and standard errors per spread, by number."""
    off, se = (np.array([row[key] for row in rows]) for key in ("off", "standard_errors"))
    z = off / se
    spread = off.std(axis=0, ddof=1) if len(rows) > 1 else np.full(len(NAMES), np.nan)
    return {
        "logs": len(rows),
        "names": NAMES,
        "within_3_se": int(np.sum(np.all(np.abs(z) < 3.0, axis=1))),
        "worst_z": float(np.abs(z).max()),
        "mean_z": z.mean(axis=0),
        "rms_error": np.sqrt(np.mean(off**2, axis=0)),
        "error_per_spread": se.mean(axis=0) / spread,
        "rows": rows,
    }
