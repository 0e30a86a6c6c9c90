"""Joining two maps of one building whose places relative to each other are not known.

    join = find_join(spec, first, second)
    if join.accepted: poses_in_first = compose(join.transform, second.poses)

Places of each map are looked for in the other one, by a few scans at a time (`map_places`). What
the largest sets of them agree on, a few transforms, is compared by all scans that see the same
places in both maps: buildings are symmetric. Its value is

    places that agree * (confirmed ends - CONTRADICTION_COST * contradicted ends)

with the ends of beams that the other map's scans see on a wall, or see to be in free space. Scans
are compared by the transform of the places near them, as maps drift (`transforms_near`).
That transform is accepted which is better than all others by far, rests on several places, and
hardly contradicts itself. One place alone never joins two maps.
"""

from typing import NamedTuple

import numpy as np
import scipy

from jaxslam.core.se2_np import compose, transform, wrap_angle
from jaxslam.matching.map_places import (
    FoundPlaces,
    JoinSpec,
    ScanMap,
    as_scan_map,
    check_join_spec,
    consistent_sets,
    fit_transform,
    places_between,
    span_of,
    transforms_near,
)
from jaxslam.matching.scan_agreement import (
    CONFIRMED,
    CONTRADICTED,
    PosedScans,
    ScanComparison,
    posed_scans,
)

VIEW_RADIUS = 4.0
"""[m] between two scans that are compared."""

VIEWS = 3
"""Scans of the other map that each scan chooses to be compared with, at most."""

CONTRADICTION_COST = 3.0
"""Confirmed ends that one contradicted end outweighs."""


class Join(NamedTuple):
    """The best transform between two maps, whether it is accepted or not; NumPy.

    Attributes:
        transform: (3,) [m, m, rad] frame of the second map, in that of the first.
        accepted: Whether the maps are joined by it.
        num_places: Places that agree.
        span: [m] largest distance between two of them.
        contradiction: Share of the ends that contradict, of those compared, by the transforms that
            hold near each place: over long maps, `transform` is off by their drift.
        rival: Value of the best other transform, as a fraction of that of this one.
    """

    transform: np.ndarray
    accepted: bool
    num_places: int
    span: float
    contradiction: float
    rival: float


def find_join(spec: JoinSpec, first: ScanMap, second: ScanMap) -> Join:
    """The transform between two maps by which most places and scans agree.

    Args:
        spec: Options.
        first: A map.
        second: Another one, by the same scanner.

    Raises:
        ValueError: An option is out of range, the scanners differ, or the poses and scans of a map
            are not K >= 1 each, and finite.
    """
    check_join_spec(spec)
    first, second = as_scan_map("first", first), as_scan_map("second", second)
    if first.lidar != second.lidar:
        raise ValueError(
            f"first.lidar and second.lidar differ: {first.lidar} and {second.lidar}; "
            "maps are joined by the scans of one scanner"
        )
    found = places_between(spec, first, second)
    sets = consistent_sets(spec, found)
    if not sets:
        return Join(np.zeros(3), False, 0, 0.0, 1.0, 1.0)
    joins, values = [], []
    posed_first, posed_second = posed_scans_of(first), posed_scans_of(second)
    for members in sets:
        agreeing = FoundPlaces(*(x[members] for x in found))
        between = fit_transform(agreeing.second, agreeing.first, agreeing.weight)
        near = transforms_near(agreeing, posed_second.poses)
        confirmed, contradicted = compare_maps(posed_first, posed_second, near)
        value = confirmed - CONTRADICTION_COST * contradicted
        share = contradicted / max(confirmed + contradicted, 1)
        joins.append(
            Join(
                transform=between,
                accepted=False,
                num_places=len(np.unique(agreeing.query)),
                span=span_of(agreeing.second),
                contradiction=share,
                rival=1.0,
            )
        )
        values.append(max(value, 0.0) * joins[-1].num_places)
    best = int(np.argmax(values))
    others = [value for k, value in enumerate(values) if k != best]
    rival = max(others, default=0.0) / values[best] if values[best] > 0.0 else 1.0
    join = joins[best]
    accepted = (
        join.num_places >= spec.min_places
        and join.span >= spec.min_span
        and join.contradiction <= spec.max_contradiction
        and rival <= spec.max_rival
    )
    return join._replace(rival=rival, accepted=accepted)


def check_join(spec: JoinSpec, first: ScanMap, second: ScanMap, between: np.ndarray) -> Join:
    """A transform that is known otherwise, as a join; accepted if the scans of both maps agree.

    Args:
        spec: Options, of which `max_contradiction` is used.
        first: A map.
        second: Another one, by the same scanner.
        between: (3,) [m, m, rad] frame of the second map, in that of the first.
    """
    confirmed, contradicted = compare_maps(posed_scans_of(first), posed_scans_of(second), between)
    share = contradicted / max(confirmed + contradicted, 1.0)
    accepted = confirmed > 0.0 and share <= spec.max_contradiction
    return Join(between, accepted, 0, 0.0, share, 0.0)


def compare_maps(first: PosedScans, second: PosedScans, between: np.ndarray) -> tuple[float, float]:
    """Ends of beams that two maps confirm, and that contradict, where their scans are near.

    Args:
        first: Scans [K] of one map.
        second: Scans [N] of another one.
        between: (3,) or (N, 3) [m, m, rad] frame of the second in that of the first, or where each
            of its scans has it.
    """
    between = np.broadcast_to(between, second.poses.shape)
    poses, ends = compose(between, second.poses), transform(between[:, None], second.ends)
    count = len(first.poses)
    both = PosedScans(
        np.arange(count + len(poses)),
        np.concatenate([first.poses, poses]),
        np.concatenate([first.travelled, second.travelled]),
        first.angles,
        np.concatenate([first.ranges, second.ranges]),
        np.concatenate([first.ends, ends]),
    )
    pairs = [(own, count + other) for other, own in _nearest_scans(first.poses, poses)]
    pairs += [(own, count + other) for own, other in _nearest_scans(poses, first.poses)]
    if not pairs:
        return 0.0, 0.0
    used, index = np.unique(sorted(set(pairs)), return_inverse=True)
    agreement = ScanComparison(both.only(used)).compare(*index.reshape(-1, 2).T)
    return float(agreement.num_ends(CONFIRMED).sum()), float(agreement.num_ends(CONTRADICTED).sum())


def _nearest_scans(poses: np.ndarray, of: np.ndarray) -> list[tuple[int, int]]:
    """For each of the poses `of` (N, 3) the `VIEWS` of poses (K, 3) that are most like it, near."""
    near = scipy.spatial.cKDTree(poses[:, :2]).query_ball_point(of[:, :2], VIEW_RADIUS)
    pairs = []
    for scan, others in enumerate(near):
        index = np.array(others, int)
        off = poses[index] - of[scan]
        cost = np.hypot(off[:, 0], off[:, 1]) + 0.5 * np.abs(wrap_angle(off[:, 2]))
        pairs += [(scan, k) for k in index[np.argsort(cost)[:VIEWS]].tolist()]
    return pairs


def posed_scans_of(scan_map: ScanMap) -> PosedScans:
    """The scans of a map that are compared."""
    lidar, poses, scans = scan_map
    return posed_scans(lidar, poses, np.asarray(scans.ranges, float), np.asarray(scans.hit))
