"""The command `jaxslam simulate`."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro
from tqdm import tqdm

from jaxslam.cli import report, summaries
from jaxslam.cli.life_options import MATCHED, check_moved_at, leaving, leaving_note, life_of
from jaxslam.cli.log_options import read_params
from jaxslam.cli.options import OptionalFile, OptionalLength, OutFolder, check_range, name_errors
from jaxslam.cli.stopwatch import stopwatch
from jaxslam.cli.world_options import read_building
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.types import JUNCTION
from jaxslam.evaluation import log_errors, summary
from jaxslam.frontend.config import FrontendConfig
from jaxslam.io import life_file, robot_file, tum
from jaxslam.io.output import folder
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import TrialResult
from jaxslam.simulation import drives, kinematics, trial_map
from jaxslam.simulation import trials as trials_module
from jaxslam.simulation.life import Life
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.trial_map import FilteredDrive
from jaxslam.simulation.wheel_faults import can_fail

OptionalUnit = Annotated[str | None, tyro.conf.arg(metavar="UNIT", help_behavior_hint="")]
"""Option that is a unit of length, or not given."""

OptionalDrive = Annotated[
    Literal["patrol", "route"] | None, tyro.conf.arg(metavar="KIND", help_behavior_hint="")
]
"""Option that names a kind of drive, or none."""

OptionalOdometry = Annotated[
    Literal["scan", "wheels"] | None, tyro.conf.arg(metavar="SOURCE", help_behavior_hint="")
]
"""Option that is a source of odometry, or not given."""

Layers = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...", help_behavior_hint="")]
"""Option that names layers of a drawing, or none."""


def simulate(
    world: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "office",
    path: OptionalFile = None,
    drive: OptionalDrive = None,
    resolution: OptionalLength = None,
    unit: OptionalUnit = None,
    layers: Layers = (),
    trials: int = 100,
    seed: int = 0,
    noise: OptionalFile = None,
    robot: OptionalFile = None,
    life: OptionalFile = None,
    odometry: OptionalOdometry = None,
    landmarks: Literal["all", "junctions"] = "all",
    labels: Literal["segments", "codes"] = "segments",
    out: OutFolder = Path("out"),
) -> None:
    """Run SLAM on Monte-Carlo trials: simulated drives of one robot from S to F.

    Writes metrics.json, of all trials, and trajectory.tum, truth.tum, map.geojson, path.png and
    errors.png of trial 0, whose time stamps are the scan numbers.

    Args:
        world: World with a path from S to F: office; random:SEED or random:SEED:40x25 [m], a random
            building, which is patrolled; or a file: ROS map (.yaml), picture of a plan (.png, .pgm,
            ..., with --resolution), GeoJSON, CSV of walls x1,y1,x2,y2, SVG or DXF (both need the
            extra [cad]).
        path: File of the waypoints that straight lines join, in the coordinates of the world's
            file, in metres: CSV of x,y, or GeoJSON of one LineString; a file has no path of its
            own.
        drive: A drive that is found instead of `--path`, in any world: patrol through all rooms,
            or route between two of its ends that are far apart.
        resolution: Side of a pixel [m] of a picture.
        unit: Unit of a drawing where its file states none: m, cm, mm, in, ft, or the metres of a
            unit, as 0.1 for 1:100 in mm.
        layers: Layers of a drawing whose lines are walls; by default all that are visible.
        trials: Number of trials.
        seed: Random seed of the odometry and range noise.
        noise: File of the noise parameters of the filter (Q and R); by default those of the
            simulated robot.
        robot: File of the robot, TOML or JSON: scanner, drive, noise, limits, mount; by default it
            has two wheels 0.4 m apart and 361 beams ahead. `jaxslam.io.robot_file` documents it.
        life: File of what goes wrong, TOML or JSON: people, doors, furniture, glass, missing beams,
            slip, lost odometry and scans; or `typical`, what recorded drives show on average; by
            default ranges have their noise and nothing else does. `jaxslam.io.life_file` documents
            it.
        odometry: Scan matching fused with wheel odometry (scan), as `run` has it, or wheel odometry
            alone (wheels); by default scan where life has wheels slip or odometry fail.
        landmarks: Landmark types: all, or only the junctions of the Voronoi diagram (the paper's
            nodes).
        labels: Labels of occupied cells in the Voronoi expansion: straight wall segments, or the
            paper's edge codes. `--landmarks junctions --labels codes` is the paper's method.
        out: Folder for the results.
    """
    use_cpu_devices()
    check_range("--trials", trials, 1, 10**6)
    check_range("--seed", seed, 0, 2**32 - 1)
    goes_wrong = None if life is None else life_file.read(life)
    config = Config(frontend=FrontendConfig(labels=labels))
    if landmarks == "junctions":
        config = config._replace(filter=config.filter._replace(landmark_kinds=(JUNCTION,)))
    simulated, config = _robot(robot, config)
    building = read_building(
        world,
        path,
        drive=drive,
        resolution=resolution,
        unit=unit,
        layers=layers,
        robot_radius=simulated.radius,
    )
    walls, points = building.world, building.path
    corners, count = np.asarray(walls.walls).reshape(-1, 2), len(walls.walls)
    width, height = np.ptp(corners, axis=0)
    print(f"{world}: {count} walls, {width:.1f} m x {height:.1f} m", flush=True)
    for note in building.notes:
        print(f"note: {note}", flush=True)
    given, match_scans = None, odometry == "scan"
    if goes_wrong is not None:
        with name_errors(str(life)):
            walls, given, note = life_of(building, goes_wrong, seed=seed)
        print(f"life: {note}", flush=True)
        if odometry is None and can_fail(given.wheels):
            match_scans = True
            print(f"scans are matched: {MATCHED}", flush=True)
    default = kinematics.noise_params(simulated, walls, match_scans=match_scans)
    params = read_params(noise, default)
    lidar = config.frontend.lidar
    open_share = leaving(lidar, walls, simulated, points)
    print(leaving_note(open_share, lidar.range_max), flush=True)
    key = jax.random.key(seed)
    with folder(out) as out_dir:
        enable_caches()
        with name_errors("--robot"):
            num_scans = drives.num_scans_of_drive(simulated, points, building.world)
        with name_errors(str(life)):
            check_moved_at(given, simulated, num_scans)
        print(f"{trials} trials of {num_scans} scans", flush=True)
        about = key, config, params, simulated, walls, points
        with stopwatch() as seconds:
            results, first = _run(about, trials, num_scans, given, match_scans)
        lengths = [log_errors.path_length(poses) for poses in np.asarray(results.truth)]
        numbers = summary.evaluate(results) | {
            "ate_rmse_m": log_errors.mean_ate(results),
            "path_length_m": float(np.mean(lengths)),
            "beams_leaving": open_share._asdict(),
            "seconds": seconds,
        }
        with name_errors(f"{'the drive' if life is None else life}: trial 0"):
            if first is not None:
                result = trial_map.slam_result(config, first)
            else:  # what `run` does, that finds breaks
                _, result = trials_module.replay_trial(
                    *about, trial=0, num_scans=num_scans, life=given, match_scans=True
                )
        truth, stamps = np.asarray(results.truth[0], np.float64), np.arange(num_scans, dtype=float)
        report.write_results(out_dir, numbers, result.topological_map)
        tum.write(out_dir / "trajectory.tum", stamps, result.poses)
        tum.write(out_dir / "truth.tum", stamps, truth)
        trajectories = {"odometry": np.asarray(results.dead_reckoning[0]), "truth": truth}
        error = log_errors.pose_errors(result.poses, truth)
        report.draw(out_dir, config, result, trajectories, error, world=walls)
    summaries.print_summary(numbers, f"{trials} trials of {num_scans} scans, world {world}", out)


def _robot(path: Path | None, config: Config) -> tuple[Robot, Config]:
    """The robot of a file, printed in a line, or the default one; and what it is seen with."""
    if path is None:
        return Robot(), config
    found = robot_file.read(path)
    print(found.describe())
    for note in found.notes:
        print(f"  {note}")
    lidar = found.robot.scanner.lidar() if found.robot.scanner else config.frontend.lidar
    return found.robot, Config.for_lidar(lidar, frontend=config.frontend, filter=config.filter)


def _run(
    about: tuple, num_trials: int, num_scans: int, life: Life | None, match_scans: bool
) -> tuple[TrialResult, FilteredDrive | None]:
    """All trials; and what the map of trial 0 is made of, where its scans are not matched."""
    given: Any = {"num_trials": num_trials, "num_scans": num_scans, "life": life}
    if match_scans:
        groups = trials_module.run_trials(*about, **given, match_scans=True)
        return _collect(groups, num_trials), None
    drives: list[FilteredDrive] = []

    def results() -> Iterator[TrialResult]:
        for group, drive in trials_module.run_trials_and_map(*about, **given):
            if not drives:
                drives.append(drive)
            yield group

    return _collect(results(), num_trials), drives[0]


def _collect(groups: Iterable[TrialResult], num_trials: int) -> TrialResult:
    """All trials of an experiment, with a progress bar; print the errors of the first group."""
    done: list[TrialResult] = []
    errors: list[np.ndarray] = []
    with tqdm(total=num_trials, unit="trial", desc="compiling", mininterval=0.5) as bar:
        for group in groups:
            truth = np.asarray(group.truth)
            done.append(group)
            errors.append(log_errors.pose_errors(np.asarray(group.estimate), truth))
            rmse = summary.rmse_of(np.concatenate(errors))["position_rmse_m"]
            if len(done) == 1:
                odom_error = log_errors.pose_errors(np.asarray(group.dead_reckoning), truth)
                odom_rmse = summary.rmse_of(odom_error)["position_rmse_m"]
                bar.write(
                    f"first {len(truth)} trials: position RMSE {rmse:.3f} m, "
                    f"by dead reckoning {odom_rmse:.3f} m"
                )
                bar.set_description("running")
            bar.set_postfix_str(f"position RMSE {rmse:.3f} m", refresh=False)
            bar.update(len(truth))
    return episodes.concatenate_results(done)
