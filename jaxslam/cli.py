"""The command line: `jaxslam simulate`, `run LOG`, `map MAP.yaml` and `tune [LOG ...]`."""

import sys
from collections.abc import Iterable
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

import jaxslam
from jaxslam import film, lidar, logs, monte_carlo, online, plan, report, skeleton, slam
from jaxslam import world as worlds
from jaxslam.batches import use_cores
from jaxslam.io import graphml, occupancy, readers, tum
from jaxslam.io import relations as relations_file
from jaxslam.io.errors import InputError
from jaxslam.io.output import folder, write_json
from jaxslam.lidar import Scan
from jaxslam.monte_carlo import Track
from jaxslam.motion import Robot
from jaxslam.online import Mapper, Part, Survey
from jaxslam.options import keep_compiled, named, noise_of, stopwatch, within
from jaxslam.poses import seen_from
from jaxslam.slam import Config, Noise
from jaxslam.tuning import tune
from jaxslam.types import NODE
from jaxslam.view import View
from jaxslam.world import World

AREA = 1.0  # [m^2] of the smallest region that `map --regions all` keeps
ABOUT = """Topological SLAM for a robot with a 2-D laser scanner.
`jaxslam COMMAND --help` lists the options of a command, `jaxslam --version` prints the version."""


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 2 for bad input, 130 for Ctrl-C."""
    argv = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if argv[0] == "--version":
        print(f"jaxslam {jaxslam.__version__}")
        return 0
    commands = {"simulate": simulate, "run": run, "map": map_grid, "tune": tune}
    try:
        tyro.extras.subcommand_cli_from_dict(commands, prog="jaxslam", description=ABOUT, args=argv)
    except InputError as error:
        print(f"jaxslam: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        print(f"jaxslam: {str(interrupt) or 'interrupted, nothing written'}", file=sys.stderr)
        return 130
    return 0


def simulate(
    world: str = "office",
    runs: int = 100,
    seed: int = 0,
    noise: Path | None = None,
    landmarks: Literal["all", "nodes"] = "all",
    labels: Literal["runs", "codes"] = "runs",
    out: Path = Path("out"),
) -> None:
    """Run SLAM on Monte-Carlo trials: simulated drives of one robot from S to F.

    Writes metrics.json, of all trials, and trajectory.tum, truth.tum, map.geojson, path.png and
    errors.png of trial 0, whose time stamps are the scan numbers.

    Args:
        world: World with a path from S to F: office.
        runs: Number of trials.
        seed: Random seed of the odometry and range noise.
        noise: File of the noise parameters of the filter (Q and R); by default those of the
            simulated robot.
        landmarks: Landmark types: all, or only the junctions (the paper's nodes).
        labels: Labels of occupied cells in the Voronoi expansion: straight wall segments (runs),
            or the paper's edge codes (codes).
        out: Folder for the results.
    """
    use_cores()
    within("--runs", runs, 1, 10**6)
    within("--seed", seed, 0, 2**32 - 1)
    with named("--world"):
        walls = World(jnp.asarray(worlds.named(world).walls, float))
        path = jnp.asarray(plan.densify(worlds.drive(world)), float)
    config = Config(labels=labels)
    config = config._replace(kinds=(NODE,)) if landmarks == "nodes" else config
    robot = Robot()
    noise_params = noise_of(noise, slam.wheel_noise(robot))
    key = jax.random.key(seed)
    with folder(out) as out_dir:
        keep_compiled()
        steps = monte_carlo.drive_steps(robot, path)
        with stopwatch() as seconds:
            groups = monte_carlo.experiment(
                key, config, noise_params, walls, robot, path, runs=runs, steps=steps
            )
            tracks = _collect(groups, runs)
        numbers = monte_carlo.evaluate(tracks) | {
            "ate_rmse_m": report.aligned_error(tracks),
            "path_length_m": float(np.mean([report.length(poses) for poses in tracks.truth])),
            "seconds": seconds,
        }
        truth, result = monte_carlo.replay(
            key, config, noise_params, walls, robot, path, run=0, steps=steps
        )
        truth, stamps = np.asarray(truth, np.float64), np.arange(steps, dtype=float)
        report.write(out_dir, numbers, stamps, result)
        tum.write(out_dir / "truth.tum", stamps, truth)
        trajectories = {"odometry": tracks.odometry[0], "truth": truth}
        error = report.error_of(result.poses, truth)
        report.draw(out_dir, config, result, trajectories, error, world=walls)
    report.tell(numbers, f"{runs} trials of {steps} scans, world {world}", out)


def run(
    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")],
    reference: Path | None = None,
    relations: Path | None = None,
    odometry: Literal["scan", "wheels"] = "scan",
    smooth: bool = True,
    noise: Path | None = None,
    scan_topic: str | None = None,
    odometry_topic: str | None = None,
    scan: int | None = None,
    animate: bool = False,
    view: Literal["live", "file"] | None = None,
    out: Path = Path("out"),
) -> None:
    """Run SLAM on a laser log.

    Writes metrics.json, trajectory.tum, path.png and errors.png; the topological map as map.geojson
    and, with the extra [graph], map.graphml; an occupancy grid as map.yaml and map.pgm, for
    map_server and `jaxslam map`; and the pose graph graph.g2o, for batch optimisers. The pose of
    the first scan is the origin of the map.

    Args:
        log: CARMEN log, ROS bag, g2o pose graph with scans, or NumPy file; `killian` is the log
            that the extra [data] installs.
        reference: Reference trajectory to evaluate with: a TUM file with the log's clock.
        relations: Verified relative poses to evaluate with, with the log's clock.
        odometry: Scan matching fused with wheel odometry (scan), or wheel odometry alone (wheels).
        smooth: Batch-smooth the trajectory and landmarks, with loop closures; --no-smooth writes
            the online estimates.
        noise: File of the noise parameters of the filter (Q and R); by default cautious ones.
        scan_topic: Topic of the laser scans in a bag; by default the one with most messages.
        odometry_topic: Topic of the odometry or of the transforms in a bag; by default the one
            with most messages.
        scan: Number of a scan, from 0, whose local Voronoi diagram is drawn: scan.png.
        animate: Write an animation of the run: run.gif.
        view: Show the run in the rerun viewer while it is processed (live), or write run.rrd for it
            (file); needs the extra [view].
        out: Folder for the results.
    """
    laser_log = readers.read(log, scans=scan_topic, odometry=odometry_topic)
    times = laser_log.times
    known = None if reference is None else tum.read(reference)
    verified = None if relations is None else relations_file.read(relations)
    scan_matching = odometry == "scan"
    noise_params = noise_of(noise, slam.log_noise(aligned=scan_matching))
    if scan is not None:
        within("--scan", scan, 0, len(times) - 1)
    config = logs.config_of_scans([laser_log])._replace(landmarks=online.MOST)
    odom_poses = seen_from(laser_log.odometry[0], laser_log.odometry)
    with named(f"{reference or ''}"):
        dead_reckoning = report.judged(laser_log, odom_poses, known, None)
    with named(f"{relations or ''}"):
        dead_reckoning |= report.judged(laser_log, odom_poses, None, verified)
    increments = logs.motions(odom_poses)
    scans = lidar.limit(jnp.asarray(laser_log.ranges, float), config.lidar)
    with folder(out) as out_dir:
        keep_compiled()
        size = f"{len(times)} scans of {config.lidar.beams} beams"
        print(f"{log}: {size}{laser_log.source}", flush=True)
        with stopwatch() as seconds:
            viewer = None
            if view is not None:
                file = out_dir / "run.rrd" if view == "file" else None
                viewer = View(config, times, scans, file)
            result = _run_slam(
                config,
                noise_params,
                increments,
                scans,
                aligned=scan_matching,
                smooth=smooth,
                viewer=viewer,
            )
            poses = result.poses
        numbers = {
            "scans": len(poses),
            "skipped_lines": laser_log.skipped,
            "mended": laser_log.mended,
            "odometry": odometry,
            "path_length_m": report.length(poses if scan_matching else odom_poses),
            "landmarks": int(np.sum(slam.confirmed(config, result.belief))),
            "matches": float(np.mean(np.sum(np.asarray(result.info.used), axis=1))),
            "closures": len(result.closures.first) if result.closures else 0,
            "seconds": seconds,
        }
        trajectories, error = {"odometry": odom_poses}, None
        online_poses = np.asarray(result.info.pose, np.float64)
        if known is not None:
            trajectories["reference"] = report.beside(times, poses, known)
            error = report.since_start(times, online_poses, known)
            numbers["nees"] = report.nees_of(error, np.asarray(result.info.pose_cov))
        if dead_reckoning:
            numbers |= report.judged(laser_log, poses, known, verified)
            if smooth:
                numbers["filter"] = report.judged(laser_log, online_poses, known, verified)
            numbers["dead_reckoning"] = dead_reckoning
        report.write(out_dir, numbers, times, result)
        inputs = slam.Inputs(jnp.asarray(increments, float), result.nodes, aligned=result.aligned)
        config = config._replace(landmarks=result.belief.seen.size)
        report.write_maps(out_dir, config, noise_params, result, inputs, scans)
        report.draw(out_dir, config, result, trajectories, error, scans=scans)
        if scan is not None:
            report.draw_scan(out_dir / "scan.png", config, scans, scan)
        if animate:
            gif = out_dir / "run.gif"
            film.film(gif, config, noise_params, inputs, scans, poses, odom_poses)
    report.tell(numbers, f"{len(poses)} scans of {log}", out)


def _run_slam(
    config: Config,
    noise: Noise,
    increments: np.ndarray,
    scans: Scan,
    *,
    aligned: bool,
    smooth: bool,
    viewer: View | None,
) -> Survey:
    """Run SLAM on a log, with a progress bar."""
    with tqdm(total=len(increments), unit="scan", desc="compiling", mininterval=0.2) as bar:

        def show_progress(mapper: Mapper, part: Part) -> None:
            done = bar.n + len(part.info.finite) == len(increments)
            bar.set_description("smoothing" if done and smooth else "mapping", refresh=False)
            num_landmarks = int(np.sum(slam.confirmed(config, mapper.belief)))
            bar.set_postfix_str(f"{num_landmarks} landmarks", refresh=False)
            bar.update(len(part.info.finite))
            if viewer is not None:
                viewer.watch(mapper, part)

        result = online.survey(
            config,
            noise,
            jnp.zeros(3),
            increments,
            scans,
            aligned=aligned,
            smooth=smooth,
            watch=show_progress,
        )
    if viewer is not None:
        viewer.end(result)
    return result


def map_grid(
    map: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP.yaml")],
    clearance: float = 0.25,
    speck: float = 0.1,
    regions: Literal["largest", "all"] = "largest",
    out: Path = Path("out"),
) -> None:
    """Extract the topological map of a ROS occupancy grid.

    Writes metrics.json, map.geojson, map.graphml and map.png; needs the extras [ros] and [graph].

    Args:
        map: YAML file of map_server, with its image in the same folder.
        clearance: Robot radius [m]: least distance of the map to obstacles.
        speck: Minimum obstacle size [m]: smaller ones in free space are noise.
        regions: Connected regions of the robot's centre: the largest, or all of at least 1 m^2.
        out: Folder for the results.
    """
    within("--clearance", clearance, 0.01, 100.0)
    within("--speck", speck, 0.0, 100.0)
    graphml.require()
    grid = occupancy.read(map)
    rows, columns = grid.free.shape
    print(f"{map}: {rows} x {columns} cells of {grid.resolution:g} m", flush=True)
    stages = (*skeleton.STAGES, "writing")
    with (
        folder(out) as out_dir,
        tqdm(total=len(stages), unit="stage", delay=0.5, mininterval=0) as bar,
    ):

        def show_progress(stage: str) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(stages.index(stage) - bar.n)

        start = perf_counter()
        with named(str(map)):
            result = skeleton.survey(
                grid.occupied,
                grid.free,
                resolution=grid.resolution,
                origin=grid.origin,
                clearance=clearance,
                speck=speck,
                area=AREA if regions == "all" else None,
                watch=show_progress,
            )
        seconds = {"run": perf_counter() - start}
        show_progress("writing")
        numbers = report.of_map(result) | {"clearance_m": clearance, "seconds": seconds}
        write_json(out_dir / "metrics.json", numbers)
        report.write_map(out_dir / "map.geojson", result.graph)
        graphml.write(out_dir / "map.graphml", result.graph)
        report.draw_map(out_dir / "map.png", grid, result.graph)
        bar.update()
    title = f"{map}: robot radius {clearance:g} m, regions {result.regions}"
    report.tell_map(numbers, title, out)


def _collect(groups: Iterable[Track], runs: int) -> Track:
    """All trials of an experiment, with a progress bar; print the errors of the first group."""
    done: list[Track] = []
    errors: list[np.ndarray] = []
    with tqdm(total=runs, unit="trial", desc="compiling", mininterval=0.5) as bar:
        for group in groups:
            done.append(group)
            errors.append(report.error_of(group.estimate, group.truth))
            rmse = monte_carlo.errors(np.concatenate(errors))["position_rmse_m"]
            if len(done) == 1:
                odom_error = report.error_of(group.odometry, group.truth)
                odom_rmse = monte_carlo.errors(odom_error)["position_rmse_m"]
                bar.write(
                    f"first {len(group.truth)} trials: position RMSE {rmse:.3f} m, "
                    f"by dead reckoning {odom_rmse:.3f} m"
                )
                bar.set_description("running")
            bar.set_postfix_str(f"position RMSE {rmse:.3f} m", refresh=False)
            bar.update(len(group.truth))
    return monte_carlo.collect(done)
