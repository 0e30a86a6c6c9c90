"""How well scans at known poses agree: walls that are seen again, free space that is not free."""

import math
from typing import NamedTuple, Self

import numpy as np
import scipy

from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import inverse_transform, transform

STEP, TURN = 0.2, 0.2  # [m], [rad] of motion between the scans that are compared, at least
MAX_SCANS = 12_000  # that are compared; of longer logs every second of them, and so on
MAX_BEAMS = 180  # of a scan that are used
END_STRIDE = 2  # of them, every second end is compared with the beams of the other scan
MIN_RANGE, MAX_RANGE = 0.3, 12.0  # [m] nearer may be the robot itself, farther hangs on its heading
WALL_TOLERANCE = 0.15  # [m] from a wall within which an end confirms it
FREE_MARGIN, FREE_MARGIN_SLOPE = 0.3, 0.01  # [m], [m/m of range] from walls to what is surely free
MAX_GAP = 1.0  # [m] between neighbouring ends on one wall
MAX_DISTANCE = 2.0  # [m] beyond which no nearest wall is searched for
PAIRS_AT_ONCE = 2048  # bounds the memory
SEPARATION = 1e4  # [m] between scans along the third axis of the search tree

OUT_OF_VIEW, CONFIRMED, CONTRADICTED, HIDDEN, CLOSE = range(5)
"""States of the end of a beam in the view of another scan: see `Agreement`."""


class PosedScans(NamedTuple):
    """K scans of a log at known poses, R beams of each.

    Attributes:
        number: (K,) int number of each scan in the log.
        poses: (K, 3) [m, m, rad], map frame.
        travelled: (K,) [m] path length up to each scan.
        angles: (R,) [rad] of the beams, robot frame.
        ranges: (K, R) [m]; NaN where a beam is not used.
        ends: (K, R, 2) [m] ends of the beams, map frame; NaN where a beam is not used.
    """

    number: np.ndarray
    poses: np.ndarray
    travelled: np.ndarray
    angles: np.ndarray
    ranges: np.ndarray
    ends: np.ndarray

    def only(self, kept: np.ndarray) -> Self:
        """Some of the scans, by a mask (K,) or by their indices."""
        rows = {name: getattr(self, name)[kept] for name in self._fields if name != "angles"}
        return self._replace(**rows)


class Agreement(NamedTuple):
    """P pairs of scans compared: Q ends of either's beams, in the view of the other scan.

    An end is in view between two beams of the other scan that both returned. Beams without a return
    show nothing: they may have passed glass.

    Attributes:
        state: (P, 2, Q) int8 of the ends of the first and of the second scans: `OUT_OF_VIEW`;
            `CONFIRMED`, on a wall that the other scan sees; `CONTRADICTED`, where the other scan
            sees free space; `HIDDEN` behind what it sees; or `CLOSE`, about where it sees a wall.
        distance: (P, 2, Q) float32 [m] to the nearest wall that the other scan sees, at most
            `MAX_DISTANCE`; NaN for ends that are hidden or out of view.
    """

    state: np.ndarray
    distance: np.ndarray

    def num_ends(self, *states: int) -> np.ndarray:
        """Number (P,) of ends in these states."""
        return np.isin(self.state, states).sum(axis=(1, 2))

    def contradiction(self) -> np.ndarray:
        """Share (P,) of contradicted ends among those and the confirmed ones; NaN if few."""
        compared = self.num_ends(CONFIRMED, CONTRADICTED)
        return self.share(self.num_ends(CONTRADICTED), compared)

    def share(self, part: np.ndarray, whole: np.ndarray) -> np.ndarray:
        """Part of a number of ends; NaN if that is less than a fifth of those of two scans."""
        enough = whole >= 0.2 * 2 * self.state.shape[2]
        return np.where(enough, part / np.maximum(whole, 1), np.nan)

    def of_pairs(self, kept: np.ndarray) -> Self:
        """The comparison of the pairs (P,) that are True; of the others nothing is in view."""
        return self.only(kept[:, None], kept[:, None])

    def only(self, first: np.ndarray, second: np.ndarray) -> Self:
        """The comparison of ends (P, Q or 1) of the first and of the second scans that are True."""
        kept = np.stack([first, second], axis=1)
        return self._replace(
            state=np.where(kept, self.state, OUT_OF_VIEW),
            distance=np.where(kept, self.distance, np.nan),
        )


def posed_scans(lidar: Lidar, poses: np.ndarray, ranges: np.ndarray, hit: np.ndarray) -> PosedScans:
    """The scans of a log that are `STEP` or `TURN` apart, with at most `MAX_BEAMS` beams.

    Args:
        lidar: The scanner.
        poses: (T, 3) [m, m, rad] finite poses of the scanner in the order of time, map frame.
        ranges: (T, R') [m] of all its beams.
        hit: (T, R') bool, False where nothing returned.
    """
    number = moved(poses)
    number = number[:: -(-len(number) // MAX_SCANS)]
    beams = np.arange(0, lidar.num_beams, -(-lidar.num_beams // MAX_BEAMS))
    angles = lidar.angle_min + lidar.angle_increment * beams
    chosen = np.ix_(number, beams)
    ranges = ranges[chosen].astype(np.float64)
    ranges[~hit[chosen] | (ranges < MIN_RANGE) | (ranges > MAX_RANGE)] = np.nan
    offsets = ranges[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    ends = transform(poses[number, None], offsets)
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    travelled = np.append(0.0, np.cumsum(steps))[number]
    return PosedScans(number, poses[number], travelled, angles, ranges, ends)


def moved(poses: np.ndarray) -> np.ndarray:
    """Numbers (K,) of the first of poses (T, 3) and of those `STEP` or `TURN` from the last."""
    numbers, last = [0], poses[0].tolist()
    for number, (x, y, heading) in enumerate(poses.tolist()):
        turned = abs(math.remainder(heading - last[2], 2 * math.pi))
        if math.hypot(x - last[0], y - last[1]) >= STEP or turned >= TURN:
            numbers.append(number)
            last = x, y, heading
    return np.array(numbers)


class ScanComparison:
    """Compares pairs of scans by the ends of their beams."""

    def __init__(self, posed: PosedScans):
        """Prepare the search for the end of a scan that is nearest to a point.

        One tree holds the ends of all scans, which are kept apart along a third axis.
        """
        self._posed = posed
        scan, beam = np.nonzero(np.isfinite(posed.ranges))
        separated = np.column_stack([posed.ends[scan, beam], SEPARATION * scan])
        self._tree = scipy.spatial.cKDTree(separated)

    def compare(self, first: np.ndarray, second: np.ndarray) -> Agreement:
        """Compare scans `first` (P,) with scans `second` (P,), indices into the posed scans."""
        parts = []
        for k in range(0, max(1, len(first)), PAIRS_AT_ONCE):
            one, other = first[k : k + PAIRS_AT_ONCE], second[k : k + PAIRS_AT_ONCE]
            both = self._ends_in_view(other, one), self._ends_in_view(one, other)
            parts.append([np.stack(x, axis=1) for x in zip(*both, strict=True)])
        return Agreement(*map(np.concatenate, zip(*parts, strict=True)))

    def _ends_in_view(self, viewer: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States and distances of the ends of scans `seen` (P,) in the view of `viewer` (P,).

                  o right      An end lies between two beams of the viewer, `left` and `right`.
           end   /             It is confirmed near the line through their ends, hidden beyond
            x   /              both of them, and contradicted before both if no other end of the
         o-----'               viewer is near.
        left      viewer is far below
        """
        posed, row = self._posed, viewer[:, None]
        ends = posed.ends[seen, ::END_STRIDE]
        point = inverse_transform(posed.poses[row], ends)
        range_of_end = np.hypot(point[..., 0], point[..., 1])
        bearing = np.arctan2(point[..., 1], point[..., 0]) - posed.angles[0]
        count, step = len(posed.angles), posed.angles[1] - posed.angles[0]
        is_full_turn = (count + 0.5) * step > 2 * np.pi  # the first beam follows the last
        beam = np.mod(bearing, 2 * np.pi) / step
        within = beam < (count if is_full_turn else count - 1)  # False for NaN
        left = np.where(within, beam, 0.0).astype(int)
        right = (left + 1) % count
        left_range, right_range = posed.ranges[row, left], posed.ranges[row, right]
        in_view = within & np.isfinite(left_range + right_range)
        wall, offset = posed.ends[row, right], ends - posed.ends[row, left]
        wall = wall - posed.ends[row, left]
        gap = np.maximum(np.hypot(wall[..., 0], wall[..., 1]), 1e-9)
        distance = np.abs(wall[..., 0] * offset[..., 1] - wall[..., 1] * offset[..., 0]) / gap
        distance[gap > MAX_GAP] = MAX_DISTANCE  # the two ends are not on one wall
        margin = FREE_MARGIN + FREE_MARGIN_SLOPE * range_of_end
        beyond = range_of_end - np.maximum(left_range, right_range)
        before = np.minimum(left_range, right_range) - range_of_end
        state = np.where(in_view, CLOSE, OUT_OF_VIEW).astype(np.int8)
        state[in_view & (distance < WALL_TOLERANCE) & (beyond < gap + margin)] = CONFIRMED
        state[in_view & (distance >= WALL_TOLERANCE) & (beyond > margin)] = HIDDEN
        pair, index = np.nonzero(in_view & (before > margin) & (distance > margin))
        query = np.column_stack([ends[pair, index], SEPARATION * viewer[pair]])
        nearest = self._tree.query(query, distance_upper_bound=MAX_DISTANCE)[0]
        distance[pair, index] = np.minimum(nearest, MAX_DISTANCE)
        state[pair, index] = np.where(
            nearest > margin[pair, index],
            CONTRADICTED,
            np.where(nearest < WALL_TOLERANCE, CONFIRMED, CLOSE),
        )
        distance[(state == OUT_OF_VIEW) | (state == HIDDEN)] = np.nan
        return state, distance.astype(np.float32)
