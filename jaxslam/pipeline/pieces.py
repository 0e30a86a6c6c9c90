"""Pieces of a broken drive: each is mapped alone, and joined to others where places are found.

    piece 0  o--o--o--o--o--o--o     break     piece 1  o--o--o--o
                   |__________________________________________|    the same place

Pieces that are joined, by whatever other pieces, are a group: they have one frame, and become one
map. Pieces that no place joins to the rest become maps of their own.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.se2_np import compose, relative
from jaxslam.matching.joining import Join, check_join, find_join
from jaxslam.matching.map_places import JoinSpec, ScanMap
from jaxslam.pipeline import stages
from jaxslam.pipeline.stages import KeyframeChunk

SAVED = -1
"""Number of the saved map that a log goes on in, which is before all pieces."""

NEAR_BREAK = 8.0
"""[m] from a break up to which scans are compared across it: there is little drift yet."""

JOIN_STD = (0.2, 0.2, 0.02)
"""[m], [m], [rad] std of the motion from piece to piece, as the places found have it."""


class Group(NamedTuple):
    """Pieces with one frame, that of the first of them.

    Attributes:
        frames: (3,) [m, m, rad] frame of each piece by its number, in the order of time.
        joins: What joined them, one fewer than pieces.
    """

    frames: dict[int, np.ndarray]
    joins: tuple[Join, ...] = ()

    @property
    def pieces(self) -> tuple[int, ...]:
        """Numbers of the pieces, in the order of time."""
        return tuple(self.frames)


def group_pieces(
    spec: JoinSpec, maps: Mapping[int, ScanMap], across_breaks: Mapping[int, np.ndarray]
) -> list[Group]:
    """Groups of pieces that can be joined, the largest first.

    The groups so far are compared, the largest ones first, until nothing joins any more. Those that
    are left are joined as scan matching had it across the break, if the scans of both agree.

    Args:
        spec: Options.
        maps: Of the pieces, by their number.
        across_breaks: (3,) [m, m, rad] motion by scan matching, by the number of the piece after
            the break, from the last keyframe of the piece before to its first one.
    """
    groups = [Group({k: np.zeros(3)}) for k in maps]
    tried: set[tuple[tuple[int, ...], tuple[int, ...]]] = set()
    while True:
        groups.sort(key=lambda group: -_size(maps, group))
        pairs = [
            (one, other)
            for k, one in enumerate(groups)
            for other in groups[k + 1 :]
            if (one.pieces, other.pieces) not in tried
        ]
        for one, other in pairs:
            tried.add((one.pieces, other.pieces))
            join = find_join(spec, group_map(maps, one), group_map(maps, other))
            if join.accepted:
                groups = [g for g in groups if g is not one and g is not other]
                groups.append(_merged(one, other, join))
                break
        else:
            break
    for number, increment in across_breaks.items():
        one, other = (next(g for g in groups if k in g.pieces) for k in (number - 1, number))
        if one is not other:
            join = _join_across(spec, maps, one, other, number, increment)
            if join.accepted:
                groups = [g for g in groups if g is not one and g is not other]
                groups.append(_merged(one, other, join))
    return sorted(groups, key=lambda group: -_size(maps, group))


def _join_across(
    spec: JoinSpec,
    maps: Mapping[int, ScanMap],
    before: Group,
    after: Group,
    number: int,
    increment: np.ndarray,
) -> Join:
    """The join of two groups by the motion to piece `number` from the one before."""
    last_map, first_map = maps[number - 1], maps[number]
    end, start = last_map.poses[-1], first_map.poses[0]
    between = compose(compose(end, increment), relative(start, np.zeros(3)))
    join = check_join(spec, _near(last_map, end), _near(first_map, start), between)
    # From the frames of the pieces to those of their groups.
    frame = compose(before.frames[number - 1], join.transform)
    inverse = relative(after.frames[number], np.zeros(3))
    return join._replace(transform=compose(frame, inverse))


def _near(scan_map: ScanMap, pose: np.ndarray) -> ScanMap:
    """The keyframes of a map near a pose (3,)."""
    near = np.hypot(*(scan_map.poses - pose)[:, :2].T) < NEAR_BREAK
    scans = jax.tree.map(lambda x: x[near], scan_map.scans)
    return ScanMap(scan_map.lidar, scan_map.poses[near], scans)


def group_map(maps: Mapping[int, ScanMap], group: Group) -> ScanMap:
    """All keyframes of a group, in its frame."""
    poses = [compose(frame, maps[k].poses) for k, frame in group.frames.items()]
    scans = stages.concatenate([maps[k].scans for k in group.pieces])
    return ScanMap(maps[group.pieces[0]].lidar, np.concatenate(poses), scans)


def _size(maps: Mapping[int, ScanMap], group: Group) -> int:
    """Number of keyframes of a group."""
    return sum(len(maps[k].poses) for k in group.pieces)


def _merged(one: Group, other: Group, join: Join) -> Group:
    """Both groups as one, in the frame of the piece that is first in time."""
    frames = one.frames | {k: compose(join.transform, x) for k, x in other.frames.items()}
    origin = frames[min(frames)]
    frames = {k: relative(origin, frames[k]) for k in sorted(frames)}
    return Group(frames, (*one.joins, *other.joins, join))


def after_gap(chunk: KeyframeChunk, rows: np.ndarray, increments: np.ndarray) -> KeyframeChunk:
    """A chunk where the motion to some keyframes is not as matched, but known otherwise.

    Args:
        chunk: The chunk.
        rows: (N,) int indices of these keyframes in the chunk.
        increments: (N, 3) [m, m, rad] motion to them from the keyframe before, of `JOIN_STD`.
    """
    match = chunk.chunk.measurements.scan_match
    assert match is not None and match.expected is not None and match.expected_variance is not None

    def put(held: Any, value: Any) -> Any:
        return held.at[rows].set(jnp.asarray(value, held.dtype))

    match = match._replace(
        information=put(match.information, np.zeros((3, 3))),
        increment=put(match.increment, increments),
        expected=put(match.expected, increments),
        expected_variance=put(match.expected_variance, np.square(JOIN_STD)),
    )
    return stages.with_scan_match(chunk, match)
