"""The time of scans and odometry: which stamps can be used, and how the two streams are joined.

Stamps that are fine stay as they are. Where they do not distinguish the scans, or were set back,
the time of reception takes their place, or the order in the file.
"""

from typing import NamedTuple

import numpy as np

from jaxslam.core.se2_np import motion_size, relative
from jaxslam.core.time_series import sort_by_time
from jaxslam.io.raw_log import RawOdometry, Stamps

MIN_DISTINCT = 0.9  # least fraction of the scans' stamps that must differ from all others
MIN_DISTINCT_ODOMETRY = 0.5  # likewise of the odometry, which some robots send twice
MIN_SPREAD = 0.1  # least fraction of stamps that differ, so that equal ones are spread in between
MAX_SCANS_BACK = 10  # scans in a row that may lie before an earlier one: more, the clock was set
NOMINAL_STEP = 0.1  # [s] between scans whose stamps say nothing, at least
NOMINAL_SPEED = 0.5  # [m/s] of a robot at that time; a radian counts as half a metre
MAX_START = 1e3  # [s] of the first stamps of a clock that starts at 0
MAX_CLOCK_OFFSET = 0.5  # [s] between two clocks that is ignored: delays of drivers and networks
MAX_DETOUR = 1.02  # of the path in order of the stamps over that in order of the file
MIN_OVERLAP = 0.9  # of the overlap in time of scans and odometry by stamps, over that otherwise


class JoinedOdometry(NamedTuple):
    """The odometry on a common axis with the scans, in order along it.

    Attributes:
        scan_times: (T,) float64 [s] of the scans, with their clock corrected if it is off.
        scan_axis: (T,) of the scans: seconds, or places in the file.
        times: (N,) float64 [s] of the odometry by the clock of `scan_times`.
        axis: (N,) of the odometry, ascending.
        poses: (N, 3) [m, m, rad].
        is_time: Whether the axis is time.
        notes: How it was joined, unless by the stamps as they are.
    """

    scan_times: np.ndarray
    scan_axis: np.ndarray
    times: np.ndarray
    axis: np.ndarray
    poses: np.ndarray
    is_time: bool = True
    notes: tuple[str, ...] = ()


def scan_times(stamps: Stamps, poses: np.ndarray | None = None) -> tuple[np.ndarray, list[str]]:
    """Times of the scans.

    Args:
        stamps: Stamps of T scans in file order.
        poses: (T, 3) [m, m, rad] of the scans, if known: where times must be made, the robot is not
            made faster than `NOMINAL_SPEED` in nearly all steps.

    Returns:
        (T,) float64 [s]: the stamps of the scans if they can be used, where single ones may run
        backwards; and notes of what is wrong with them.
    """
    own, notes = _fill_zeros(stamps.own)
    if are_distinct(own) and not is_set_back(own):
        return own, notes + _steps_back(own)
    problem = "time stamps of the scans " + (
        "are set back" if are_distinct(own) else "do not distinguish the scans"
    )
    received = stamps.received
    if are_distinct(received) and not is_set_back(received):
        return received, [f"{problem}: times of reception are used"]
    if are_distinct(own):
        return _continued(own), [f"{problem}: later ones are moved on, to follow in file order"]
    if np.isfinite(own).all() and len(np.unique(own)) >= MIN_SPREAD * len(own):
        spread = _spread(own)
        if not is_set_back(spread):
            return spread, [f"{problem}: equal ones are spread evenly, in file order"]
    start = own[0] if np.isfinite(own[0]) else 0.0
    step = NOMINAL_STEP
    if poses is not None and len(poses) > 1:
        step = max(step, round(float(np.quantile(_sizes(poses), 0.95)) / NOMINAL_SPEED, 1))
    times = start + step * np.arange(len(own))
    return times, [f"{problem}: they are made from the file order, {step:g} s apart"]


def are_distinct(times: np.ndarray, fraction: float = MIN_DISTINCT) -> bool:
    """Whether times (N,) [s] are finite, and this fraction of them at least are different."""
    return bool(np.isfinite(times).all()) and len(np.unique(times)) >= fraction * len(times)


def is_set_back(times: np.ndarray) -> bool:
    """Whether a clock was set back: many times (N,) [s] in a row lie before an earlier one.

    Single times that are off, early or late, do not count.
    """
    behind = np.maximum.accumulate(_running_median(times)) > times
    edges = np.flatnonzero(np.diff(np.concatenate([[False], behind, [False]]).astype(int)))
    return bool((edges[1::2] - edges[::2] > MAX_SCANS_BACK).any())


def join(stamps: Stamps, times: np.ndarray, odometry: RawOdometry) -> JoinedOdometry:
    """Join odometry with scans: by stamps if these can be used, by reception or order otherwise.

    Where the two clocks differ, by the times of reception, the one that is off is corrected.

    Args:
        stamps: Stamps of T scans.
        times: (T,) [s] of these, by `scan_times`.
        odometry: N poses, N >= 1.
    """
    other = odometry.stamps
    by_stamps, notes = _clocks_corrected(stamps, times, other)
    options = []
    if np.array_equal(times[stamps.own != 0.0], stamps.own[stamps.own != 0.0]) and _follow_path(
        other.own, odometry
    ):
        options += [("time stamps", *by_stamps), ("time stamps", times, other.own)]
    if are_distinct(stamps.received) and _follow_path(other.received, odometry):
        options.append(("time of reception", stamps.received, other.received))
    options.append(("order in the file", stamps.order, other.order))
    overlaps = [_overlap(scan_axis, axis) for _, scan_axis, axis in options]
    chosen = next(i for i, x in enumerate(overlaps) if x >= MIN_OVERLAP * max(overlaps))
    name, scan_axis, axis = options[chosen]
    odom_times = axis
    if name == "time stamps":
        times, notes = scan_axis, notes if chosen == 0 else []
    else:
        notes = [f"odometry is joined to the scans by {name}, not by time stamps"]
        if not np.array_equal(times, scan_axis):
            odom_times = _mapped(axis, scan_axis, times)
    order = np.argsort(axis, kind="stable")
    return JoinedOdometry(
        scan_times=times,
        scan_axis=scan_axis,
        times=odom_times[order],
        axis=axis[order],
        poses=odometry.poses[order],
        is_time=name != "order in the file",
        notes=tuple(notes),
    )


def _clocks_corrected(
    scans: Stamps, times: np.ndarray, odometry: Stamps
) -> tuple[tuple[np.ndarray, np.ndarray], list[str]]:
    """Times of scans and odometry on one clock, if both were received by one; and a note.

    The clock that is further from that of the reception is corrected.
    """
    unchanged = times, odometry.own
    delays = [x.received - x.own for x in (scans, odometry)]
    if not all(np.isfinite(delay).all() for delay in delays):
        return unchanged, []
    scan_delay, odometry_delay = (float(np.median(delay)) for delay in delays)
    spread = max(
        float(np.median(np.abs(delay - middle)))
        for delay, middle in zip(delays, (scan_delay, odometry_delay), strict=True)
    )
    behind = scan_delay - odometry_delay
    if abs(behind) <= max(MAX_CLOCK_OFFSET, 5.0 * spread):
        return unchanged, []
    move_scans = abs(scan_delay) > abs(odometry_delay)
    note = offset_note(behind, "their times of reception", move_scans=move_scans)
    if move_scans:
        return (times + behind, odometry.own), [note]
    return (times, odometry.own - behind), [note]


def offset_note(behind: float, evidence: str, *, move_scans: bool = True) -> str:
    """A note that the clock of the scanner is `behind` [s] that of the odometry."""
    side = "behind" if behind > 0.0 else "ahead of"
    moved = "the scans are" if move_scans else "the odometry is"
    return (
        f"clock of the scanner is {abs(behind):.2f} s {side} that of the odometry, by {evidence}: "
        f"{moved} moved to the other"
    )


def _fill_zeros(times: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Times in which those that are 0 are interpolated, if most are not; and a note."""
    known = np.flatnonzero(times)
    if not known.size or known.size == len(times):
        return times, []
    started = np.maximum.accumulate(times) > 0.0
    missing = (times == 0.0) & (started | (times[known[0]] > MAX_START))
    if not missing.any() or missing.mean() > 0.5:
        return times, []
    index = np.arange(len(times))
    known = np.flatnonzero(~missing)
    step = float(np.median(np.diff(times[known]) / np.diff(known))) if known.size > 1 else 0.0
    filled = np.interp(index, known, times[known])
    filled -= step * (known[0] - index).clip(0)
    filled += step * (index - known[-1]).clip(0)
    filled[known] = times[known]
    return filled, [f"{int(missing.sum())} time stamps are 0: they are interpolated in file order"]


def _steps_back(times: np.ndarray) -> list[str]:
    """A note if single times run backwards: they stay, as references name scans by their stamps."""
    num_steps = int(np.sum(np.diff(times) < 0.0))
    where = f"time stamps of the scans run backwards at {num_steps} of {len(times)}"
    return [f"{where}: scans stay in file order, and keep their stamps"] if num_steps else []


def _running_median(times: np.ndarray) -> np.ndarray:
    """Median (N,) of each time and two on either side."""
    padded = np.pad(times, 2, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)


def _continued(times: np.ndarray) -> np.ndarray:
    """Times in which each step back is replaced by the usual step forward."""
    steps = np.diff(times)
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else NOMINAL_STEP
    return times[0] + np.concatenate([[0.0], np.cumsum(np.where(steps > 0.0, steps, usual))])


def _spread(times: np.ndarray) -> np.ndarray:
    """Times in which runs of equal ones are spread evenly up to the next."""
    starts = np.flatnonzero(np.concatenate([[True], np.diff(times) != 0.0]))
    step = (times[starts[-1]] - times[0]) / max(starts[-1], 1)
    end = times[starts[-1]] + step * (len(times) - starts[-1])
    return np.interp(np.arange(len(times)), [*starts, len(times)], [*times[starts], end])


def _follow_path(times: np.ndarray, odometry: RawOdometry) -> bool:
    """Whether times (N,) are distinct, and in their order the path is no longer than in the file's.

    A clock that was set back would put two parts of a drive between each other.
    """
    if not are_distinct(times, MIN_DISTINCT_ODOMETRY):
        return False
    in_file = odometry.poses[np.argsort(odometry.stamps.order, kind="stable")]
    in_time = sort_by_time(times, odometry.poses)[1]
    return _path(in_time) <= MAX_DETOUR * _path(in_file) + 0.1


def _path(poses: np.ndarray) -> float:
    """Length of a path, to which a radian adds half a metre."""
    return float(np.sum(_sizes(poses)))


def _sizes(poses: np.ndarray) -> np.ndarray:
    """Sizes (N - 1,) [m] of the steps of a path (N, 3); a radian counts as half a metre."""
    return motion_size(relative(poses[:-1], poses[1:]))


def _overlap(scan_axis: np.ndarray, axis: np.ndarray) -> float:
    """Fraction of the scans that lie within the odometry."""
    return float(np.mean((scan_axis >= axis.min()) & (scan_axis <= axis.max())))


def _mapped(axis: np.ndarray, scan_axis: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Times (N,) at places on the axis of the scans, beyond its ends at the mean rate."""
    order = np.argsort(scan_axis, kind="stable")
    scan_axis, times = scan_axis[order], times[order]
    length = scan_axis[-1] - scan_axis[0]
    rate = (times[-1] - times[0]) / length if length > 0.0 else 0.0
    mapped = np.interp(axis, scan_axis, times)
    return mapped + rate * (
        np.minimum(axis - scan_axis[0], 0.0) + np.maximum(axis - scan_axis[-1], 0.0)
    )
