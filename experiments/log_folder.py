"""Recorded logs of a folder, with the references for their trajectories."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxslam.core.logs import LaserLog, Relations
from jaxslam.core.time_series import match_times
from jaxslam.evaluation.log_errors import Trajectory
from jaxslam.io import readers, relations, tum
from jaxslam.io.errors import InputError

SUFFIXES = (".clf", ".log", ".gz", ".g2o", ".zip", ".bag", ".npz")
SAME_TIME = 2e-3  # [s] between the time of a relation and that of its scan


class Log(NamedTuple):
    """A log, and the references for its trajectory.

    Attributes:
        name: Of its file, without suffixes; several files may share it.
        folder: Of its file.
        laser_log: Scans and odometry.
        reference: Reference trajectory, if there is one.
        relations: Verified relative poses, if there are any.
    """

    name: str
    folder: Path
    laser_log: LaserLog
    reference: Trajectory | None
    relations: Relations | None


def checked_folder(name: str) -> Path | None:
    """The folder of this name; None if it is empty.

    Raises:
        InputError: It is no folder.
    """
    if not name:
        return None
    if not Path(name).is_dir():
        raise InputError("is no folder", path=name, advice="name the folder of the logs")
    return Path(name)


def find_logs(folder: Path | None, *, installed: bool = True) -> list[Log]:
    """The logs of a folder, in the order of their paths, and those of installed packages.

    The references of `NAME.clf` are `NAME.reference.tum` and `NAME.relations` beside it, or in
    another folder if scans of the log were taken at all their times.

    Args:
        folder: Is searched with all folders in it; None for none.
        installed: Whether logs of packages are wanted; those that are missing are named.

    Raises:
        InputError: A log or a reference cannot be read.
    """
    files = sorted(folder.rglob("*")) if folder else []
    paths = [(path.name.split(".")[0], path) for path in files if is_log(path)]
    for name in readers.NAMED_LOGS if installed else ():
        try:
            paths.append((name, readers.find_log(name)))
        except InputError as error:
            print(f"left out: {error}")
    return [_read(name, path, files) for name, path in paths]


def with_reference(name: str, max_scans: int) -> dict[str, Log]:
    """The logs of a folder that have a reference and few scans, by unique names.

    Args:
        name: Of the folder, as it was given.
        max_scans: Of a log.

    Raises:
        InputError: There is no such folder, or no such log.
    """
    logs = find_logs(checked_folder(name), installed=False)
    chosen = {
        own: log
        for own, log in zip(unique_names(logs), logs, strict=True)
        if log.reference is not None and len(log.laser_log.times) <= max_scans
    }
    if not chosen:
        raise InputError(
            f"no log with a reference trajectory and at most {max_scans} scans",
            advice="name a folder of such logs",
        )
    return chosen


def is_log(path: Path) -> bool:
    """Whether a path is a log by its suffix, or the folder of a bag."""
    return path.suffix in SUFFIXES or (path / "metadata.yaml").is_file()


def _read(name: str, path: Path, files: list[Path]) -> Log:
    laser_log, packaged = readers.read_log(path), name in readers.NAMED_LOGS

    def references(ending: str) -> list[tuple[bool, Path]]:
        """Whether they belong to the log by their place, and paths of possible references."""
        own = [file for file in files if file.name == f"{name}{ending}"]
        if packaged:
            own = [file for file in files if file.name.endswith(f"{name}{ending}")]
        beside = [(packaged or file.parent == path.parent, file) for file in own]
        return sorted(beside, key=lambda one: not one[0])

    reference, pairs = None, None
    for belongs, file in references(".reference.tum"):
        found = tum.read(file)
        if belongs or len(match_times(laser_log.times, found[0])) == len(found[0]):
            reference = found
            break
    for belongs, file in references(".relations"):
        known = relations.read(file)
        if belongs or has_scans_at(laser_log.times, known):
            pairs = known
            break
    return Log(name, path.parent, laser_log, reference, pairs)


def nearest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Indices (K,) of those of the times (T,) that are nearest to the wanted ones (K,)."""
    order = np.argsort(times, kind="stable")
    after = np.searchsorted(times[order], wanted).clip(0, len(times) - 1)
    both = np.stack([order[(after - 1).clip(0)], order[after]])
    closest = np.argmin(np.abs(times[both] - wanted), axis=0)
    return both[closest, np.arange(len(wanted))]


def has_scans_at(times: np.ndarray, pairs: Relations) -> bool:
    """Whether there is a scan, of times (T,) [s], at all times of the relations."""
    wanted = np.concatenate([pairs.t1, pairs.t2])
    return bool((np.abs(times[nearest(times, wanted)] - wanted) < SAME_TIME).all())


def at_scans(times: np.ndarray, pairs: Relations) -> Relations:
    """The relations between scans, of times (T,) [s], with exactly the times of these."""
    first, second = nearest(times, pairs.t1), nearest(times, pairs.t2)
    gap = np.maximum(np.abs(times[first] - pairs.t1), np.abs(times[second] - pairs.t2))
    used = gap < SAME_TIME
    return Relations(times[first][used], times[second][used], pairs.relative_pose[used])


def unique_names(logs: list[Log]) -> list[str]:
    """Names of the logs; where several share one, the folder's stands before it."""
    names = [log.name for log in logs]
    several = [
        f"{log.folder.name}-{log.name}" if names.count(log.name) > 1 else log.name for log in logs
    ]
    return [
        name if several.count(name) == 1 else f"{name}-{several[:k].count(name) + 1}"
        for k, name in enumerate(several)
    ]
