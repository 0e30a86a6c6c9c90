"""The command `jaxslam localise LOG --map DIR`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from tqdm import tqdm

from jaxslam.cli import report, summaries
from jaxslam.cli.log_options import Scanner, ScannerOptions, require_beams, require_odometry
from jaxslam.cli.options import (
    OptionalFile,
    OptionalTopic,
    OutFolder,
    name_errors,
    require_other_folder,
)
from jaxslam.cli.stopwatch import stopwatch
from jaxslam.core.caches import enable_caches
from jaxslam.core.logs import LaserLog
from jaxslam.core.scan import Lidar
from jaxslam.core.types import Metrics
from jaxslam.evaluation import log_errors
from jaxslam.evaluation.log_errors import Trajectory
from jaxslam.io import map_file, tum
from jaxslam.io.errors import InputError
from jaxslam.io.output import folder
from jaxslam.localisation import localise
from jaxslam.localisation.config import LocaliseInfo, PlaceMap
from jaxslam.pipeline import localise_log, log_input
from jaxslam.pipeline.localise_log import LogLocalisation
from jaxslam.pipeline.log_input import OdometrySource

SURE = 0.9
"""Probability of a pose from which on the robot counts as found."""

LIKELY = 0.5
"""Probability from which on a pose is in trajectory.tum."""


def localise_in_map(
    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")],
    map: Annotated[Path, tyro.conf.arg(metavar="DIR")],  # noqa: A002
    at: Annotated[
        tuple[float, float, float] | None,
        tyro.conf.arg(metavar="X Y YAW", help_behavior_hint=""),
    ] = None,
    reference: OptionalFile = None,
    odometry: OdometrySource = "scan",
    scan_topic: OptionalTopic = None,
    odometry_topic: OptionalTopic = None,
    scanner: Scanner = ScannerOptions(),  # noqa: B008
    out: OutFolder = Path("localised"),
) -> int:
    """Find a robot in a saved map, and track it there.

    The robot may be anywhere at the start; it is found again when it is lost or was carried. The
    map is not changed. Each pose is that by the scans up to it. Writes metrics.json;
    trajectory.tum, the poses that are more likely right than wrong; quality.csv, all poses, each
    with the probability that it is within 0.25 m and 5 degrees of the true one; and localised.png.

    Args:
        log: CARMEN or Player log, ROS bag, g2o pose graph with scans, or NumPy file.
        map: Output folder of `jaxslam run`, or its map.npz.
        at: Pose of the scanner at the start [m m rad], in the map, about; by default anywhere.
        reference: Reference trajectory to evaluate with: a TUM file with the log's clock.
        odometry: Scan matching with wheel odometry (scan), scan matching alone, for logs without
            odometry (scans-only), or wheel odometry alone (wheels).
        scan_topic: Topic of the laser scans in a bag; by default the one with most messages.
        odometry_topic: Topic of the odometry or of the transforms in a bag; by default the one
            with most messages.
        scanner: The scanner and the frames of the log.
        out: Folder for the results, not that of the map.
    """
    require_other_folder(out, map)
    saved_map = map_file.load_map(map)
    laser_log = scanner.read_log(log, scan_topic=scan_topic, odometry_topic=odometry_topic)
    require_beams(log, laser_log)
    if odometry == "wheels":
        require_odometry(log, laser_log)
    known, notes = None, differences(saved_map.lidar, laser_log.lidar)
    if reference is not None:
        known, more = tum.read_reference(reference)
        notes += [f"{reference}: {note}" for note in more]
    with name_errors(str(log)):
        given = log_input.from_laser_log(laser_log, odometry)
    with name_errors(str(reference)):
        log_errors.errors_against(laser_log, given.odom_poses, known, None)
    spec = localise_log.spec_for_log(given)
    with name_errors(str(map)):
        place_map = localise.make_map(spec, saved_map)
    if at is not None:
        _check_pose(at, place_map, spec.place.cell)
    with folder(out) as out_dir:
        enable_caches()
        size = f"{len(laser_log.times)} scans of {laser_log.lidar.num_beams} beams"
        print(f"{log}: {size}{laser_log.source}", flush=True)
        with (
            stopwatch() as seconds,
            tqdm(total=len(laser_log.times), unit="scan", desc="compiling") as bar,
        ):

            def show_progress(infos: LocaliseInfo) -> None:
                bar.set_description("localising", refresh=False)
                bar.set_postfix_str(f"probability {infos.probability[-1]:.2f}", refresh=False)
                bar.update(len(infos.probability))

            found = localise_log.localise_log(spec, place_map, given, at, callback=show_progress)
        numbers = _metrics(laser_log, found, known) | {
            "skipped_lines": laser_log.num_skipped,
            "mended": [*given.notes, *notes, *found.notes],
            "odometry": given.odometry_source,
            "seconds": seconds,
        }
        report.write_localisation(out_dir, numbers, laser_log.times, found.infos, LIKELY)
        report.draw_localisation(out_dir / "localised.png", saved_map, found.infos)
    summaries.print_localisation(numbers, f"{len(laser_log.times)} scans of {log}", out)
    return 0


def differences(of_map: Lidar, of_log: Lidar) -> list[str]:
    """A note where the scanner of the log is another one than that of the map."""

    def text(lidar: Lidar) -> str:
        view = np.degrees(lidar.angle_increment * (lidar.num_beams - 1))
        return f"{lidar.num_beams} beams over {view:.0f} degrees up to {lidar.range_max:g} m"

    if text(of_map) == text(of_log):
        return []
    return [f"scanner of the log: {text(of_log)}; of the map: {text(of_map)}"]


def _check_pose(at: tuple[float, float, float], place_map: PlaceMap, cell: float) -> None:
    """Raise InputError unless a pose is finite and in the map."""
    if not np.isfinite(at).all():
        raise InputError(f"{at} is not finite", field="--at", advice="give x y [m] and yaw [rad]")
    low = np.asarray(place_map.places.origin, np.float64)
    high = low + cell * np.array(place_map.places.distance.shape)
    if (np.array(at[:2]) < low).any() or (np.array(at[:2]) > high).any():
        problem = f"{at[0]:g} {at[1]:g} is outside of the map"
        limits = f"x {low[0]:.1f} to {high[0]:.1f} m, y {low[1]:.1f} to {high[1]:.1f} m"
        raise InputError(problem, field="--at", advice=f"it reaches {limits}")


def _metrics(laser_log: LaserLog, found: LogLocalisation, reference: Trajectory | None) -> Metrics:
    """How much of a log was localised, and the errors of the poses that are sure."""
    steps = np.hypot(*found.increments[:, :2].T)
    sure = found.infos.probability > SURE
    first = int(np.argmax(sure)) if sure.any() else None
    numbers: Metrics = {
        "scans": len(steps),
        "path_length_m": float(steps.sum()),
        "sure": float(sure.mean()),
        "found_after_m": None if first is None else float(steps[: first + 1].sum()),
        "searches": int(found.infos.searched.sum()),
    }
    if reference is None:
        return numbers
    poses = np.asarray(found.infos.pose, np.float64)[sure]
    try:
        errors = log_errors.against_reference(laser_log.times[sure], poses, reference)
    except ValueError:  # too few of them have a pose of the reference
        return numbers
    return numbers | errors
