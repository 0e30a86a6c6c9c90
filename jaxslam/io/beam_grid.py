"""Scans on one grid of angles, whatever their beam counts, steps, directions and first angles."""

import math
from typing import NamedTuple

import numpy as np

from jaxslam.core.logs import MAX_BROKEN_FRACTION
from jaxslam.io.raw_log import RawScan

MAX_STEP_CHANGE = 0.03  # of the step between beams, by the speed of a motor
SAME_STEP = 1e-9  # [rad] within which steps and first angles are the same
REACH = 0.75  # of a step: how far a beam may be from the angle of the grid that takes its reading
SEAM_TOLERANCE = 0.5  # of a step that a scan may pass -pi or pi without being cut there
QUANTILE = 0.05  # of the scans that may begin before the grid, or end after it


class BeamGrid(NamedTuple):
    """R angles, counter-clockwise.

    Attributes:
        num_beams: R.
        angle_min: [rad] of the first.
        angle_increment: [rad] above 0.
    """

    num_beams: int
    angle_min: float
    angle_increment: float


def are_usual(scans: list[RawScan]) -> np.ndarray:
    """Whether scans are like most others: not one of a few with another step between beams.

    Where nearly all scans agree, a few others were cut, or say something wrong of themselves: often
    the first. Steps that vary in many scans are those of a motor, and usual.

    Args:
        scans: T scans.

    Returns:
        (T,) bool, False for at most `MAX_BROKEN_FRACTION` of them, or for one.
    """
    steps = np.array([scan.angle_increment for scan in scans])
    usual = np.median(steps)
    like = np.abs(steps - usual) <= MAX_STEP_CHANGE * abs(usual)
    few = (~like).sum() <= max(MAX_BROKEN_FRACTION * len(scans), 1) and like.sum() > 1
    return like if few else np.ones(len(scans), bool)


def to_grid(
    scans: list[RawScan], *, upside_down: bool = False, angle_increment: float | None = None
) -> tuple[np.ndarray, BeamGrid, list[str]]:
    """Readings of all scans on one grid, between -pi and pi where the scans allow it.

    Scans of one geometry keep their beams. Of others each angle of the grid takes the reading of
    the nearest beam, if there is one within `REACH` of a step.

    Args:
        scans: T scans, T >= 1.
        upside_down: Whether the scanner is, so that its beams are mirrored.
        angle_increment: Step [rad] between beams, instead of that of the scans.

    Returns:
        (T, R) float64 [m], infinite where there is no return; the grid; and notes.
    """
    grids = [_grid_of(scan, upside_down, angle_increment) for scan in scans]
    backwards = [(scan.angle_increment < 0.0) != upside_down for scan in scans]
    readings = [
        scan.ranges[::-1] if turned else scan.ranges
        for scan, turned in zip(scans, backwards, strict=True)
    ]
    different = set(grids)
    one_geometry = len(different) == 1
    target = _cut_at_seam(grids[0] if one_geometry else _common_grid(grids))
    if different == {target}:
        return np.array(readings), target, []
    indices = {grid: _nearest(grid, target) for grid in different}
    ranges = np.array(
        [
            np.append(reading, np.inf)[indices[grid]]
            for reading, grid in zip(readings, grids, strict=True)
        ]
    )
    return ranges, target, [] if one_geometry else _notes(grids, target)


def _grid_of(scan: RawScan, upside_down: bool, angle_increment: float | None) -> BeamGrid:
    """Grid of one scan, seen from above and counter-clockwise."""
    step, first = scan.angle_increment, scan.angle_min
    if angle_increment is not None:
        step = math.copysign(angle_increment, step)
    num_beams = scan.ranges.size
    if (step < 0.0) != upside_down:  # the beams are clockwise, seen from above
        first = first + step * (num_beams - 1)
    return BeamGrid(num_beams, -first if upside_down else first, abs(step))


def _common_grid(grids: list[BeamGrid]) -> BeamGrid:
    """The usual step, over the angles that most scans reach."""
    counts, first, step = np.array(grids).T
    usual = float(np.median(step))
    low = float(np.quantile(first, QUANTILE, method="nearest"))
    high = float(np.quantile(first + step * (counts - 1), 1.0 - QUANTILE, method="nearest"))
    most = math.floor(2 * math.pi / usual + SEAM_TOLERANCE) + 1
    num_beams = min(max(round((high - low) / usual) + 1, 2), max(most, 2))
    return BeamGrid(num_beams, low, usual)


def _cut_at_seam(grid: BeamGrid) -> BeamGrid:
    """The grid, in whole turns so that it lies within -pi and pi; a full turn is cut there."""
    count, first, step = grid
    last = first + step * (count - 1)
    margin = SEAM_TOLERANCE * step
    if first >= -math.pi - margin and last <= math.pi + margin:
        return grid
    gap = 2 * math.pi - (last - first)  # between the last beam and the first
    if gap > 1.5 * step:  # no full turn: it may go on beyond pi
        turns = math.floor((first + math.pi) / (2 * math.pi))
        return grid._replace(angle_min=first - 2 * math.pi * turns)
    if gap < 0.5 * step:  # the last beam is the first once more
        count = max(math.floor(2 * math.pi / step + 0.5), 2)
    beams = first + step * np.arange(count)
    wrapped = np.remainder(beams + math.pi + margin, 2 * math.pi) - math.pi - margin
    return BeamGrid(count, float(wrapped.min()), step)


def _nearest(grid: BeamGrid, target: BeamGrid) -> np.ndarray:
    """Index of the beam nearest to each angle of the target; one past the last if too far."""
    angles = target.angle_min + target.angle_increment * np.arange(target.num_beams)
    turn = 2 * math.pi / grid.angle_increment
    place = np.remainder((angles - grid.angle_min) / grid.angle_increment, turn)
    near = np.full(angles.shape, grid.num_beams)
    least = np.full(angles.shape, REACH * target.angle_increment / grid.angle_increment)
    for shifted in (place, place - turn):
        beam = np.round(shifted).clip(0, grid.num_beams - 1)
        distance = np.abs(shifted - beam)
        better = distance < least - SAME_STEP
        near[better], least[better] = beam[better], distance[better]
    return near


def _notes(grids: list[BeamGrid], target: BeamGrid) -> list[str]:
    """What differs between the scans."""
    counts = sorted({grid.num_beams for grid in grids})
    if len(counts) > 1:
        differing = f"have {counts[0]} to {counts[-1]} beams"
    else:
        differing = "differ in their angles"
    step = math.degrees(target.angle_increment)
    on = f"one grid of {target.num_beams} beams, {step:.4g} degrees apart"
    return [f"scans {differing}: they are put on {on}"]
