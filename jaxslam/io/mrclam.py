"""The UTIAS MRCLAM data sets: robots that know landmarks by their bar codes.

A folder holds these tables, in which `#` starts a comment line and N is the number of a robot:

    Barcodes.dat              subject barcode
    Landmark_Groundtruth.dat  subject x y x_std y_std
    RobotN_Odometry.dat       t v omega
    RobotN_Measurement.dat    t barcode range bearing
    RobotN_Groundtruth.dat    t x y heading

Subjects are robots and landmarks; those that Landmark_Groundtruth.dat places are the landmarks.

References:
    Leung, Halpern, Barfoot and Liu (2011), The UTIAS multi-robot cooperative localization and
    mapping dataset.
"""

from os import PathLike
from pathlib import Path

import numpy as np

from jaxslam.io.errors import InputError
from jaxslam.io.recording import Sightings
from jaxslam.io.text import table

HOLD = 1.1
"""Time [s] for which a velocity is held at most: where the log falls silent these robots roll on
as before, and stop by themselves after a second, when a line with zeros ends the silence."""

NEAR = 0.2
"""Time [s] between two reference poses up to which a pose between them is a reference too."""

_TICK = 1e-6
"""Time [s] that does not count: doubles tell 1e9 s to 2e-7 s."""

_FIELDS = {
    "Barcodes.dat": ("subject", "barcode"),
    "Landmark_Groundtruth.dat": ("subject", "x", "y", "x_std", "y_std"),
    "Odometry.dat": ("t", "v", "omega"),
    "Measurement.dat": ("t", "barcode", "range", "bearing"),
    "Groundtruth.dat": ("t", "x", "y", "heading"),
}


def robots(path: str | PathLike) -> list[int]:
    """Numbers N of the robots of a folder, those with a file `RobotN_Odometry.dat`.

    Args:
        path: Folder of a data set.

    Raises:
        InputError: It is no folder, or holds no such file.
    """
    path, advice = Path(path), "name the folder of an MRCLAM data set"
    if not path.is_dir():
        problem = "is no folder" if path.exists() else "does not exist"
        raise InputError(problem, path=path, advice=advice)
    numbers = [file.name[5:-13] for file in path.glob("Robot*_Odometry.dat")]
    found = sorted(int(n) for n in numbers if n.isdecimal() and n == str(int(n)))
    if not found:
        raise InputError("holds no RobotN_Odometry.dat", path=path, advice=advice)
    return found


def read(folder: str | PathLike, robot: int, *, longest: float = 1.0) -> Sightings:
    """Read the drive of one robot: a step for each time at which it sees landmarks.

    Left out are sightings of other robots, and steps before the first line of odometry, after
    the last, and before the first that has a reference. A velocity is held until the next line,
    so the robot drives along arcs; the turn of a motion is not wrapped.

    Args:
        folder: Folder of a data set; the robot's own reference may be missing.
        robot: Number of the robot, one of `robots`.
        longest: Time [s] between two steps above which steps without landmarks come between,
            so that noise that grows with distance and turn does not miss motion to and fro.

    Raises:
        InputError: The folder lacks the robot or a table, a table is broken or contradicts
            itself, the robot sees no landmark while it has odometry, or no step has a reference
            although there are reference poses.
    """
    if not longest >= 0.01:
        raise InputError(f"longest {longest} s", advice="give at least 0.01 seconds")
    folder, there = Path(folder), robots(folder)
    if robot not in there:
        advice = f"choose from {', '.join(map(str, there))}"
        raise InputError(f"has no robot {robot}", path=folder, advice=advice)
    names, places, barcodes = _landmarks(folder)
    odometry = _clocked(folder, f"Robot{robot}_Odometry.dat")
    seen, skipped = _measurements(folder, f"Robot{robot}_Measurement.dat", names, barcodes)
    seen = seen[(seen[:, 0] >= odometry[0, 0]) & (seen[:, 0] <= odometry[-1, 0])]
    if not seen.size:
        path, problem = (
            folder / f"Robot{robot}_Measurement.dat",
            "no landmark in the time of the odometry",
        )
        raise InputError(problem, path=path, advice="read another robot")
    times = _steps(np.unique(seen[:, 0]), longest)
    truth, referenced = _reference(folder, f"Robot{robot}_Groundtruth.dat", times)
    begin = int(np.argmax(referenced))
    times = times[begin:]
    polar, valid, which = _padded(seen[seen[:, 0] >= times[0]], times)
    return Sightings(
        times=times,
        motion=_motion(odometry, times),
        polar=polar,
        valid=valid,
        which=which,
        truth=truth[begin:],
        referenced=referenced[begin:],
        places=places,
        names=names,
        skipped=skipped,
    )


def _table(folder: Path, name: str, refuse: dict) -> np.ndarray:
    """Values (N, K) of a table; raise at the first line that is refused.

    Args:
        folder: Folder of the data set.
        name: Name of the file.
        refuse: For some fields what is wrong with a line, and a function that tells from the
            values (N,) of the field in which lines (N,) it is.
    """
    form = name if name in _FIELDS else name.partition("_")[2]
    lines, values = table(folder / name, _FIELDS[form], form)
    for field, (problem, bad) in refuse.items():
        broken = bad(values[:, _FIELDS[form].index(field)])
        if broken.any():
            where = {"path": folder / name, "line": int(lines[np.argmax(broken)])}
            raise InputError(problem, **where, field=field, advice="repair the line or remove it")
    return values


def _clocked(folder: Path, name: str, refuse: dict | None = None) -> np.ndarray:
    """Values (N, K) of a table whose times must not run backwards."""
    backwards = lambda t: np.diff(t, prepend=t[0]) < 0.0
    return _table(folder, name, {"t": ("runs backwards", backwards)} | (refuse or {}))


def _landmarks(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Subjects (L,) and places (L, 2) of the landmarks, and all (subject, barcode) (S, 2)."""
    odd = lambda ids: (ids != np.floor(ids)) | (np.abs(ids) >= 2**31)
    again = lambda ids: ~np.isin(np.arange(ids.size), np.unique(ids, return_index=True)[1])
    is_name = "is no whole number, or there twice", lambda ids: odd(ids) | again(ids)
    barcodes = _table(folder, "Barcodes.dat", {"subject": is_name, "barcode": is_name})
    landmarks = _table(folder, "Landmark_Groundtruth.dat", {"subject": is_name})
    return landmarks[:, 0].astype(np.int32), landmarks[:, 1:3].copy(), barcodes.astype(np.int64)


def _measurements(
    folder: Path, name: str, names: np.ndarray, barcodes: np.ndarray
) -> tuple[np.ndarray, int]:
    """Landmarks seen (N, 4), t number range bearing; how many more are of no robot either."""
    positive = "is not positive", lambda r: r <= 0.0
    values = _clocked(folder, name, {"range": positive})
    number = {subject: float(i) for i, subject in enumerate(names.tolist())}
    number = {float(code): number.get(subject, -1.0) for subject, code in barcodes.tolist()}
    values[:, 1] = [number.get(code, -2.0) for code in values[:, 1].tolist()]
    unknown = int((values[:, 1] == -2.0).sum())
    seen = values[values[:, 1] >= 0.0]
    first = np.unique(seen[:, :2], axis=0, return_index=True)[1]
    return seen[np.sort(first)], unknown + len(seen) - len(first)


def _steps(times: np.ndarray, longest: float) -> np.ndarray:
    """All `times`, which grow, and others evenly between those more than `longest` apart."""
    gaps = np.diff(times)
    parts = np.maximum(np.ceil((gaps - _TICK) / longest), 1.0).astype(int)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    between = np.repeat(times[:-1], parts) + part * np.repeat(gaps / parts, parts)
    return np.append(between, times[-1])


def _motion(odometry: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Motions (T, 3) since the time before, by velocities (N, 3) t v omega; the first is zero.

    Over a time h the robot rolls v h and turns by omega h. The chord of this arc points along
    half of the turn and is shorter than the arc by sin(turn / 2) / (turn / 2).
    """

    def roll(pose: np.ndarray, line: np.ndarray, h: np.ndarray) -> np.ndarray:
        h = np.minimum(h, HOLD)
        turn = line[:, 2] * h
        chord = line[:, 1] * h * np.sinc(turn / (2 * np.pi))
        middle = pose[:, 2] + turn / 2
        return np.column_stack([chord * np.cos(middle), chord * np.sin(middle), turn])

    h = np.diff(odometry[:, 0])
    poses = np.zeros_like(odometry)
    poses[1:, 2] = np.cumsum(odometry[:-1, 2] * np.minimum(h, HOLD))
    poses[1:, :2] = np.cumsum(roll(poses[:-1], odometry[:-1], h)[:, :2], axis=0)
    last = np.searchsorted(odometry[:, 0], times, side="right") - 1
    poses = poses[last] + roll(poses[last], odometry[last], times - odometry[last, 0])
    step = np.diff(poses, axis=0, prepend=poses[:1])
    before = np.append(poses[:1, 2], poses[:-1, 2])
    c, s = np.cos(before), np.sin(before)
    x, y, turn = step.T
    return np.column_stack([c * x + s * y, c * y - s * x, turn])


def _reference(folder: Path, name: str, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (T, 3) between those of the file, zero if there are none; where there are (T,)."""
    if not (folder / name).exists():
        return np.zeros((times.size, 3)), np.zeros(times.size, bool)
    values = _clocked(folder, name)
    t, x, y, heading = values.T
    before = np.searchsorted(t, times, side="right") - 1
    after = np.searchsorted(t, times, side="left")
    inside = (before >= 0) & (after < t.size)
    referenced = inside & (t[after % t.size] - t[before] <= NEAR + _TICK)
    if not referenced.any():
        problem = "has no pose at any time at which the robot sees landmarks"
        raise InputError(problem, path=folder / name, advice="repair its times or remove it")
    poses = [np.interp(times, t, values) for values in (x, y, np.unwrap(heading))]
    poses[2] = (poses[2] + np.pi) % (2 * np.pi) - np.pi
    return np.where(referenced[:, None], np.column_stack(poses), 0.0), referenced


def _padded(seen: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Polar form (T, M, 2), valid (T, M) and landmark (T, M) of what is seen (N, 4) when."""
    step = np.searchsorted(times, seen[:, 0])
    slot = np.arange(step.size) - np.searchsorted(step, step)
    shape = times.size, int(slot.max()) + 1
    polar, valid = np.zeros((*shape, 2), np.float32), np.zeros(shape, bool)
    which = np.full(shape, -1, np.int32)
    polar[step, slot], valid[step, slot], which[step, slot] = seen[:, 2:], True, seen[:, 1]
    return polar, valid, which
