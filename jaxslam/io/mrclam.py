"""The UTIAS MRCLAM data sets: robots that observe landmarks with known IDs (bar codes).

A folder holds these tables, in which `#` starts a comment line and N is the number of a robot:

    Barcodes.dat              subject barcode
    Landmark_Groundtruth.dat  subject x y x_std y_std
    RobotN_Odometry.dat       t v omega
    RobotN_Measurement.dat    t barcode range bearing
    RobotN_Groundtruth.dat    t x y heading

Subjects are robots and landmarks; those listed in Landmark_Groundtruth.dat are the landmarks.

References:
    Leung, Halpern, Barfoot and Liu (2011), The UTIAS multi-robot cooperative localization and
    mapping dataset.
"""

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path

import numpy as np

from jaxslam.core.logs import LandmarkLog
from jaxslam.io.errors import InputError
from jaxslam.io.text import table

MAX_HOLD = 1.1
"""Longest time [s] for which a velocity is held. These robots keep their velocity through gaps of
the log, and stop by themselves after one second, when a line of zeros ends the gap."""

MAX_REFERENCE_GAP = 0.2
"""Longest gap [s] between two reference poses in which the reference is interpolated."""

_TIME_TOLERANCE = 1e-6
"""Time [s] below any that matters: float64 resolves 1e9 s to 2e-7 s."""

_FIELDS = {
    "Barcodes.dat": ("subject", "barcode"),
    "Landmark_Groundtruth.dat": ("subject", "x", "y", "x_std", "y_std"),
    "Odometry.dat": ("t", "v", "omega"),
    "Measurement.dat": ("t", "barcode", "range", "bearing"),
    "Groundtruth.dat": ("t", "x", "y", "heading"),
}

_Check = tuple[str, Callable[[np.ndarray], np.ndarray]]
"""What is wrong with a line, and a function of the values (N,) of a field: True (N,) where it is
wrong."""


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
    names = [file.name[5:-13] for file in path.glob("Robot*_Odometry.dat")]
    found = sorted(int(name) for name in names if name.isdecimal() and name == str(int(name)))
    if not found:
        raise InputError("holds no RobotN_Odometry.dat", path=path, advice=advice)
    return found


def read(folder: str | PathLike, robot: int, *, max_gap: float = 1.0) -> LandmarkLog:
    """Read the log of one robot: a step for each time at which it observes landmarks.

    Left out are measurements of other robots, and steps before the first line of odometry, after
    the last, and before the first that has a reference. A velocity is held until the next line,
    so the robot drives along circular arcs; the turn of an odometry increment is not wrapped.

    Args:
        folder: Folder of a data set; the robot's own reference may be missing.
        robot: Number of the robot, one of `robots`.
        max_gap: Longest time [s] between two steps: steps without landmarks are inserted in longer
            gaps, because motion noise that grows with distance and turn would otherwise miss
            motion forth and back.

    Raises:
        InputError: The folder lacks the robot or a table, a table is broken or contradicts
            itself, the robot observes no landmark while it has odometry, or no step has a
            reference although there are reference poses.
    """
    if not max_gap >= 0.01:
        raise InputError(f"longest {max_gap} s", advice="give at least 0.01 seconds")
    folder, available = Path(folder), robots(folder)
    if robot not in available:
        advice = f"choose from {', '.join(map(str, available))}"
        raise InputError(f"has no robot {robot}", path=folder, advice=advice)
    subjects, positions, barcodes = _landmarks(folder)
    odometry = _timed_table(folder, f"Robot{robot}_Odometry.dat")
    measured, skipped = _measurements(folder, f"Robot{robot}_Measurement.dat", subjects, barcodes)
    inside = (measured[:, 0] >= odometry[0, 0]) & (measured[:, 0] <= odometry[-1, 0])
    measured = measured[inside]
    if not measured.size:
        path = folder / f"Robot{robot}_Measurement.dat"
        problem = "no landmark is measured within the time of the odometry"
        raise InputError(problem, path=path, advice="read another robot")
    times = _step_times(np.unique(measured[:, 0]), max_gap)
    truth, has_truth = _reference(folder, f"Robot{robot}_Groundtruth.dat", times)
    first = int(np.argmax(has_truth))
    times = times[first:]
    polar, valid, landmark = _pad(measured[measured[:, 0] >= times[0]], times)
    return LandmarkLog(
        times=times,
        odometry=_odometry_increments(odometry, times),
        range_bearing=polar,
        valid=valid,
        landmark_index=landmark,
        truth=truth[first:],
        truth_mask=has_truth[first:],
        landmark_positions=positions,
        landmark_names=subjects,
        num_skipped=skipped,
    )


def _table(folder: Path, name: str, checks: Mapping[str, _Check]) -> np.ndarray:
    """Values (N, K) of a table; raise at the first line that fails a check.

    Args:
        folder: Folder of the data set.
        name: Name of the file.
        checks: Checks by the name of a field.
    """
    form = name if name in _FIELDS else name.partition("_")[2]
    lines, values = table(folder / name, _FIELDS[form], form)
    for field, (problem, is_wrong) in checks.items():
        wrong = is_wrong(values[:, _FIELDS[form].index(field)])
        if wrong.any():
            line = int(lines[np.argmax(wrong)])
            advice = "repair the line or remove it"
            raise InputError(problem, path=folder / name, line=line, field=field, advice=advice)
    return values


def _timed_table(folder: Path, name: str, checks: Mapping[str, _Check] | None = None) -> np.ndarray:
    """Values (N, K) of a table whose times must not decrease."""

    def decreases(times: np.ndarray) -> np.ndarray:
        return np.diff(times, prepend=times[0]) < 0.0

    return _table(folder, name, {"t": ("runs backwards", decreases)} | dict(checks or {}))


def _landmarks(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Subjects (L,), positions (L, 2) of the landmarks, and all (subject, barcode) (S, 2)."""

    def no_id(values: np.ndarray) -> np.ndarray:
        not_integer = (values != np.floor(values)) | (np.abs(values) >= 2**31)
        first = np.unique(values, return_index=True)[1]
        return not_integer | ~np.isin(np.arange(values.size), first)

    check = "is not an integer, or occurs twice", no_id
    barcodes = _table(folder, "Barcodes.dat", {"subject": check, "barcode": check})
    landmarks = _table(folder, "Landmark_Groundtruth.dat", {"subject": check})
    return landmarks[:, 0].astype(np.int32), landmarks[:, 1:3].copy(), barcodes.astype(np.int64)


def _measurements(
    folder: Path, name: str, subjects: np.ndarray, barcodes: np.ndarray
) -> tuple[np.ndarray, int]:
    """Landmark measurements (N, 4): t, landmark 0..L-1, range, bearing; and how many are skipped.

    Measurements of robots are dropped. Skipped are unknown bar codes, and repeated measurements of
    a landmark at the same time.
    """

    def not_positive(values: np.ndarray) -> np.ndarray:
        return values <= 0.0

    values = _timed_table(folder, name, {"range": ("is not positive", not_positive)})
    index_of_subject = {subject: float(index) for index, subject in enumerate(subjects.tolist())}
    index_of_barcode = {
        float(barcode): index_of_subject.get(subject, -1.0)
        for subject, barcode in barcodes.tolist()
    }
    values[:, 1] = [index_of_barcode.get(barcode, -2.0) for barcode in values[:, 1].tolist()]
    unknown = int((values[:, 1] == -2.0).sum())
    measured = values[values[:, 1] >= 0.0]
    first = np.unique(measured[:, :2], axis=0, return_index=True)[1]
    return measured[np.sort(first)], unknown + len(measured) - len(first)


def _step_times(times: np.ndarray, longest: float) -> np.ndarray:
    """All `times` (ascending), and evenly spaced ones in gaps longer than `longest`."""
    gaps = np.diff(times)
    parts = np.maximum(np.ceil((gaps - _TIME_TOLERANCE) / longest), 1.0).astype(int)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    between = np.repeat(times[:-1], parts) + part * np.repeat(gaps / parts, parts)
    return np.append(between, times[-1])


def _odometry_increments(odometry: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Odometry increments (T, 3) from velocities (N, 3) t v omega; the first is zero.

    Over a time h the robot drives an arc of length v h and turns by omega h. The chord of the arc
    points along half of the turn and is shorter than the arc by sin(turn / 2) / (turn / 2).
    """

    def displacements(poses: np.ndarray, lines: np.ndarray, duration: np.ndarray) -> np.ndarray:
        """Motions (K, 3), world frame, from poses (K, 3) at velocities (K, 3)."""
        duration = np.minimum(duration, MAX_HOLD)
        turn = lines[:, 2] * duration
        chord = lines[:, 1] * duration * np.sinc(turn / (2 * np.pi))
        middle = poses[:, 2] + turn / 2
        return np.column_stack([chord * np.cos(middle), chord * np.sin(middle), turn])

    # Dead reckoning: the poses at the lines, then at the times.
    durations = np.diff(odometry[:, 0])
    line_poses = np.zeros_like(odometry)
    line_poses[1:, 2] = np.cumsum(odometry[:-1, 2] * np.minimum(durations, MAX_HOLD))
    moves = displacements(line_poses[:-1], odometry[:-1], durations)
    line_poses[1:, :2] = np.cumsum(moves[:, :2], axis=0)
    last = np.searchsorted(odometry[:, 0], times, side="right") - 1
    since = times - odometry[last, 0]
    poses = line_poses[last] + displacements(line_poses[last], odometry[last], since)
    # Each increment in the frame of the pose before.
    x, y, turn = np.diff(poses, axis=0, prepend=poses[:1]).T
    heading = np.append(poses[:1, 2], poses[:-1, 2])
    c, s = np.cos(heading), np.sin(heading)
    return np.column_stack([c * x + s * y, c * y - s * x, turn])


def _reference(folder: Path, name: str, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reference poses (T, 3) at the times, interpolated, and where there is one (T,).

    Zero where there is none; all are if the file does not exist.
    """
    if not (folder / name).exists():
        return np.zeros((times.size, 3)), np.zeros(times.size, bool)
    values = _timed_table(folder, name)
    known_times, x, y, heading = values.T
    before = np.searchsorted(known_times, times, side="right") - 1
    after = np.searchsorted(known_times, times, side="left")
    inside = (before >= 0) & (after < known_times.size)
    gap = known_times[after % known_times.size] - known_times[before]
    has_truth = inside & (gap <= MAX_REFERENCE_GAP + _TIME_TOLERANCE)
    if not has_truth.any():
        problem = "has no pose at any time at which a landmark is measured"
        raise InputError(problem, path=folder / name, advice="repair its times or remove it")
    columns = [np.interp(times, known_times, column) for column in (x, y, np.unwrap(heading))]
    columns[2] = (columns[2] + np.pi) % (2 * np.pi) - np.pi
    return np.where(has_truth[:, None], np.column_stack(columns), 0.0), has_truth


def _pad(measured: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range and bearing (T, M, 2), valid (T, M), landmark (T, M) of measurements (N, 4)."""
    step = np.searchsorted(times, measured[:, 0])
    column = np.arange(step.size) - np.searchsorted(step, step)
    shape = times.size, int(column.max()) + 1
    polar, valid = np.zeros((*shape, 2), np.float32), np.zeros(shape, bool)
    landmark = np.full(shape, -1, np.int32)
    polar[step, column], valid[step, column] = measured[:, 2:], True
    landmark[step, column] = measured[:, 1]
    return polar, valid, landmark
