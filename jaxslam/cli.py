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
from jaxslam.io import carmen, geojson, relations, tum
from jaxslam.io import noise as noise_file
from jaxslam.io.errors import InputError
from jaxslam.io.output import folder, write_json
from jaxslam.io.recording import Recording
from jaxslam.monte_carlo import Track
from jaxslam.motion import Robot
from jaxslam.slam import Config, Noise, Survey
from jaxslam.topomap import Graph
from jaxslam.types import NODE

KINDS = ("node", "corner", "wall")
ABOUT = """Topological SLAM for a robot with a 2-D laser scanner.

Every command writes its results to the folder --out; `jaxslam COMMAND --help` lists its
options, `jaxslam --version` prints the version."""

Numbers = dict[str, Any]
"""What `metrics.json` holds."""


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 2 for bad input, 130 for Ctrl-C."""
    argv = sys.argv[1:] if argv is None else argv
    if "--version" in argv[:1]:
        print(f"jaxslam {jaxslam.__version__}")
        return 0
    commands = {"simulate": simulate, "run": run}
    try:
        tyro.extras.subcommand_cli_from_dict(
            commands, prog="jaxslam", description=ABOUT, args=argv or ["--help"]
        )
    except InputError as error:
        print(f"jaxslam: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxslam: interrupted; nothing was written", file=sys.stderr)
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

    Writes metrics.json (over all runs), trajectory.tum, truth.tum, map.geojson, path.png and
    errors.png (of run 0; its time stamps count the scans).

    Args:
        world: World with a drive: office.
        runs: How many times.
        seed: Of the wheels' and the lidar's noise.
        noise: File with the noise the filter assumes; by default the robot's own.
        landmarks: All kinds, or the paper's nodes alone.
        labels: What the cells of walls are told apart by: straight runs, or the paper's codes.
        out: Folder for the results.
    """
    _at_least("--runs", runs, 1)
    _at_least("--seed", seed, 0)
    with _named("--world"):
        walls = jnp.asarray(worlds.named(world).walls, float)
        path = jnp.asarray(plan.densify(worlds.drive(world)), float)
    assumed = _noise(noise, slam.wheel_noise(Robot()))
    config = Config(labels=labels)
    config = config._replace(kinds=(NODE,)) if landmarks == "nodes" else config
    where = (jax.random.key(seed), config, assumed, worlds.World(walls), Robot(), path)
    with folder(out) as place:
        _keep_compiled()
        steps = monte_carlo.drive_steps(Robot(), path)
        with _stopwatch() as seconds:
            tracks = _watch(monte_carlo.experiment(*where, runs=runs, steps=steps), runs)
        numbers = monte_carlo.evaluate(tracks) | {
            "path_length_m": float(np.mean([_length(way) for way in tracks.truth])),
            "ate_rmse_m": _aligned_error(tracks),
            "seconds": seconds,
        }
        print("mapping run 0 and drawing it ...", flush=True)
        truth, survey = monte_carlo.replay(*where, run=0, steps=steps)
        truth = np.asarray(truth, np.float64)
        _write(place, numbers, np.arange(steps, dtype=float), survey)
        tum.write(place / "truth.tum", np.arange(steps, dtype=float), truth)
        error = np.asarray(metrics.pose_error(survey.info.pose, jnp.asarray(truth, float)))
        lines = {"odometry": tracks.odometry[0], "truth": truth}
        _draw(place, config, survey, lines, error, world=worlds.World(np.asarray(walls)))
    print(_told(numbers, f"{runs} runs of {steps} scans in the world {world}"))
    print(f"results: {_listed(out, 'truth.tum')}")


def run(
    log: Annotated[Path, tyro.conf.Positional],
    reference: Path | None = None,
    relations: Path | None = None,
    noise: Path | None = None,
    out: Path = Path("out"),
) -> None:
    """Run SLAM on a recorded log.

    Writes metrics.json, trajectory.tum, map.geojson, path.png and errors.png; the map's frame is
    the pose of the first scan.

    Args:
        log: CARMEN log with FLASER lines, plain or gzipped.
        reference: Trajectory in TUM format to compare with, on the log's clock.
        relations: Verified relative poses to compare with, on the log's clock.
        noise: File with the noise the filter assumes; by default a cautious one.
        out: Folder for the results.
    """
    recording = carmen.read(log)
    told = None if reference is None else tum.read(reference)
    pairs = None if relations is None else _read_relations(relations)
    config = Config(lidar=recording.lidar, landmarks=256)
    assumed = _noise(noise, slam.log_noise())
    wheels = _seen_from(recording.odometry[0], recording.odometry)
    steps = np.concatenate([np.zeros((1, 3)), _seen_from(wheels[:-1], wheels[1:])])
    scans = lidar.limit(jnp.asarray(recording.ranges, float), config.lidar)
    with folder(out) as place:
        _keep_compiled()
        print(f"{len(steps)} scans of {config.lidar.beams} beams ...", flush=True)
        with _stopwatch() as seconds:
            start = jnp.zeros(3)
            survey = slam.survey(config, assumed, start, jnp.asarray(steps, float), scans)
            poses = np.asarray(survey.info.pose, np.float64)
        numbers = {
            "scans": len(poses),
            "skipped_lines": recording.skipped,
            "path_length_m": _length(wheels),
            "landmarks": int(np.sum(np.asarray(survey.belief.seen) >= config.confirm)),
            "matches": float(np.mean(np.sum(np.asarray(survey.info.used), axis=1))),
            "seconds": seconds,
            **_compare(recording, poses, told, pairs, reference, relations),
        }
        if told is not None or pairs is not None:
            blind = _compare(recording, wheels, told, pairs, reference, relations)
            numbers["dead_reckoning"] = blind
        _write(place, numbers, recording.times, survey)
        lines, error = {"odometry": wheels}, None
        if told is not None:
            lines["reference"] = _aligned(recording.times, poses, *told)[2]
            error = _error_since_start(recording.times, poses, *told)
        _draw(place, config, survey, lines, error, scans=scans)
    print(_told(numbers, f"{len(poses)} scans of {log}"))
    print(f"results: {_listed(out)}")


def _read_relations(path: Path) -> relations.Relations:
    return relations.read(path)


def _at_least(option: str, value: int, least: int) -> None:
    """Raise unless an option's value is large enough."""
    if value < least:
        raise InputError(f"{value} is less than {least}", field=option)


@contextmanager
def _named(option: str) -> Iterator[None]:
    """Turn a ValueError of the block into an InputError that names an option or file."""
    try:
        yield
    except InputError:
        raise
    except ValueError as error:
        raise InputError(str(error), field=option) from None


def _noise(path: Path | None, default: Noise) -> Noise:
    """Noise in a file, or the default without one."""
    return default if path is None else noise_file.read(path, default)
