"""The command line: `jaxslam simulate` and `jaxslam run LOG`."""

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

import jaxslam
from jaxslam import lidar, metrics, monte_carlo, plan, slam
from jaxslam import world as worlds
from jaxslam.io import carmen, geojson, tum
from jaxslam.io import noise as noise_file
from jaxslam.io import relations as relations_file
from jaxslam.io.errors import InputError
from jaxslam.io.output import folder, write_json
from jaxslam.io.recording import Recording
from jaxslam.lidar import Scan
from jaxslam.monte_carlo import Track
from jaxslam.motion import Robot
from jaxslam.slam import Config, Noise, Survey
from jaxslam.topomap import Graph
from jaxslam.types import NODE
from jaxslam.world import World

LANDMARKS = 256  # room for those of a recorded log
KINDS = ("node", "corner", "wall")
ABOUT = """Topological SLAM for a robot with a 2-D laser scanner.
`jaxslam COMMAND --help` lists the options of a command, `jaxslam --version` prints the version."""

Numbers = dict[str, Any]
"""What `metrics.json` holds."""

Trajectory = tuple[np.ndarray, np.ndarray]
"""Times (N,) [s] and poses (N, 3)."""


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 2 for bad input, 130 for Ctrl-C."""
    argv = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if argv[0] == "--version":
        print(f"jaxslam {jaxslam.__version__}")
        return 0
    commands = {"simulate": simulate, "run": run}
    try:
        tyro.extras.subcommand_cli_from_dict(commands, prog="jaxslam", description=ABOUT, args=argv)
    except InputError as error:
        print(f"jaxslam: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxslam: interrupted, nothing written", file=sys.stderr)
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
    _within("--runs", runs, 1, 10**6)
    _within("--seed", seed, 0, 2**32 - 1)
    with _named("--world"):
        known = World(jnp.asarray(worlds.named(world).walls, float))
        path = jnp.asarray(plan.densify(worlds.drive(world)), float)
    config = Config(labels=labels)
    config = config._replace(kinds=(NODE,)) if landmarks == "nodes" else config
    assumed = _noise(noise, slam.wheel_noise(Robot()))
    given = (jax.random.key(seed), config, assumed, known, Robot(), path)
    with folder(out) as place:
        _keep_compiled()
        steps = monte_carlo.drive_steps(Robot(), path)
        with _stopwatch() as seconds:
            tracks = _watch(monte_carlo.experiment(*given, runs=runs, steps=steps), runs)
        numbers = monte_carlo.evaluate(tracks) | {
            "ate_rmse_m": _aligned_error(tracks),
            "path_length_m": float(np.mean([_length(way) for way in tracks.truth])),
            "seconds": seconds,
        }
        truth, survey = monte_carlo.replay(*given, run=0, steps=steps)
        truth, stamps = np.asarray(truth, np.float64), np.arange(steps, dtype=float)
        _write(place, numbers, stamps, survey)
        tum.write(place / "truth.tum", stamps, truth)
        lines = {"odometry": tracks.odometry[0], "truth": truth}
        _draw(place, config, survey, lines, _error(_poses(survey), truth), world=known)
    _tell(numbers, f"{runs} runs of {steps} scans, world {world}", out)


def run(
    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")],
    reference: Path | None = None,
    relations: Path | None = None,
    noise: Path | None = None,
    out: Path = Path("out"),
) -> None:
    """Run SLAM on a recorded log.

    Writes metrics.json, trajectory.tum, map.geojson, path.png and errors.png; the first scan is
    made at the origin of the map.

    Args:
        log: CARMEN log with FLASER lines, plain or gzipped.
        reference: Trajectory to compare with, a TUM file on the log's clock.
        relations: Verified relative poses to compare with, on the log's clock.
        noise: File of the noise that the filter assumes; by default a cautious one.
        out: Folder for the results.
    """
    recording = carmen.read(log)
    known = None if reference is None else tum.read(reference)
    verified = None if relations is None else relations_file.read(relations)
    assumed = _noise(noise, slam.log_noise())
    config = Config(lidar=recording.lidar, landmarks=LANDMARKS)
    wheels = _seen_from(recording.odometry[0], recording.odometry)
    with _named(f"{reference or ''}"):
        blind = {} if known is None else _against_reference(recording.times, wheels, known)
    with _named(f"{relations or ''}"):
        blind |= {} if verified is None else _against_relations(recording, wheels, verified)
    motions = np.concatenate([np.zeros((1, 3)), _seen_from(wheels[:-1], wheels[1:])])
    scans = lidar.limit(jnp.asarray(recording.ranges, float), config.lidar)
    with folder(out) as place:
        _keep_compiled()
        print(f"{log}: {len(wheels)} scans of {config.lidar.beams} beams", flush=True)
        with _stopwatch() as seconds:
            moved = jnp.asarray(motions, float)
            survey = slam.survey(config, assumed, jnp.zeros(3), moved, scans)
            poses = _poses(survey)
        numbers = {
            "scans": len(poses),
            "skipped_lines": recording.skipped,
            "path_length_m": _length(wheels),
            "landmarks": int(np.sum(np.asarray(survey.belief.seen) >= config.confirm)),
            "matches": float(np.mean(np.sum(np.asarray(survey.info.used), axis=1))),
            "seconds": seconds,
        }
        lines, error = {"odometry": wheels}, None
        if known is not None:
            numbers |= _against_reference(recording.times, poses, known)
            lines["reference"], error = _beside(recording.times, poses, known)
        if verified is not None:
            numbers |= _against_relations(recording, poses, verified)
        numbers |= {"dead_reckoning": blind} if blind else {}
        _write(place, numbers, recording.times, survey)
        _draw(place, config, survey, lines, error, scans=scans)
    _tell(numbers, f"{len(poses)} scans of {log}", out)


def _within(option: str, value: int, low: int, high: int) -> None:
    """Raise unless the value of an option is in its range."""
    if not low <= value <= high:
        raise InputError(f"{value} is not between {low} and {high}", field=option)


@contextmanager
def _named(what: str) -> Iterator[None]:
    """Turn a ValueError of the block into an InputError that names the option or file."""
    try:
        yield
    except ValueError as error:
        raise InputError(str(error), field=what) from None


def _noise(path: Path | None, default: Noise) -> Noise:
    """Noise in a file; the default without one."""
    return default if path is None else noise_file.read(path, default)


def _keep_compiled() -> None:
    """Keep compiled programs in the user's cache folder, unless JAX was told of another one."""
    if jax.config.jax_compilation_cache_dir is not None:
        return
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    cache = Path(home) / "jaxslam"
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if os.access(cache, os.W_OK | os.X_OK):
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@contextmanager
def _stopwatch() -> Iterator[dict[str, float]]:
    """Seconds of the block: those of XLA's compiler, and the rest."""
    seconds = {"compile": 0.0, "run": 0.0}

    def listen(event: str, duration: float, **_: Any) -> None:
        if running and event == "/jax/core/compile/backend_compile_duration":
            seconds["compile"] += duration

    jax.monitoring.register_event_duration_secs_listener(listen)
    begin, running = perf_counter(), True
    yield seconds
    running = False
    seconds["run"] = perf_counter() - begin - seconds["compile"]


def _watch(parts: Iterable[Track], runs: int) -> Track:
    """All tracks of an experiment; shows how far it is, and its first result on a line."""
    done: list[Track] = []
    with tqdm(total=runs, unit="run", desc="compiling", mininterval=0.5) as bar:
        for part in parts:
            done.append(part)
            so_far = np.concatenate([_error(p.estimate, p.truth) for p in done])
            rmse = monte_carlo.errors(so_far)["position_rmse_m"]
            if len(done) == 1:
                blind = monte_carlo.errors(_error(part.odometry, part.truth))["position_rmse_m"]
                bar.write(
                    f"first {len(part.truth)} runs: position RMSE {rmse:.3f} m, "
                    f"by dead reckoning {blind:.3f} m"
                )
                bar.set_description("running")
            bar.set_postfix_str(f"position RMSE {rmse:.3f} m", refresh=False)
            bar.update(len(part.truth))
    return monte_carlo.collect(done)


def _poses(survey: Survey) -> np.ndarray:
    """Estimated poses (T, 3) float64."""
    return np.asarray(survey.info.pose, np.float64)


def _error(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors (..., 3) [m, m, rad] of poses (..., 3), world frame."""
    return np.asarray(metrics.pose_error(jnp.asarray(poses, float), jnp.asarray(truth, float)))


def _seen_from(frames: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses (..., 3) in the frames of others (..., 3): `geometry.between` in float64."""
    c, s = np.cos(frames[..., 2]), np.sin(frames[..., 2])
    x, y, turn = np.moveaxis(poses - frames, -1, 0)
    turn = np.remainder(turn + np.pi, 2 * np.pi) - np.pi
    return np.stack([c * x + s * y, c * y - s * x, turn], axis=-1)


def _length(poses: np.ndarray) -> float:
    """Length [m] of the way along poses (T, 3)."""
    return float(np.sum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))


def _aligned_error(tracks: Track) -> float | None:
    """Position RMSE [m] over runs, each aligned as a whole; None if none is finite."""
    stamps = np.arange(tracks.truth.shape[1])
    squares = [
        metrics.ate(stamps, estimate, stamps, truth)["ate_rmse_m"] ** 2
        for estimate, truth in zip(tracks.estimate, tracks.truth, strict=True)
        if np.isfinite(estimate).all()
    ]
    return float(np.sqrt(np.mean(squares))) if squares else None


def _against_reference(times: np.ndarray, poses: np.ndarray, known: Trajectory) -> Numbers:
    """Errors of poses (T, 3) after rigid alignment with a reference."""
    numbers = metrics.ate(times, poses, *known)
    i, j = metrics.match_times(times, known[0]).T
    frame = metrics.align(poses[i, :2], known[1][j, :2])
    turn = _seen_from(_seen_from(frame, known[1][j]), poses[i])[:, 2]
    numbers["heading_rmse_deg"] = float(np.degrees(np.sqrt(np.mean(turn**2))))
    return numbers


def _against_relations(
    recording: Recording, poses: np.ndarray, verified: relations_file.Relations
) -> Numbers:
    """Errors of poses (T, 3) in verified relative poses."""
    wheels = recording.wheel_times, recording.wheel_poses
    return {"relations": metrics.relations_error(recording.times, poses, *wheels, verified)}


def _beside(
    times: np.ndarray, poses: np.ndarray, known: Trajectory
) -> tuple[np.ndarray, np.ndarray]:
    """A reference, aligned with poses (T, 3), and their error since the start.

    Returns:
        The reference (K, 3) in the frame of the map, aligned as a whole, and the errors (T, 3)
        to the reference laid on the first pose they share, NaN where it has none.
    """
    i, j = metrics.match_times(times, known[0]).T
    frame = metrics.align(poses[i, :2], known[1][j, :2])
    zero = np.zeros(3)
    first = _seen_from(_seen_from(known[1][j[0]], zero), _seen_from(poses[i[0]], zero))
    error = np.full(poses.shape, np.nan)
    error[i] = _error(poses[i], _seen_from(first, known[1][j]))
    return _seen_from(frame, known[1][j]), error


def _write(place: Path, numbers: Numbers, times: np.ndarray, survey: Survey) -> None:
    """Write the files of numbers that every command has."""
    write_json(place / "metrics.json", numbers)
    tum.write(place / "trajectory.tum", times, _poses(survey))
    _write_map(place / "map.geojson", survey.graph)


def _write_map(path: Path, graph: Graph) -> None:
    """Write a topological map."""
    nodes = [
        geojson.Node(int(id), float(x), float(y), KINDS[kind], float(c) if kind == NODE else np.nan)
        for id, (x, y), kind, c in zip(*graph[:2], graph.kind, graph.clearance, strict=True)
    ]
    arcs = [
        geojson.Arc(
            k,
            int(graph.id[a]),
            int(graph.id[b]),
            float(graph.length[k]),
            float(graph.arc_clearance[k]),
            np.stack([graph.xy[a], graph.via[k], graph.xy[b]]),
        )
        for k, (a, b) in enumerate(graph.pairs)
    ]
    geojson.write(path, nodes, arcs)


def _draw(
    place: Path,
    config: Config,
    survey: Survey,
    lines: dict[str, np.ndarray],
    error: np.ndarray | None,
    *,
    world: World | None = None,
    scans: Scan | None = None,
) -> None:
    """Draw path.png and errors.png.

    Args:
        place: Folder to write to.
        config: Of the survey.
        survey: What to draw.
        lines: Trajectories (N, 3) beside the estimate, by the names in `plot.LINES`.
        error: (T, 3) errors, if they are known.
        world: Walls to draw.
        scans: Scans [T] to draw.
    """
    from jaxslam import plot  # matplotlib takes its time to load

    poses = _poses(survey)
    walls = [] if world is None else [np.reshape(world.walls, (-1, 2))]
    shown = [poses, survey.graph.xy, *lines.values(), *walls]
    figure, axis = plot.plan(*plot.extent(*shown))
    if world is not None:
        plot.walls(axis, world)
    if scans is not None:
        ends = jax.vmap(lidar.points, in_axes=(0, None))(scans, config.lidar)
        plot.echoes(axis, poses, np.asarray(ends), np.asarray(scans.hit))
    for what, line in (lines | {"estimate": poses}).items():
        plot.trajectory(axis, line, what)
    plot.arcs(axis, survey.graph)
    plot.landmarks(axis, survey.belief, confirm=config.confirm)
    plot.ends(axis, poses)
    plot.legend(figure)
    figure.savefig(place / "path.png")

    figure, axes = plot.canvas(9.0, 6.0, 3)
    plot.errors(axes[:, 0], np.asarray(survey.info.pose_cov), error)
    figure.savefig(place / "errors.png")


ROWS = (
    ("position_rmse_m", "position RMSE", "m"),
    ("heading_rmse_deg", "heading RMSE", "deg"),
    ("ate_rmse_m", "position RMSE, aligned", "m"),
    ("translation_mean_m", "error of relations", "m"),
    ("rotation_mean_deg", "error of relations", "deg"),
)


def _tell(numbers: Numbers, title: str, out: Path) -> None:
    """Print a summary of what `metrics.json` holds."""
    print(f"\n{title}; a way of {numbers['path_length_m']:.0f} m")
    if numbers.get("skipped_lines"):
        print(f"{numbers['skipped_lines']} broken lines of the log were skipped")
    blind = numbers.get("dead_reckoning", {})
    slam_has, wheels_have = (
        numbers | numbers.get("relations", {}),
        blind | blind.get("relations", {}),
    )
    if blind:
        print(f"{'':32}{'SLAM':>10}{'odometry':>10}{'ratio':>8}")
    for key, name, unit in ROWS:
        if key in slam_has and slam_has[key] is not None:
            line = f"  {f'{name} [{unit}]':30}{slam_has[key]:10.3f}"
            if key in wheels_have:
                ratio = wheels_have[key] / slam_has[key] if slam_has[key] else np.inf
                line += f"{wheels_have[key]:10.3f}{ratio:8.1f}"
            print(line)
    if "diverged" in numbers:
        print(f"  {'diverged runs':30}{numbers['diverged']:10d}{blind['diverged']:10d}")
    if numbers.get("nees") is not None:
        print(f"  {'NEES / 3, about 1 if consistent':30}{numbers['nees']:9.3f}")
    print(f"  {'landmarks':30}{numbers['landmarks']:10.0f}")
    print(f"  {'matches a scan':30}{numbers['matches']:10.1f}")
    seconds = numbers["seconds"]
    print(f"  {'seconds':30}{seconds['run']:10.1f}, and {seconds['compile']:.1f} to compile")
    print(f"results: {out}{os.sep}metrics.json, path.png, errors.png, map.geojson, ...")
