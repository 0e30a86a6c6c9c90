"""Places that a drive shows twice, far from where it has them: loops that nearness cannot close.

A drive whose wheels slipped in a bare corridor, or that has turned a little wrong, comes back to a
place metres from where it was before: `loop_closure`, which searches about the pose it has, finds
nothing there. Here places are found wherever the drive has them. It is cut into parts, each a small
map without much drift, that are put side by side as the sheets of an atlas, in one index:

      the drive                         the atlas
        o--o--o--o                      | o--o--o | o--o--o | o--o--o |
        |   o--o |--o          ->       |         |         |         |
        o--o--o--o                       sheet 0    sheet 1   sheet 2

Places of a later visit that were found in an earlier one say where the later one should be. As
where two maps are joined (`joining`), only a set of places that agree on it is accepted, if the
scans of both visits agree as well, and no other set explains the same scans.
"""

import math
from typing import NamedTuple

import jax
import numpy as np

from jaxslam.core.se2_np import compose, motion_size, relative
from jaxslam.matching import map_places
from jaxslam.matching.joining import CONTRADICTION_COST, compare_maps, posed_scans_of
from jaxslam.matching.map_places import FoundPlaces, JoinSpec, ScanMap, as_scan_map
from jaxslam.matching.place_index import PlaceIndex, build_index
from jaxslam.matching.scan_agreement import PosedScans

SHEET_LENGTH = 40.0
"""[m] driven on a sheet, and"""

OVERLAP = 6.0
"""[m] before and after that are on it, too."""

MAX_SHEETS = 40
"""Sheets of an atlas, at most; a long drive has several."""

MAX_SPACING = 5.0
"""[m] driven from one place that is looked for to the next, at most."""

REACH = 12.0
"""[m] of a scan that is on a sheet."""

NUM_CANDIDATES = 8
"""Places of a query: its own sheets show it, too."""

MIN_BETWEEN = 15.0
"""[m] driven between two visits."""

SAME_PLACE = (0.3, 0.06)
"""[m], [rad] from where the drive has a place, within which it was found where it is."""

MAX_DRIFT = (2.0, 0.1, 1.2)
"""[m], fraction of the path between two visits, [rad]: the drift between them, at most."""

MAX_CONTRADICTION = 0.04
"""Share of the compared ends that contradict, at most. It is less than that of `JoinSpec`: one
transform has to hold for a few places only."""

MIN_GOOD = 0.5
"""Share of the places of a set that the scans of both visits confirm, at least. Not all: some are
near where wheels and scans were wrong."""

SAME = 0.5
"""Share of the ends confirmed at a place that are confirmed where the drive has it, beyond which it
is in both."""

MIN_SPAN = 1.0
"""[m] between two places of a set, at least."""

AROUND = 6.0
"""[m] driven before and after a place whose scans are compared."""


class Revisits(NamedTuple):
    """N places that were found again; NumPy.

    Attributes:
        first: (N,) int keyframe of the earlier visit.
        second: (N,) int keyframe of the later visit.
        relative_pose: (N, 3) [m, m, rad] pose of the second in the frame of the first.
        group: (N,) int number of the set of places, from 0, that agrees with it.
    """

    first: np.ndarray
    second: np.ndarray
    relative_pose: np.ndarray
    group: np.ndarray


class _Hypotheses(NamedTuple):
    """N places that were found in another visit, and the keyframes (N,) of both visits there.

    `found.first` is in the frame of the drive at the earlier visit, `found.second` at the later.
    """

    found: FoundPlaces
    first: np.ndarray
    second: np.ndarray


class _Comparison(NamedTuple):
    """A set of hypotheses: those (N,) that the scans confirm, one a query, and their value."""

    confirmed: np.ndarray
    accepted: bool
    value: float


def find_revisits(spec: JoinSpec, scan_map: ScanMap) -> Revisits:
    """Places of a drive that its scans show to be others of its places.

    Args:
        spec: Options, as where two maps are joined.
        scan_map: The drive, its poses as they are estimated. Leaps between pieces count as driven.

    Raises:
        ValueError: An option is out of range, or poses and scans are not K >= 1 each, and finite.
    """
    map_places.check_join_spec(spec)
    scan_map = as_scan_map("scan_map", scan_map)
    driven = map_places.distance_driven(scan_map.poses)
    hypotheses = _hypotheses(spec, scan_map, driven)
    found, posed = hypotheses.found, posed_scans_of(scan_map)
    compared = [
        _compare(spec, posed, driven, hypotheses, members)
        for members in map_places.consistent_sets(spec, found)
    ]
    queries = [found.query[one.confirmed] for one in compared]
    chosen, group = [np.zeros(0, int)], [np.zeros(0, int)]
    for one, own in zip(compared, queries, strict=True):
        if not one.accepted:
            continue
        rivals = [
            other.value
            for other, others in zip(compared, queries, strict=True)
            if other is not one and np.isin(own, others).mean() > 0.5
        ]
        if max(rivals, default=0.0) <= spec.max_rival * one.value:
            chosen.append(one.confirmed)
            group.append(np.full(len(chosen[-1]), len(chosen) - 2))
    pairs = np.concatenate(chosen)
    first, second = hypotheses.first[pairs], hypotheses.second[pairs]
    by_first = relative(scan_map.poses[first], found.first[pairs])
    by_second = relative(scan_map.poses[second], found.second[pairs])
    between = compose(by_first, relative(by_second, np.zeros(3)))
    return Revisits(first, second, between, np.concatenate(group))


def _hypotheses(spec: JoinSpec, scan_map: ScanMap, driven: np.ndarray) -> _Hypotheses:
    """Places that were found in another visit, elsewhere than the drive has them."""
    poses = scan_map.poses
    spec = spec._replace(
        place=spec.place._replace(num_candidates=NUM_CANDIDATES),
        max_queries=max(spec.max_queries, math.ceil(driven[-1] / MAX_SPACING)),
    )
    keyframes, sheets = map_places.query_keyframes(spec, poses), _sheets(driven)
    parts = []
    for start in range(0, len(sheets), MAX_SHEETS):
        atlas = _make_atlas(spec, scan_map, sheets[start : start + MAX_SHEETS])
        query, weight, found = map_places.places_of(spec, atlas.places, scan_map, keyframes)
        parts.append((query, weight, *_in_drive(atlas, poses, found)))
    query, weight, at, other = (np.concatenate(x) for x in zip(*parts, strict=True))
    own = keyframes[query]
    swap = (other > own)[:, None]  # the query is of the earlier visit
    first, second = np.where(swap, poses[own], at), np.where(swap, at, poses[own])
    off, path = relative(first, second), np.abs(driven[own] - driven[other])
    distance, turn = np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])
    kept = (distance > SAME_PLACE[0]) | (turn > SAME_PLACE[1])
    kept &= (distance <= MAX_DRIFT[0] + MAX_DRIFT[1] * path) & (turn <= MAX_DRIFT[2])
    kept &= path > MIN_BETWEEN
    found_places = FoundPlaces(query, weight, first, second)
    visits = np.minimum(own, other), np.maximum(own, other)
    return _Hypotheses(*jax.tree.map(lambda x: x[kept], (found_places, *visits)))


class _Atlas(NamedTuple):
    """S sheets side by side along x, in one index.

    Attributes:
        places: Of all sheets.
        edges: (S + 1,) [m] where they begin and end.
        shifts: (S, 3) [m, m, 0] from the frame of the drive to that of the atlas.
        keyframes: Those on each sheet.
    """

    places: PlaceIndex
    edges: np.ndarray
    shifts: np.ndarray
    keyframes: list[np.ndarray]


def _sheets(driven: np.ndarray) -> list[np.ndarray]:
    """Keyframes of each part of a drive; those near its ends are of the next parts, too."""
    count = max(round(driven[-1] / SHEET_LENGTH), 1)
    bounds = np.linspace(0.0, driven[-1], count + 1)
    sheets = [
        np.flatnonzero((driven >= low - OVERLAP) & (driven <= high + OVERLAP))
        for low, high in zip(bounds[:-1], bounds[1:], strict=True)
    ]
    return [sheet for sheet in sheets if sheet.size]


def _make_atlas(spec: JoinSpec, scan_map: ScanMap, sheets: list[np.ndarray]) -> _Atlas:
    """Parts of a drive side by side."""
    lidar, poses, scans = scan_map
    low = np.array([poses[sheet, :2].min(axis=0) for sheet in sheets]) - REACH
    width = np.array([poses[sheet, 0].max() for sheet in sheets]) + REACH - low[:, 0]
    edges = np.append(0.0, np.cumsum(width))
    shifts = np.column_stack([edges[:-1] - low[:, 0], -low[:, 1], np.zeros(len(sheets))])
    shown = np.concatenate(sheets)
    of_sheet = np.repeat(np.arange(len(sheets)), [sheet.size for sheet in sheets])
    some = jax.tree.map(lambda x: x[shown], scans)
    some = some._replace(hit=some.hit & (some.ranges < REACH))
    places = build_index(spec.place, lidar, poses[shown] + shifts[of_sheet], some)
    return _Atlas(places, edges, shifts, sheets)


def _in_drive(atlas: _Atlas, poses: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (N, 3) of the atlas in the frame of the drive, and the nearest keyframes (N,) there."""
    sheet = np.searchsorted(atlas.edges, found[:, 0], side="right") - 1
    sheet = sheet.clip(0, len(atlas.keyframes) - 1)
    found = found - atlas.shifts[sheet]
    nearest = np.zeros(len(found), int)
    for number in np.unique(sheet):
        here, members = np.flatnonzero(sheet == number), atlas.keyframes[number]
        size = motion_size(relative(poses[members][None], found[here][:, None]))
        nearest[here] = members[np.argmin(size, axis=1)]
    return found, nearest


def _compare(
    spec: JoinSpec,
    posed: PosedScans,
    driven: np.ndarray,
    hypotheses: _Hypotheses,
    members: np.ndarray,
) -> _Comparison:
    """Compare the scans of both visits at each place of a set, by the places near it.

    A place is confirmed if they agree there, and not as well where the drive has the later visit,
    with the scans up to about the earlier one: along a corridor, both may be so.
    """
    agreeing = FoundPlaces(*(x[members] for x in hypotheses.found))
    best = _best_of_each_query(hypotheses.found, members)
    transforms = map_places.transforms_near(agreeing, hypotheses.found.second[best])
    there, as_it_is = np.zeros((2, len(best), 2))
    for number, hypothesis in enumerate(best.tolist()):
        from_first, from_second = (
            posed.travelled - driven[keyframes[hypothesis]]
            for keyframes in (hypotheses.first, hypotheses.second)
        )
        later = posed.only(np.abs(from_second) <= AROUND)
        there[number] = compare_maps(
            posed.only(np.abs(from_first) <= AROUND), later, transforms[number]
        )
        moved = relative(*(x[hypothesis] for x in hypotheses.found[2:]))
        until = from_first <= AROUND + np.hypot(moved[0], moved[1])
        before = posed.only(until & (from_second < -MIN_BETWEEN))
        as_it_is[number] = compare_maps(before, later, np.zeros(3))
    good = _agree(there) & ~(_agree(as_it_is) & (as_it_is[:, 0] > SAME * there[:, 0]))
    confirmed = best[good]
    accepted = (
        len(confirmed) >= spec.min_places
        and map_places.span_of(hypotheses.found.second[confirmed]) >= MIN_SPAN
        and bool(np.mean(good) >= MIN_GOOD)
    )
    value = np.sum(there[good] @ [1.0, -CONTRADICTION_COST]) * len(confirmed)
    return _Comparison(confirmed, accepted, float(value))


def _agree(counts: np.ndarray) -> np.ndarray:
    """Whether scans agree (N,) by their confirmed and contradicted ends (N, 2)."""
    return (counts[:, 0] > 0.0) & (counts[:, 1] <= MAX_CONTRADICTION * np.sum(counts, axis=1))


def _best_of_each_query(found: FoundPlaces, members: np.ndarray) -> np.ndarray:
    """Of some hypotheses the best one of each query."""
    order = members[np.argsort(-found.weight[members], kind="stable")]
    return order[np.unique(found.query[order], return_index=True)[1]]
