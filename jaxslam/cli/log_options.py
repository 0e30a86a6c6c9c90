"""Options of the commands on logs: the scanner, the frames, the noise; and checks of logs."""

from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from jaxslam.cli.options import OptionalFrame
from jaxslam.core.logs import LaserLog
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import noise_file, readers
from jaxslam.io.errors import InputError

MIN_BEAMS = 32  # of a scan, from which the front end works


class ScannerOptions(NamedTuple):
    """What the user says of the scanner and the frames of a log.

    Attributes:
        mount: Pose of the scanner on the robot [m m rad]; replaces the log's transforms.
        upside_down: The scanner is mounted upside down.
        scan_frame: Frame of the scans to read; by default the one with most scans.
        base_frame: Frame of the robot; by default that of the odometry.
        odom_frame: Frame of the odometry among the transforms of a bag; by default odom.
        angle_increment: Step between beams [deg]; by default that of the scans.
    """

    mount: Annotated[
        tuple[float, float, float] | None,
        tyro.conf.arg(metavar="X Y YAW", help_behavior_hint=""),
    ] = None
    upside_down: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    scan_frame: OptionalFrame = None
    base_frame: OptionalFrame = None
    odom_frame: OptionalFrame = None
    angle_increment: Annotated[
        float | None, tyro.conf.arg(metavar="DEG", help_behavior_hint="")
    ] = None

    def read_log(
        self, path: Path, *, scan_topic: str | None = None, odometry_topic: str | None = None
    ) -> LaserLog:
        """Read a log with these options; topics are those of a bag."""
        step = self.angle_increment
        return readers.read_log(
            path,
            scan_topic=scan_topic,
            odometry_topic=odometry_topic,
            mount=self.mount,
            upside_down=self.upside_down,
            scan_frame=self.scan_frame,
            base_frame=self.base_frame,
            odom_frame=self.odom_frame,
            angle_increment=None if step is None else float(np.radians(step)),
        )


Scanner = Annotated[ScannerOptions, tyro.conf.arg(name="")]
"""Options of the scanner, each under its own name."""


def require_odometry(path: Path, log: LaserLog) -> None:
    """Raise InputError if a log has no odometry, for what runs by odometry alone."""
    if not log.has_odometry:
        reason = next((note for note in log.notes if note.startswith("no odometry")), "no odometry")
        raise InputError(reason, path=path, advice="use --odometry scans-only")


def require_beams(path: Path, log: LaserLog) -> None:
    """Raise InputError if the scans of a log have too few beams to find walls in them."""
    if log.lidar.num_beams < MIN_BEAMS:
        problem = f"has {log.lidar.num_beams} beams a scan, of which {MIN_BEAMS} are needed"
        raise InputError(problem, path=path, advice="name a log of a laser scanner")


def read_params(path: Path | None, default: NoiseParams) -> NoiseParams:
    """Noise parameters (Q and R) of a file; the default if there is no path."""
    return default if path is None else jax.tree.map(jnp.asarray, noise_file.read(path, default))
