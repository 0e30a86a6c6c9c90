"""What `jaxslam tune` works on: simulated drives, laser logs, landmark logs.

A task is checked and its files are read first; only then do its episodes cost time.
"""

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxslam.cli import calibrated_logs
from jaxslam.cli.log_options import ScannerOptions, read_params, require_odometry
from jaxslam.cli.options import name_errors
from jaxslam.core import time_series
from jaxslam.core.batching import on_device
from jaxslam.core.episode import Episode
from jaxslam.evaluation.log_errors import Trajectory
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import mrclam, tum
from jaxslam.io.calibration_file import RobotCalibration
from jaxslam.io.errors import InputError
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.stacking import stack_episodes
from jaxslam.simulation import drives, named_worlds, trial_episodes
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World
from jaxslam.tuning import losses
from jaxslam.tuning.losses import Loss

MISREAD_DOF = 4.0  # degrees of freedom of innovations of a sensor that misreads landmarks


class TuneJob(NamedTuple):
    """A tuning with its episodes.

    Attributes:
        config: Configuration of the filter.
        params: Initial noise parameters.
        train: [B] episodes to tune on.
        test: [H] held-out episodes to evaluate on; None: evaluate on `train`.
        title: Title of the summary.
        robot: Its calibration, if that was asked for.
    """

    config: Config
    params: NoiseParams
    train: Episode
    test: Episode | None
    title: str
    robot: RobotCalibration | None = None


class TuneTask(NamedTuple):
    """A tuning whose options and files are checked.

    Attributes:
        params: Initial noise parameters.
        load: Makes the episodes, which takes its time.
    """

    params: NoiseParams
    load: Callable[[], TuneJob]


class _LogFiles(NamedTuple):
    """Logs that are read and checked, but not yet turned into episodes.

    Attributes:
        config: Configuration of the filter.
        params: Initial noise parameters.
        train: Functions that make an episode each, to tune on.
        test: Likewise, held out.
        no_reference: Paths of logs without a reference.
        advice: Advice for these.
        calibrate: Calibrates the robot of the logs, whose episodes then follow from it, which takes
            its time; None if that was not asked for.
    """

    config: Config
    params: NoiseParams
    train: Sequence[Callable[[], Episode]]
    test: Sequence[Callable[[], Episode]]
    no_reference: Sequence[Path]
    advice: str
    calibrate: Callable[[], RobotCalibration] | None = None


def simulated_task(
    world: str, num_trials: int, num_heldout: int, noise: Path | None, seed: int
) -> TuneTask:
    """Check the options of a tuning on simulated trials."""
    with name_errors("--world"):
        walls = World(on_device(named_worlds.named(world).walls))
        path = on_device(named_worlds.named_path(world))
    params = read_params(noise, NoiseParams.for_laser_log())

    def load() -> TuneJob:
        config, robot = Config(), Robot()
        num_scans = drives.num_scans_of_drive(robot, path)
        total = num_trials + num_heldout
        print(f"simulating {total} trials of {num_scans} scans, world {world}", flush=True)
        simulated = trial_episodes.simulate_episodes(
            jax.random.key(seed),
            config,
            robot,
            walls,
            path,
            num_trials=total,
            num_scans=num_scans,
        )
        train = jax.tree.map(lambda leaf: np.asarray(leaf)[:num_trials], simulated)
        test = jax.tree.map(lambda leaf: np.asarray(leaf)[num_trials:total], simulated)
        title = f"{num_trials} simulated trials, world {world}"
        return TuneJob(config, params, train, test if num_heldout else None, title)

    return TuneTask(params, load)


def recorded_task(
    logs: Sequence[Path],
    test: Sequence[Path],
    reference: Sequence[Path],
    noise: Path | None,
    *,
    match_scans: bool,
    loss: Loss,
    scanner: ScannerOptions = ScannerOptions(),  # noqa: B008
    calibrate: bool = False,
) -> TuneTask:
    """Read and check all files of a tuning on logs."""
    robots = {path: mrclam_robots(path) for path in (*logs, *test)}
    if len({found is None for found in robots.values()}) > 1:
        raise InputError("laser logs and MRCLAM data sets are tuned separately", field="LOG")
    if None not in robots.values():
        if reference:
            raise InputError("MRCLAM data sets contain theirs", field="--reference")
        if calibrate:
            raise InputError("MRCLAM data sets have no scans", field="--calibrate")
        files = _read_mrclam(
            [robot for path in logs for robot in robots[path] or ()],
            [robot for path in test for robot in robots[path] or ()],
            noise,
            heavy_tails=bool(losses.comparisons(loss)),
        )
    else:
        files = _read_laser_logs(
            logs,
            test,
            reference,
            noise,
            match_scans=match_scans,
            scanner=scanner,
            calibrate=calibrate,
        )
    if losses.needs_truth(loss) and files.no_reference:
        problem = f"has no reference, which the loss {losses.name_of(loss)} needs"
        raise InputError(problem, path=files.no_reference[0], advice=files.advice)

    def load() -> TuneJob:
        robot = None if files.calibrate is None else files.calibrate()
        train = [make_episode() for make_episode in files.train]
        heldout = [make_episode() for make_episode in files.test]
        count = f"{len(train)} log{'s' if len(train) > 1 else ''}"
        title = f"{count}, {sum(len(episode.truth) for episode in train)} steps"
        print(f"{title}; held out: {len(heldout)}", flush=True)
        width = max(episode.features.valid.shape[1] for episode in (*train, *heldout))
        train, heldout = ([_widened(x, width) for x in some] for some in (train, heldout))
        held_out = stack_episodes(heldout) if heldout else None
        return TuneJob(files.config, files.params, stack_episodes(train), held_out, title, robot)

    return TuneTask(files.params, load)


def _widened(episode: Episode, width: int) -> Episode:
    """An episode whose steps hold `width` features, the last of them padding."""
    missing = width - episode.features.valid.shape[1]
    if not missing:
        return episode

    def pad(x: Any, value: int = 0) -> Any:
        ends = [(0, 0), (0, missing)] + [(0, 0)] * (np.ndim(x) - 2)
        return np.pad(np.asarray(x), ends, constant_values=value)

    ids = episode.landmark_ids
    return episode._replace(
        features=jax.tree.map(pad, episode.features),
        landmark_ids=None if ids is None else pad(ids, -1),
    )


def _read_mrclam(
    train: Sequence[tuple[Path, int]],
    test: Sequence[tuple[Path, int]],
    noise: Path | None,
    *,
    heavy_tails: bool,
) -> _LogFiles:
    """Read robots (folder, number) of MRCLAM data sets.

    A camera misreads a barcode now and then, and no gate rejects it, as identities are given.
    Without truth nothing else bounds what it does: innovations have heavy tails then.
    """
    dof = MISREAD_DOF if heavy_tails and noise is None else None
    if dof is not None:
        print(
            f"note: innovations are Student t with {dof:g} degrees of freedom at first", flush=True
        )
    params = read_params(noise, NoiseParams.for_landmark_sensor(student_dof=dof))
    robots = [*train, *test]
    logs = [mrclam.read(path, robot) for path, robot in robots]
    no_reference = [
        path / f"Robot{robot}"
        for (path, robot), log in zip(robots, logs, strict=True)
        if not log.truth_mask.any()
    ]
    makers = [partial(episodes.episode_from_landmark_log, log) for log in logs]
    return _LogFiles(
        episodes.landmark_log_config(logs),
        params,
        makers[: len(train)],
        makers[len(train) :],
        no_reference,
        "use --loss innovation_nll",
    )


def _read_laser_logs(
    train: Sequence[Path],
    test: Sequence[Path],
    reference: Sequence[Path],
    noise: Path | None,
    *,
    match_scans: bool,
    scanner: ScannerOptions,
    calibrate: bool,
) -> _LogFiles:
    """Read laser logs of one scanner with their reference trajectories, if there are any."""
    params = read_params(noise, NoiseParams.for_laser_log(match_scans=match_scans))
    paths = [*train, *test]
    logs = [scanner.read_log(path) for path in paths]
    for path, log in zip(paths, logs, strict=True):
        if not match_scans:
            require_odometry(path, log)
        for note in log.notes:
            print(f"{path}: note: {note}", flush=True)
    if reference and len(reference) != len(logs):
        problem = f"{len(reference)} files for {len(logs)} logs"
        raise InputError(problem, field="--reference", advice="give one for each log, in order")
    references: list[Trajectory | None] = [_read_reference(path) for path in reference]
    for path, log in zip(paths, logs, strict=True):
        if log.lidar != logs[0].lidar:
            problem = f"has another scanner than {paths[0]}"
            raise InputError(problem, path=path, advice="tune them separately")
    with name_errors(str(paths[0])):
        config = episodes.laser_log_config(logs)
        config.check()
    for path, log, trajectory in zip(reference, logs, references, strict=False):
        if trajectory is None or not time_series.match_times(log.times, trajectory[0]).size:
            advice = "compare their clocks, and the order of --reference"
            raise InputError("has no pose at the time of a scan", path=path, advice=advice)

    def make_episode(path: Path, number: int, trajectory: Trajectory | None) -> Episode:
        with name_errors(str(path)):
            return episodes.episode_from_laser_log(
                config, logs[number], trajectory, match_scans=match_scans
            )

    def calibrate_logs() -> RobotCalibration:
        robot, logs[:] = calibrated_logs.tune_calibration(paths, logs, len(train))
        return robot

    if calibrate:
        calibrated_logs.check_same_robot(paths, logs)
    given = zip(paths, range(len(logs)), references or [None] * len(logs), strict=True)
    makers = [partial(make_episode, *of_one) for of_one in given]
    return _LogFiles(
        config,
        params,
        makers[: len(train)],
        makers[len(train) :],
        [] if reference else train,
        "give --reference, or use --loss innovation_nll",
        calibrate_logs if calibrate else None,
    )


def _read_reference(path: Path) -> Trajectory:
    """A reference trajectory, which must have headings."""
    trajectory, notes = tum.read_reference(path)
    if notes:
        advice = "give one with headings; the losses compare poses"
        raise InputError(notes[0], path=path, advice=advice)
    return trajectory


def mrclam_robots(path: Path) -> list[tuple[Path, int]] | None:
    """Folder and number of the MRCLAM robots that a path names; None if it is no such data set."""
    if (path / "Barcodes.dat").is_file():
        return [(path, robot) for robot in mrclam.robots(path)]
    match = re.fullmatch(r"Robot(\d+)(_\w+\.dat)?", path.name)
    if match and (path.parent / "Barcodes.dat").is_file():
        return [(path.parent, int(match[1]))]
    return None
