"""Hypotheses of where two maps are to each other: places of one that are found in the other.

Each place found is a hypothesis of the transform T between the maps; most wrong ones agree with no
other. Two agree if they have the other's place where it was found, up to the drift between them:

    |T_i x_j - p_j| <= DRIFT[0] + DRIFT[1] |x_j - x_i|    for a place x_j that was found at p_j

The sets that agree with one of them are returned, the largest first; `joining` decides.

References:
    Mangelson et al. (2018), Pairwise consistent measurement set maximization for robust multi-robot
    map merging: measurements are accepted where they agree. Olson (2009), Recognizing places using
    spectrally clustered local matches.
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import scipy

from jaxslam.core import trace_cache
from jaxslam.core.batching import on_device
from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.se2_np import compose, relative, transform
from jaxslam.core.types import Array, as_float64
from jaxslam.matching import checks
from jaxslam.matching.place_index import PlaceIndex, PlaceSpec, build_index, check_place_spec
from jaxslam.matching.place_recognition import find_places, make_query

DRIFT = (0.4, 0.02)
"""[m], and fraction of the distance, by which two places that agree may be apart."""

MAX_TURN = 0.1
"""[rad] between the headings of two transforms that agree."""

SAME_TRANSFORM = 1.5
"""[m] between places within which two transforms are one."""

MIN_PLACE_SCORE = 0.5
"""Score of a place that is a hypothesis at all."""

NEAR = 8.0
"""[m] between places up to which one transform holds."""

HEADING_ARM = 5.0
"""[m] std of a place found, over that of its heading."""


class JoinSpec(NamedTuple):
    """Options of joining two maps.

    Attributes:
        place: Of place recognition.
        query_spacing: [m] driven from one place that is looked for to the next.
        max_queries: Places of a map that are looked for, at most; the spacing grows.
        window: [m] driven before and after a place whose scans are looked for together.
        window_scans: W, scans of a query.
        num_hypotheses: Transforms that are compared by the scans.
        min_places: Least number of places that an accepted transform rests on.
        min_span: [m] least distance between two of them.
        max_contradiction: Largest share of the compared ends that contradict.
        max_rival: Largest value of any other transform, as a fraction of that of the accepted one.
    """

    place: PlaceSpec = PlaceSpec()
    query_spacing: float = 2.0
    max_queries: int = 150
    window: float = 2.0
    window_scans: int = 5
    num_hypotheses: int = 5
    min_places: int = 4
    min_span: float = 3.0
    max_contradiction: float = 0.06
    max_rival: float = 0.6


class ScanMap(NamedTuple):
    """A map as its keyframes: K scans at known poses, NumPy.

    Attributes:
        lidar: The scanner.
        poses: (K, 3) [m, m, rad] in the frame of the map, in the order of the drive.
        scans: [K].
    """

    lidar: Lidar
    poses: np.ndarray
    scans: Scan


class FoundPlaces(NamedTuple):
    """N hypotheses: places found, of either map in the other.

    Attributes:
        query: (N,) number of the query; each has several.
        weight: (N,) score above the least one.
        first: (N, 3) pose in the frame of the first map.
        second: (N, 3) the same in that of the second.
    """

    query: np.ndarray
    weight: np.ndarray
    first: np.ndarray
    second: np.ndarray

    @property
    def transforms(self) -> np.ndarray:
        """(N, 3) frame of the second map, in that of the first."""
        return compose(self.first, relative(self.second, np.zeros(3)))


def check_join_spec(spec: JoinSpec) -> None:
    """Check the options of joining.

    Raises:
        ValueError: One is out of range; the message names it.
    """
    checks.check_static("spec", spec, JoinSpec)
    check_place_spec(spec.place)
    for field in ("query_spacing", "window"):
        checks.check_positive(f"spec.{field}", getattr(spec, field))
    for field in ("max_queries", "window_scans", "num_hypotheses", "min_places"):
        checks.check_at_least(f"spec.{field}", getattr(spec, field), 1)


def as_scan_map(name: str, given: ScanMap) -> ScanMap:
    """A map in NumPy arrays, checked."""
    checks.check_static(f"{name}.lidar", given.lidar, Lidar)
    check_lidar(given.lidar)
    poses = as_float64(f"{name}.poses", given.poses, ("K", 3))
    scans = checks.as_scans(f"{name}.scans", given.lidar, given.scans, (len(poses),))
    if not len(poses) or not np.isfinite(poses).all():
        raise ValueError(f"{name}.poses are those of no keyframe, or not finite")
    return ScanMap(given.lidar, poses, jax.tree.map(np.asarray, scans))


def places_between(spec: JoinSpec, first: ScanMap, second: ScanMap) -> FoundPlaces:
    """All places of either map that are found in the other."""
    parts, num_queries = [], 0
    for swapped, (own, other) in enumerate(((second, first), (first, second))):
        keyframes = query_keyframes(spec, own.poses)
        index = build_index(spec.place, other.lidar, other.poses, other.scans)
        number, weight, found = places_of(spec, index, own, keyframes)
        ends = found, own.poses[keyframes[number]]
        in_first, in_second = ends[::-1] if swapped else ends
        parts.append(FoundPlaces(num_queries + number, weight, in_first, in_second))
        num_queries += len(keyframes)
    return FoundPlaces(*map(np.concatenate, zip(*parts, strict=True)))


def query_keyframes(spec: JoinSpec, poses: np.ndarray) -> np.ndarray:
    """Keyframes (Q,) int that are looked for, evenly spaced along the drive."""
    driven = distance_driven(poses)
    spacing = max(spec.query_spacing, driven[-1] / spec.max_queries)
    return np.unique(np.floor(driven / spacing), return_index=True)[1]


def distance_driven(poses: np.ndarray) -> np.ndarray:
    """(K,) [m] driven up to each pose."""
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))


def places_of(
    spec: JoinSpec, index: PlaceIndex, own: ScanMap, keyframes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of keyframes (Q,) in another map: numbers 0 .. Q - 1 (N,), weights (N,), poses (N, 3).

    Each keyframe has several, or none; the weight is that of `FoundPlaces`.
    """
    driven, poses, scores = distance_driven(own.poses), [], []
    for keyframe in keyframes.tolist():
        first, last = np.searchsorted(
            driven, driven[keyframe] + spec.window * np.array([-1.0, 1.0]), side="right"
        )
        some = np.linspace(first, last - 1, spec.window_scans - 1).round().astype(int)
        window = np.append(some.clip(0, len(driven) - 1), keyframe)
        around = relative(own.poses[keyframe], own.poses[window])
        scans = on_device(jax.tree.map(lambda x, window=window: x[window], own.scans))
        found = _look_for(spec.place, own.lidar, index, scans, on_device(around))
        poses.append(np.asarray(found[0], float))
        scores.append(np.asarray(found[1], float))
    score = np.stack(scores)
    number, candidate = np.nonzero(score > MIN_PLACE_SCORE)
    weight = score[number, candidate] - MIN_PLACE_SCORE
    return number, weight, np.stack(poses)[number, candidate]


@partial(trace_cache.jit, static_argnames=("spec", "lidar"))
def _look_for(
    spec: PlaceSpec, lidar: Lidar, index: PlaceIndex, scans: Scan, poses: Array
) -> tuple[Array, Array]:
    """Poses (C, 3) and scores (C,) of the places of a query of scans [W] at poses (W, 3)."""
    places = find_places(spec, index, make_query(spec, lidar, scans, poses))
    return places.poses, places.score


def consistent_sets(spec: JoinSpec, found: FoundPlaces) -> list[np.ndarray]:
    """Sets of hypotheses that agree with one of them, of different transforms, the best first."""
    transforms = found.transforms
    sets: list[np.ndarray] = []
    if not len(transforms):
        return []
    expected = compose(transforms[:, None], found.second[None])  # (i, j): place j by transform i
    off = relative(expected, found.first[None])
    apart = scipy.spatial.distance.cdist(found.second[:, :2], found.second[:, :2])
    limit = DRIFT[0] + DRIFT[1] * apart
    agrees = (np.hypot(off[..., 0], off[..., 1]) < limit) & (np.abs(off[..., 2]) < MAX_TURN)
    by_query = np.zeros((len(transforms), found.query.max() + 1))
    for k, query in enumerate(found.query.tolist()):  # each query counts once
        by_query[:, query] = np.maximum(by_query[:, query], agrees[:, k] * found.weight[k])
    support, left = by_query.sum(axis=1), np.ones(len(transforms), bool)
    while left.any() and len(sets) < spec.num_hypotheses:
        best = int(np.argmax(np.where(left, support, -np.inf)))
        sets.append(np.flatnonzero(agrees[best]))
        place = found.second[best]
        off = relative(compose(transforms[best], place), compose(transforms, place[None]))
        same = np.hypot(off[:, 0], off[:, 1]) < SAME_TRANSFORM
        left &= ~(same & (np.abs(off[:, 2]) < 2.0 * MAX_TURN))
    return sets


def fit_transform(own: np.ndarray, other: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Rigid transform (3,) [m, m, rad] that takes poses (N, 3) to others (N, 3), least squares.

    Headings count as the positions of points `HEADING_ARM` ahead do.

    Args:
        own: In the frame that is transformed.
        other: The same in the frame of the transform.
        weight: (N,) not negative, not all zero.
    """
    share = weight / np.sum(weight)
    centre, goal = share @ own[:, :2], share @ other[:, :2]
    a, b = own[:, :2] - centre, other[:, :2] - goal
    turn = other[:, 2] - own[:, 2]
    sine = share @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] + HEADING_ARM**2 * np.sin(turn))
    cosine = share @ (np.sum(a * b, axis=1) + HEADING_ARM**2 * np.cos(turn))
    heading = np.arctan2(sine, cosine)
    offset = goal - transform(np.array([0.0, 0.0, heading]), centre)
    return np.append(offset, heading)


def span_of(poses: np.ndarray) -> float:
    """[m] largest distance between two of poses (N, 3); zero without two."""
    return float(scipy.spatial.distance.pdist(poses[:, :2]).max(initial=0.0))


def transforms_near(found: FoundPlaces, poses: np.ndarray) -> np.ndarray:
    """Transforms (K, 3) of a set of hypotheses at poses (K, 3) of the second map.

    Each is that of the places near the one that is nearest: where maps have drifted, one transform
    does not hold all over.
    """
    near = scipy.spatial.distance.cdist(found.second[:, :2], found.second[:, :2]) < NEAR
    own = [fit_transform(found.second[k], found.first[k], found.weight[k]) for k in near]
    nearest = scipy.spatial.cKDTree(found.second[:, :2]).query(poses[:, :2])[1]
    return np.stack(own)[nearest]
