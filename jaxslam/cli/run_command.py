"""The command `jaxslam run LOG`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
import tyro
from tqdm import tqdm

from jaxslam.cli import calibrated_logs, report, room_results, run_results, summaries
from jaxslam.cli.log_options import (
    Scanner,
    ScannerOptions,
    read_params,
    require_beams,
    require_odometry,
)
from jaxslam.cli.options import (
    FileOfEach,
    OptionalCount,
    OptionalFile,
    OptionalTopic,
    OutFolder,
    check_range,
    name_errors,
)
from jaxslam.cli.run_evaluation import RecordedDrive, without_errors
from jaxslam.cli.run_results import RunContext
from jaxslam.cli.stopwatch import stopwatch
from jaxslam.core.caches import enable_caches
from jaxslam.core.logs import LaserLog
from jaxslam.core.types import Metrics
from jaxslam.evaluation import log_errors
from jaxslam.evaluation.log_errors import Trajectory
from jaxslam.filtering.config import confirmed
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import annotated_map, tum
from jaxslam.io import relations as relations_file
from jaxslam.io.annotated_map import AnnotatedMap
from jaxslam.io.errors import InputError
from jaxslam.io.map_file import load_map
from jaxslam.io.output import folder
from jaxslam.mapping.config import MappingSpec
from jaxslam.mapping.saved_map import SavedMap
from jaxslam.pipeline import log_input, sessions
from jaxslam.pipeline.config import MAPPING
from jaxslam.pipeline.log_input import LogInput, OdometrySource
from jaxslam.pipeline.online import ChunkResult, SlamState
from jaxslam.pipeline.results import SlamResult
from jaxslam.viz.rerun_view import RerunView

_confirmed = jax.jit(confirmed, static_argnums=0)

INCONSISTENT = 3  # exit code of `--strict`


def run(
    log: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="LOG ...")],
    reference: FileOfEach = (),
    relations: FileOfEach = (),
    odometry: OdometrySource = "scan",
    smooth: bool = True,
    noise: OptionalFile = None,
    calibrate: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    calibration: FileOfEach = (),
    saved_map: Annotated[
        Path | None, tyro.conf.arg(name="map", metavar="DIR", help_behavior_hint="")
    ] = None,
    scan_topic: OptionalTopic = None,
    odometry_topic: OptionalTopic = None,
    scanner: Scanner = ScannerOptions(),  # noqa: B008
    pose_frame: Literal["scanner", "base"] = "scanner",
    scan: OptionalCount = None,
    robot_radius: float = MAPPING.robot_radius,
    topology: Literal["grid", "merged"] = "grid",
    gif: bool = False,
    rerun: Annotated[
        Literal["live", "file"] | None,
        tyro.conf.arg(metavar="{live,file}", help_behavior_hint=""),
    ] = None,
    strict: bool = False,
    out: OutFolder = Path("out"),
) -> int:
    """Run SLAM on a laser log.

    Every scan is matched; filter and maps are given keyframes, 0.3 m or 0.3 rad apart. Writes
    metrics.json, trajectory.tum, path.png and errors.png; the topological map as map.geojson, with
    the extra [graph] as map.graphml, and in straight lanes, for robots and fleets, as
    map.nav2.geojson, map.lif.json and map.rmf.yaml; its rooms and doors as rooms.json and
    rooms.png; all drawn in map.png; an occupancy grid as map.yaml and map.pgm, for map_server and
    `jaxslam map`; the pose graph graph.g2o, for batch optimisers; and map.npz, all that later
    sessions need of the map, for `jaxslam.load_map`. The pose of the first scan is the origin of
    the map. Where the map contradicts itself, loops are closed at places that are found again,
    however far off, and a note names them. A WARNING names the scans where it still does, because
    the run was lost there; path.png marks them.

    Args:
        log: CARMEN or Player log, ROS bag, g2o pose graph with scans, or NumPy file; `killian` is
            the log that the extra [data] installs. Several logs, of one robot or of several with
            the same scanner, become one map where places of one are found in the others; each has
            its own trajectory.1.tum, trajectory.2.tum and so on.
        reference: Reference trajectory to evaluate with: a TUM file with the log's clock. Once for
            each log.
        relations: Verified relative poses to evaluate with, with the log's clock. Once for each
            log.
        odometry: Scan matching fused with wheel odometry (scan), scan matching alone, for logs
            without odometry (scans-only), or wheel odometry alone (wheels).
        smooth: Batch-smooth the trajectory and landmarks, with loop closures; --no-smooth writes
            the online estimates.
        noise: File of the noise parameters of the filter (Q and R); by default cautious ones.
        calibrate: Calibrate the robot by the log itself: its wheels, the scanner's mount and the
            clocks of both, by scan matching against odometry; odometry is then corrected, and
            calibration.json written. Not with --odometry scans-only.
        calibration: Calibration of the robot, as --calibrate wrote it, on top of the mount of the
            log or of --mount; with --calibrate it is where that begins. Once for all logs, or once
            for each.
        saved_map: Output folder of an earlier run, of the same scanner, whose map is continued:
            where its places are found again, landmarks keep their ids, new ones are added, and
            what a user added to its map.geojson stays.
        scan_topic: Topic of the laser scans in a bag; by default the one with most messages.
        odometry_topic: Topic of the odometry or of the transforms in a bag; by default the one
            with most messages.
        scanner: The scanner and the frames of the log.
        pose_frame: Whose poses trajectory.tum holds: those of the scanner, or of the robot (base).
        scan: Number of a scan, from 0, whose local Voronoi diagram is drawn: scan.png.
        gif: Write an animation of the run: run.gif.
        robot_radius: Robot radius [m]: the topological map has no arcs through space narrower than
            twice this, but where the robot drove.
        topology: The topological map is the Voronoi diagram of all scans at their poses (grid), or
            diagrams of single scans, merged without a grid, as in the paper (merged).
        rerun: Show the run in the rerun viewer while it is processed (live), or write run.rrd for
            it (file); needs the extra [view].
        strict: Exit with code 3 if the map contradicts itself; all results are still written.
        out: Folder for the results; that of --map is brought up to date.
    """
    check_range("--robot-radius", robot_radius, 0.01, 100.0)
    logs = [_read(path, scanner, odometry, scan_topic, odometry_topic) for path in log]
    if not logs:
        raise InputError("is missing", field="LOG", advice="name one log, or several")
    references, reference_notes = _references(log, reference)
    verified = _of_each("--relations", log, relations)
    match_scans = odometry != "wheels"
    earlier, annotated = (None, None) if saved_map is None else _read_map(saved_map)
    params = read_params(noise, NoiseParams.for_laser_log(match_scans=match_scans))
    robots = calibrated_logs.read_calibrations(calibration, log)
    inputs: list[LogInput] = []
    drives: list[RecordedDrive] = []
    for path, laser_log, known, file in zip(log, logs, references, verified, strict=True):
        with name_errors(str(path)):
            inputs.append(log_input.from_laser_log(laser_log, odometry))
        if calibrate or calibration:
            own = calibration[len(drives) % len(calibration)] if calibration else None
            robot = robots[len(drives)]
            calibrated_logs.check_calibration(path, laser_log, inputs[-1], own, robot)
        checked = None if file is None else relations_file.read(file)
        odom_poses = inputs[-1].odom_poses
        dead_reckoning: Metrics = {}
        with name_errors(str(path if known is None else known.path)):
            if known is not None:
                dead_reckoning |= log_errors.errors_against(
                    laser_log, odom_poses, known.trajectory, None
                )
        with name_errors(str(file)):
            dead_reckoning |= log_errors.errors_against(laser_log, odom_poses, None, checked)
        trajectory = None if known is None else known.trajectory
        drives.append(RecordedDrive(path, laser_log, trajectory, checked, dead_reckoning))
    title = " ".join(map(str, log))
    with name_errors(title):
        given = log_input.combine(inputs)
    if earlier is not None:
        with name_errors(f"--map {saved_map}"):
            sessions.check_saved_map(earlier, given.config.frontend.lidar)
            if not match_scans:
                raise ValueError("a map is continued by scans: not with --odometry wheels")
    mapping = MappingSpec(topology, robot_radius)
    given = given._replace(config=given.config._replace(mapping=mapping))
    config, scans = given.config, given.scans
    rooms, room_notes = (None, ()) if saved_map is None else room_results.earlier_rooms(saved_map)
    if scan is not None:
        check_range("--scan", scan, 0, len(given.increments) - 1)
    with folder(out) as out_dir:
        enable_caches()
        for drive in drives:
            size = f"{len(drive.log.times)} scans of {config.frontend.lidar.num_beams} beams"
            print(f"{drive.path}: {size}{drive.log.source}", flush=True)
        with stopwatch() as seconds:
            drives, inputs, calibrations = calibrated_logs.calibrated(
                drives, inputs, robots, out_dir, calibrate=calibrate
            )
            if calibrations:
                given = log_input.combine(inputs)._replace(config=config)
            viewer = None
            if rerun is not None:
                file = out_dir / "run.rrd" if rerun == "file" else None
                times = np.concatenate([drive.log.times for drive in drives])
                viewer = RerunView(config, times, scans, file)
            result = _run_slam(given, params, earlier, smooth=smooth, viewer=viewer)
        context = RunContext(
            tuple(drives),
            given,
            params,
            smooth=smooth,
            of_base=pose_frame == "base",
            gif=gif,
            saved_map=earlier,
            annotated_map=annotated,
            earlier_rooms=rooms,
        )
        folders = [f"part_{k + 2}" for k in range(len(result.other_parts))]
        extra: Metrics = {
            "skipped_lines": sum(drive.log.num_skipped for drive in drives),
            "mended": [*given.notes, *reference_notes, *room_notes, *result.notes],
            "odometry": given.odometry_source,
            "seconds": seconds,
        }
        if calibrations:
            extra["calibration"] = calibrations if len(drives) > 1 else calibrations[0]
        if folders:
            extra["other_parts"] = folders
        kept = {path.name for path in out_dir.glob("calibration*.json")}
        kept |= {path.name for path in calibration if path.resolve().parent == out.resolve()}
        extra["mended"] += left_from_before(out, [*folders, *kept], len(drives))
        numbers, num_warnings = run_results.write(context, result, out_dir, extra)
        for name, part in zip(folders, result.other_parts, strict=True):
            (out_dir / name).mkdir()
            about: Metrics = {"mended": list(part.notes), "odometry": given.odometry_source}
            alone = context._replace(drives=tuple(without_errors(drive) for drive in drives))
            num_warnings += run_results.write(alone, part, out_dir / name, about)[1]
        if scan is not None:
            report.draw_scan(out_dir / "scan.png", config, scans, scan)
    size = f"{numbers['scans']} scans, {numbers['keyframes']} keyframes"
    summaries.print_summary(numbers, f"{size} of {title}", out)
    return INCONSISTENT if strict and num_warnings else 0


def _read_map(folder_of_map: Path) -> tuple[SavedMap, AnnotatedMap | None]:
    """The map in a folder, and what a user added to its map.geojson."""
    if not folder_of_map.is_dir():
        advice = "name an output folder of `jaxslam run`"
        raise InputError("is no folder", path=folder_of_map, advice=advice)
    saved = load_map(folder_of_map)
    annotated = annotated_map.read(folder_of_map / "map.geojson")
    if annotated is not None:  # no new landmark takes an id that was used for anything else
        next_id: Any = np.int32(max(int(saved.belief.next_id), annotated.next_id))
        saved = saved._replace(belief=saved.belief._replace(next_id=next_id))
    return saved, annotated


def left_from_before(out: Path, kept: Sequence[str], num_logs: int) -> list[str]:
    """A note on results of an earlier run that this one does not replace.

    Args:
        out: Folder of the results.
        kept: Names of files and folders that are this run's.
        num_logs: Number of logs.
    """
    own = (
        {f"trajectory.{k + 1}.tum" for k in range(num_logs)} if num_logs > 1 else {"trajectory.tum"}
    )
    patterns = "part_*", "trajectory*.tum", "calibration*.json"
    found = {path.name for pattern in patterns for path in out.glob(pattern)}
    left = sorted(found - own - set(kept))
    return [f"{out}: {', '.join(left)} of an earlier run stay there"] if left else []


class _Reference(NamedTuple):
    """A reference trajectory, and its file."""

    path: Path
    trajectory: Trajectory


def _read(
    path: Path,
    scanner: ScannerOptions,
    odometry: OdometrySource,
    scan_topic: str | None,
    odometry_topic: str | None,
) -> LaserLog:
    """A log that can be mapped."""
    log = scanner.read_log(path, scan_topic=scan_topic, odometry_topic=odometry_topic)
    require_beams(path, log)
    if odometry == "wheels":
        require_odometry(path, log)
    return log


def _of_each(option: str, logs: Sequence[Path], files: Sequence[Path]) -> Sequence[Path | None]:
    """The file of each log; None where none is given for any."""
    if files and len(files) != len(logs):
        advice = "give the option once for each log, in their order"
        raise InputError(
            f"is given {len(files)} times for {len(logs)} logs", field=option, advice=advice
        )
    return files or [None] * len(logs)


def _references(
    logs: Sequence[Path], files: Sequence[Path]
) -> tuple[list[_Reference | None], list[str]]:
    """Reference trajectory of each log, and notes on them."""
    references: list[_Reference | None] = []
    notes: list[str] = []
    for path in _of_each("--reference", logs, files):
        if path is None:
            references.append(None)
            continue
        trajectory, more = tum.read_reference(path)
        references.append(_Reference(path, trajectory))
        notes += [f"{path}: {note}" for note in more]
    return references, notes


def _run_slam(
    given: LogInput,
    params: NoiseParams,
    saved_map: SavedMap | None,
    *,
    smooth: bool,
    viewer: RerunView | None,
) -> SlamResult:
    """Run SLAM on a log, with a progress bar."""
    num_scans = len(given.increments)
    with tqdm(total=num_scans, unit="scan", desc="compiling", mininterval=0.2) as bar:

        def show_progress(state: SlamState, chunk: ChunkResult) -> None:
            num_done = int(np.asarray(chunk.keyframes)[-1]) + 1
            done = num_done == num_scans
            bar.set_description("smoothing" if done and smooth else "mapping", refresh=False)
            num_landmarks = int(np.asarray(_confirmed(given.config.filter, state.belief)).sum())
            bar.set_postfix_str(f"{num_landmarks} landmarks", refresh=False)
            bar.update(num_done - bar.n)
            if viewer is not None:
                viewer.watch(state, chunk)

        result = log_input.run(
            given, params, saved_map=saved_map, smooth=smooth, callback=show_progress
        )
    if viewer is not None:
        viewer.end(result)
    return result
