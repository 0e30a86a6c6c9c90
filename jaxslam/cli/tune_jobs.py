"""What `jaxslam tune` works on: simulated drives, laser logs, landmark logs."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.cli.options import name_errors, read_params
from jaxslam.cli.tune_command import _name
from jaxslam.core import time_series
from jaxslam.core.episode import Episode
from jaxslam.evaluation.log_errors import Trajectory
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import mrclam, readers, tum
from jaxslam.io.errors import InputError
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import drives, path_following, trials, worlds
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World
from jaxslam.tuning import losses
from jaxslam.tuning.losses import Loss


class TuneJob(NamedTuple):
    """A tuning task.

    Attributes:
        config: Configuration of the filter.
        noise: Initial noise parameters.
        train: [B] runs to tune on.
        test: [H] held-out runs to evaluate on; None: evaluate on `train`.
        title: Title of the summary.
    """

    config: Config
    noise: NoiseParams
    train: Episode
    test: Episode | None
    title: str


class _LogFiles(NamedTuple):
    """Logs that are read and checked, but not yet turned into runs."""

    config: Config
    noise: NoiseParams  # initial
    train: Sequence[Any]
    test: Sequence[Any]
    to_run: Callable[[Any], Episode]  # of one of `train` or `test`
    no_reference: Sequence[Path]  # paths of logs without a reference
    advice: str  # for them


def simulated_job(
    world: str, runs: int, heldout: int, noise: Path | None, seed: int
) -> Callable[[], TuneJob]:
    """Check the options, and return a function that simulates the runs of the job."""
    with name_errors("--world"):
        walls = World(jnp.asarray(worlds.named(world).walls, float))
        path = jnp.asarray(path_following.densify(worlds.waypoints(world)), float)
    initial = read_params(noise, NoiseParams.for_laser_log())

    def make_job() -> TuneJob:
        config, robot = Config(), Robot()
        steps = drives.num_scans_of_drive(robot, path)
        total = runs + heldout
        print(f"simulating {total} runs of {steps} scans, world {world}", flush=True)
        logs = trials.simulate_episodes(
            jax.random.key(seed), config, robot, walls, path, num_trials=total, num_scans=steps
        )
        train = jax.tree.map(lambda leaf: np.asarray(leaf)[:runs], logs)
        test = jax.tree.map(lambda leaf: np.asarray(leaf)[runs:total], logs)
        title = f"{runs} simulated runs, world {world}"
        return TuneJob(config, initial, train, test if heldout else None, title)

    return make_job


def recorded_job(
    logs: Sequence[Path],
    test: Sequence[Path],
    reference: Sequence[Path],
    aligned: bool,
    noise: Path | None,
    loss: Loss,
) -> Callable[[], TuneJob]:
    """Read and check all files, and return a function that turns them into the runs of the job."""
    robots = {path: mrclam_robots(path) for path in (*logs, *test)}
    is_mrclam = {found is not None for found in robots.values()}
    if len(is_mrclam) > 1:
        raise InputError("laser logs and MRCLAM data sets are tuned separately", field="LOG")
    if is_mrclam == {True}:
        if reference:
            raise InputError("MRCLAM data sets contain theirs", field="--reference")
        files = _read_mrclam(
            [robot for path in logs for robot in robots[path]],
            [robot for path in test for robot in robots[path]],
            noise,
        )
    else:
        files = _read_laser_logs(logs, test, reference, aligned, noise)
    if losses.needs_truth(loss) and files.no_reference:
        problem = f"has no reference, which the loss {_name(loss)} needs"
        raise InputError(problem, path=files.no_reference[0], advice=files.advice)

    def make_job() -> TuneJob:
        train = [files.to_run(log) for log in files.train]
        held_out = [files.to_run(log) for log in files.test]
        count = f"{len(train)} log{'s' if len(train) > 1 else ''}"
        title = f"{count}, {sum(len(run.truth) for run in train)} steps"
        print(f"{title}; held out: {len(held_out)}", flush=True)
        held_out = episodes.stack_episodes(held_out) if held_out else None
        return TuneJob(files.config, files.noise, episodes.stack_episodes(train), held_out, title)

    return make_job


def _read_mrclam(
    train: Sequence[tuple[Path, int]], test: Sequence[tuple[Path, int]], noise: Path | None
) -> _LogFiles:
    """Read robots (folder, number) of MRCLAM data sets."""
    initial = read_params(noise, NoiseParams.for_landmark_sensor())
    robots = [*train, *test]
    read = [mrclam.read(path, robot) for path, robot in robots]
    no_reference = [
        path / f"Robot{robot}"
        for (path, robot), log in zip(robots, read, strict=True)
        if not log.truth_mask.any()
    ]
    return _LogFiles(
        episodes.landmark_log_config(read),
        initial,
        read[: len(train)],
        read[len(train) :],
        episodes.episode_from_landmark_log,
        no_reference,
        "use --loss likelihood",
    )


def _read_laser_logs(
    train: Sequence[Path],
    test: Sequence[Path],
    reference: Sequence[Path],
    aligned: bool,
    noise: Path | None,
) -> _LogFiles:
    """Read laser logs of one scanner with their reference trajectories, if there are any."""
    initial = read_params(noise, NoiseParams.for_laser_log(match_scans=aligned))
    paths = [*train, *test]
    read = [readers.read(path) for path in paths]
    if reference and len(reference) != len(read):
        problem = f"{len(reference)} files for {len(read)} logs"
        raise InputError(problem, field="--reference", advice="give one for each log, in order")
    references = [tum.read(path) for path in reference] or [None] * len(read)
    for path, log in zip(paths, read, strict=True):
        if log.lidar != read[0].lidar:
            problem = f"has another scanner than {paths[0]}"
            raise InputError(problem, path=path, advice="tune them separately")
    config = episodes.laser_log_config(read)
    for path, log, trajectory in zip(reference, read, references, strict=False):
        if not time_series.match_times(log.times, trajectory[0]).size:
            advice = "compare their clocks, and the order of --reference"
            raise InputError("has no pose at the time of a scan", path=path, advice=advice)

    def to_run(pair: tuple[Any, Trajectory | None]) -> Episode:
        log, trajectory = pair
        return episodes.episode_from_laser_log(config, log, trajectory, match_scans=aligned)

    pairs = list(zip(read, references, strict=True))
    return _LogFiles(
        config,
        initial,
        pairs[: len(train)],
        pairs[len(train) :],
        to_run,
        [] if reference else train,
        "give --reference, or use --loss likelihood",
    )


def mrclam_robots(path: Path) -> list[tuple[Path, int]] | None:
    """Folder and number of the MRCLAM robots that a path names; None if it is no such data set."""
    if (path / "Barcodes.dat").is_file():
        return [(path, robot) for robot in mrclam.robots(path)]
    match = re.fullmatch(r"Robot(\d+)(_\w+\.dat)?", path.name)
    if match and (path.parent / "Barcodes.dat").is_file():
        return [(path.parent, int(match[1]))]
    return None
