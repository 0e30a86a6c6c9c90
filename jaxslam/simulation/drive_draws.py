"""All that is random on a drive, drawn: the arguments of `drives.drive_and_scan`."""

from typing import Any, NamedTuple

import jax

from jaxslam.core.types import Array, Key
from jaxslam.simulation import kinematics, wheel_faults
from jaxslam.simulation.life import Events, Life, draw_events
from jaxslam.simulation.robot import Robot

SUBSTEPS = 4  # parts of the motion between two scans with encoder noise of their own
LIFE = 1  # number of the key of what goes wrong, of that of a drive


class LifeDraws(NamedTuple):
    """What goes wrong on a drive of T scans, drawn.

    Attributes:
        events: What happens on this drive.
        failures: (T, 3) uniform draws of the odometry's failures.
        kept: (T,) bool, which scans are not lost.
    """

    events: Events
    failures: Array
    kept: Array


class Draws(NamedTuple):
    """All that is random on a drive of T scans, drawn.

    Attributes:
        wheels: (T - 1, SUBSTEPS, D) standard normals of the encoders.
        scans: (T,) keys of the scans.
        ranges: (T, R) standard normals of the ranges; None: those of the keys.
        life: What goes wrong; None: nothing.
    """

    wheels: Array
    scans: Key
    ranges: Array | None = None
    life: LifeDraws | None = None


def draw_drive(key: Key, robot: Robot, life: Life | None, num_scans: int, dtype: Any) -> Draws:
    """Draw a drive of T scans."""
    drive_key, scan_key = jax.random.split(key)
    shape = num_scans - 1, SUBSTEPS, kinematics.num_draws(robot)
    draws = Draws(
        wheels=jax.random.normal(drive_key, shape, dtype),
        scans=jax.random.split(scan_key, num_scans),
    )
    if life is None:
        return draws
    of_events, of_odometry, of_scans = jax.random.split(jax.random.fold_in(key, LIFE), 3)
    drawn = LifeDraws(
        events=draw_events(of_events, life, num_scans),
        failures=wheel_faults.draw_failures(of_odometry, num_scans, dtype),
        kept=wheel_faults.keeps_scan(of_scans, life.wheels, num_scans, dtype),
    )
    return draws._replace(life=drawn)
