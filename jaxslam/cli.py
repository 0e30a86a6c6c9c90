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

AREA = 1.0  # [m^2] of the smallest region of a map that is drawn
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
    except KeyboardInterrupt as stop:
        print(f"jaxslam: {str(stop) or 'interrupted, nothing written'}", file=sys.stderr)
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
    """Drive a simulated robot from S to F, many times, and run SLAM on every drive.

    Writes metrics.json, of all runs, and trajectory.tum, truth.tum, map.geojson, path.png and
    errors.png, of run 0, whose time stamps count its scans.

    Args:
        world: A world with a drive: office.
        runs: How many times.
        seed: Of the noise of wheels and lidar.
        noise: File of the noise that the filter assumes; by default it is the robot's own.
        landmarks: All kinds, or the paper's nodes alone.
        labels: What tells wall cells apart: straight runs, or the paper's edge codes.
        out: Folder for the results.
    """
    use_cores()
    within("--runs", runs, 1, 10**6)
    within("--seed", seed, 0, 2**32 - 1)
    with named("--world"):
        known = World(jnp.asarray(worlds.named(world).walls, float))
        path = jnp.asarray(plan.densify(worlds.drive(world)), float)
    config = Config(labels=labels)
    config = config._replace(kinds=(NODE,)) if landmarks == "nodes" else config
    assumed = noise_of(noise, slam.wheel_noise(Robot()))
    given = (jax.random.key(seed), config, assumed, known, Robot(), path)
    with folder(out) as place:
        keep_compiled()
        steps = monte_carlo.drive_steps(Robot(), path)
        with stopwatch() as seconds:
            tracks = _watch(monte_carlo.experiment(*given, runs=runs, steps=steps), runs)
        numbers = monte_carlo.evaluate(tracks) | {
            "ate_rmse_m": report.aligned_error(tracks),
            "path_length_m": float(np.mean([report.length(way) for way in tracks.truth])),
            "seconds": seconds,
        }
        truth, survey = monte_carlo.replay(*given, run=0, steps=steps)
        truth, stamps = np.asarray(truth, np.float64), np.arange(steps, dtype=float)
        report.write(place, numbers, stamps, survey)
        tum.write(place / "truth.tum", stamps, truth)
        lines = {"odometry": tracks.odometry[0], "truth": truth}
        report.draw(
            place,
            config,
            survey,
            lines,
            report.error_of(survey.poses, truth),
            world=known,
        )
    report.tell(numbers, f"{runs} runs of {steps} scans, world {world}", out)


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
    """Run SLAM on a recorded log.

    Writes metrics.json, trajectory.tum, path.png and errors.png; the topological map as
    map.geojson and, with the extra [graph], map.graphml; what the scans saw as map.yaml and
    map.pgm, for map_server and `jaxslam map`; and graph.g2o, for optimisers. The first scan is made
    at the origin of the map.

    Args:
        log: CARMEN log, ROS bag, pose graph of g2o with its scans, or recording as a NumPy file;
            `killian` is the log that the extra [data] brings.
        reference: Trajectory to compare with, a TUM file on the log's clock.
        relations: Verified relative poses to compare with, on the log's clock.
        odometry: Scans aligned to those before and fused with the wheels, or the wheels alone.
        smooth: At the end, tell all poses and places by all that was seen, and by scans laid on
            those of earlier visits to a place; else each pose stays as the filter told it.
        noise: File of the noise that the filter assumes; by default a cautious one.
        scan_topic: Topic of the laser scans in a bag; by default that with most messages.
        odometry_topic: Topic of the odometry in a bag, or of the transforms; likewise.
        scan: Number of a scan, from 0, whose local diagram is drawn: scan.png.
        animate: Film the run: run.gif.
        view: Show the run as it goes on in rerun's viewer, or write run.rrd for it; needs the
            extra [view].
        out: Folder for the results.
    """
    recording = readers.read(log, scans=scan_topic, odometry=odometry_topic)
    known = None if reference is None else tum.read(reference)
    verified = None if relations is None else relations_file.read(relations)
    by_scans = odometry == "scan"
    assumed = noise_of(noise, slam.log_noise(aligned=by_scans))
    if scan is not None:
        within("--scan", scan, 0, len(recording.times) - 1)
    config = logs.config_of_scans([recording])._replace(landmarks=online.MOST)
    wheels = seen_from(recording.odometry[0], recording.odometry)
    with named(f"{reference or ''}"):
        blind = {} if known is None else report.against_reference(recording.times, wheels, known)
    with named(f"{relations or ''}"):
        blind |= {} if verified is None else report.against_relations(recording, wheels, verified)
    motions = logs.motions(wheels)
    scans = lidar.limit(jnp.asarray(recording.ranges, float), config.lidar)
    with folder(out) as place:
        keep_compiled()
        print(
            f"{log}: {len(wheels)} scans of {config.lidar.beams} beams{recording.source}",
            flush=True,
        )
        with stopwatch() as seconds:
            shown = None
            if view is not None:
                file = place / "run.rrd" if view == "file" else None
                shown = View(config, recording.times, scans, file)
            how = {"aligned": by_scans, "smooth": smooth}
            survey = _map(config, assumed, motions, scans, view=shown, **how)
            poses = survey.poses
        numbers = {
            "scans": len(poses),
            "skipped_lines": recording.skipped,
            "mended": recording.mended,
            "odometry": odometry,
            "path_length_m": report.length(poses if by_scans else wheels),
            "landmarks": int(np.sum(slam.confirmed(config, survey.belief))),
            "matches": float(np.mean(np.sum(np.asarray(survey.info.used), axis=1))),
            "closures": len(survey.closures.first) if survey.closures else 0,
            "seconds": seconds,
        }
        lines, error = {"odometry": wheels}, None
        filtered = np.asarray(survey.info.pose, np.float64)
        if known is not None:
            lines["reference"] = report.beside(recording.times, poses, known)
            error = report.since_start(recording.times, filtered, known)
            numbers["nees"] = report.nees_of(error, np.asarray(survey.info.pose_cov))
        if blind:
            numbers |= report.judged(recording, poses, known, verified)
            if smooth:
                numbers["filter"] = report.judged(recording, filtered, known, verified)
            numbers["dead_reckoning"] = blind
        report.write(place, numbers, recording.times, survey)
        told = jnp.asarray(motions, float)
        inputs = slam.Inputs(told, survey.nodes, aligned=survey.aligned)
        config = config._replace(landmarks=survey.belief.seen.size)
        report.write_maps(place, config, assumed, survey, inputs, scans)
        report.draw(place, config, survey, lines, error, scans=scans)
        if scan is not None:
            report.draw_scan(place / "scan.png", config, scans, scan)
        if animate:
            film.film(place / "run.gif", config, assumed, inputs, scans, poses, wheels)
    report.tell(numbers, f"{len(poses)} scans of {log}", out)


def _map(
    config: Config,
    noise: Noise,
    motions: np.ndarray,
    scans: Scan,
    *,
    view: View | None,
    **how: bool,
) -> Survey:
    """`online.survey` of a log, which shows how far it is."""
    with tqdm(total=len(motions), unit="scan", desc="compiling", mininterval=0.2) as bar:

        def watch(mapper: Mapper, part: Part) -> None:
            done = bar.n + len(part.info.finite) == len(motions)
            bar.set_description("smoothing" if done and how["smooth"] else "mapping", refresh=False)
            found = int(np.sum(slam.confirmed(config, mapper.belief)))
            bar.set_postfix_str(f"{found} landmarks", refresh=False)
            bar.update(len(part.info.finite))
            if view is not None:
                view.watch(mapper, part)

        given = config, noise, jnp.zeros(3), motions, scans
        survey = online.survey(*given, watch=watch, **how)
    if view is not None:
        view.end(survey)
    return survey


def map_grid(
    map: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP.yaml")],
    clearance: float = 0.25,
    speck: float = 0.1,
    regions: Literal["largest", "all"] = "largest",
    out: Path = Path("out"),
) -> None:
    """Turn a ROS occupancy map into a topological map.

    Writes metrics.json, map.geojson, map.graphml and map.png; needs the extras [ros] and [graph].

    Args:
        map: YAML file of map_server, its image beside it.
        clearance: Radius of the robot [m]: it must fit everywhere on the map.
        speck: Things in free space no wider than this [m] are noise.
        regions: Where the robot can be: the largest region, or all in which its centre has 1 m^2.
        out: Folder for the results.
    """
    within("--clearance", clearance, 0.01, 100.0)
    within("--speck", speck, 0.0, 100.0)
    graphml.require()
    grid = occupancy.read(map)
    size = "{} x {} cells of {:g} m".format(*grid.free.shape, grid.resolution)
    print(f"{map}: {size}", flush=True)
    area = AREA if regions == "all" else None
    stages = (*skeleton.STAGES, "writing")
    with (
        folder(out) as place,
        tqdm(total=len(stages), unit="stage", delay=0.5, mininterval=0) as bar,
    ):

        def watch(stage: str) -> None:
            bar.set_description(stage, refresh=False)
            bar.update(stages.index(stage) - bar.n)

        begin = perf_counter()
        with named(str(map)):
            survey = skeleton.survey(
                **grid._asdict(), clearance=clearance, speck=speck, area=area, watch=watch
            )
        seconds = {"run": perf_counter() - begin}
        watch("writing")
        numbers = report.of_map(survey) | {"clearance_m": clearance, "seconds": seconds}
        write_json(place / "metrics.json", numbers)
        report.write_map(place / "map.geojson", survey.graph)
        graphml.write(place / "map.graphml", survey.graph)
        report.draw_map(place / "map.png", grid, survey.graph)
        bar.update()
    report.tell_map(numbers, f"{map}: clearance {clearance:g} m, regions {survey.regions}", out)


def _watch(parts: Iterable[Track], runs: int) -> Track:
    """All tracks of an experiment; shows how far it is, and its first result on a line."""
    done: list[Track] = []
    errors: list[np.ndarray] = []
    with tqdm(total=runs, unit="run", desc="compiling", mininterval=0.5) as bar:
        for part in parts:
            done.append(part)
            errors.append(report.error_of(part.estimate, part.truth))
            rmse = monte_carlo.errors(np.concatenate(errors))["position_rmse_m"]
            if len(done) == 1:
                blind = monte_carlo.errors(report.error_of(part.odometry, part.truth))[
                    "position_rmse_m"
                ]
                bar.write(
                    f"first {len(part.truth)} runs: position RMSE {rmse:.3f} m, "
                    f"by dead reckoning {blind:.3f} m"
                )
                bar.set_description("running")
            bar.set_postfix_str(f"position RMSE {rmse:.3f} m", refresh=False)
            bar.update(len(part.truth))
    return monte_carlo.collect(done)
