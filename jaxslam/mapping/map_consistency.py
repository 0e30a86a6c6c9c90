"""Whether the scans of a run agree with the map that all others make: it knows when it is lost."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.se2_np import wrap_angle
from jaxslam.core.types import as_float64, check_array
from jaxslam.mapping import map_warnings
from jaxslam.mapping.map_warnings import USUAL_CONTRADICTION, VISIT_SEPARATION, MapWarning
from jaxslam.matching.scan_agreement import (
    CONFIRMED,
    CONTRADICTED,
    HIDDEN,
    Agreement,
    PosedScans,
    ScanComparison,
    posed_scans,
)

NUM_NEIGHBOURS = 3  # scans on either side of a step that are compared across it
VISIT_RADIUS = 4.0  # [m] between scans of two visits to one place
MAX_VISITS = 4  # that a scan is compared with
MAX_WALL_DISTANCE = 1.0  # [m] between walls that may be the same


class MapConsistency(NamedTuple):
    """Agreement of K scans, at least 0.2 m or 0.2 rad apart, with the map that all others make.

    Contradiction is the share of ends of beams that lie where another scan sees free space, among
    those that another scan confirms or contradicts. NaN stands where hardly any can be compared.

    Attributes:
        scan: (K,) int number of each in the log.
        poses: (K, 3) [m, m, rad] of each, map frame.
        step_contradiction: (K - 1,) of the scans just before and just after the step from each scan
            to the next.
        step_confirmation: (K - 1,) share of ends that the two scans confirm, of all in view of the
            other, the hidden ones included.
        visit_contradiction: (K,) of a scan and one of an earlier visit, the largest of all visits.
        wall_distance: (N,) [m] from ends of beams to the walls that another visit saw, below 1.
        warnings: In the order of the scans.
    """

    scan: np.ndarray
    poses: np.ndarray
    step_contradiction: np.ndarray
    step_confirmation: np.ndarray
    visit_contradiction: np.ndarray
    wall_distance: np.ndarray
    warnings: tuple[MapWarning, ...]

    @property
    def explained(self) -> np.ndarray:
        """Whether (K,) neither its neighbours nor an earlier visit contradict a scan."""
        step = np.nan_to_num(self.step_contradiction)
        worst = np.maximum(np.append(step, 0.0), np.append(0.0, step))
        worst = np.maximum(worst, np.nan_to_num(self.visit_contradiction))
        return worst <= USUAL_CONTRADICTION

    def metrics(self) -> dict[str, Any]:
        """The content of the key `map_consistency` of `metrics.json`."""
        median, p90 = None, None
        if self.wall_distance.size:
            median, p90 = np.quantile(self.wall_distance, [0.5, 0.9]).tolist()
        return {
            "explained": float(np.mean(self.explained)) if len(self.scan) else None,
            "walls_median_m": median,
            "walls_p90_m": p90,
            "warnings": [
                {"first_scan": w.first_scan, "last_scan": w.last_scan, "reason": str(w)}
                for w in self.warnings
            ],
        }


def check_map(
    lidar: Lidar,
    poses: ArrayLike,
    scans: Scan,
    *,
    piece: ArrayLike | None = None,
    since: int = 0,
) -> MapConsistency:
    """Compare each scan with its neighbours in time and with other visits to the same place.

    No reference is needed. Two scans contradict each other where a beam of one ends in what the
    other sees to be free. A lost heading, or a robot that was carried, shows between neighbours,
    even if no place is visited twice. Drift shows as walls that two visits see apart: there the
    contradiction beyond the usual one is summed over successive scans, as in Page's CUSUM test,

        S_t = min(MAX_ALARM, max(0, S_t-1 + contradiction_t - USUAL_CONTRADICTION))

    with a warning if S exceeds `ALARM`; the part of the run begins and ends where S is 0. What no
    two scans see from both sides stays unknown: along a bare corridor, or on a drive that never
    returns, a slow drift is not found.

    Args:
        lidar: The scanner.
        poses: (T, 3) [m, m, rad] of the scanner in the order of time, map frame; those that are not
            finite are left out.
        scans: [T].
        piece: (T,) int piece of a broken drive that each scan is in, as `SlamResult.piece`: across
            a break, neighbours show different places. None for one drive.
        since: Number of the first scan whose visits are checked: scans before it are earlier ones.

    Raises:
        ValueError: The scanner is impossible, no pose is finite, or shapes do not fit.

    References:
        Page (1954), Continuous inspection schemes.
    """
    check_lidar(lidar)
    poses = as_float64("poses", poses, ("T", 3))
    shape = len(poses), lidar.num_beams
    ranges, hit = as_float64("scans.ranges", scans.ranges, shape), np.asarray(scans.hit)
    check_array("scans.hit", hit, shape, jnp.bool_)
    piece = np.zeros(len(poses), int) if piece is None else np.asarray(piece)
    check_array("piece", piece, (len(poses),), jnp.integer)
    finite = np.flatnonzero(np.isfinite(poses).all(axis=1))
    if not finite.size:
        raise ValueError("poses: no pose is finite")
    posed = posed_scans(lidar, poses[finite], ranges[finite], hit[finite])
    posed = posed._replace(number=finite[posed.number])
    comparison, num_scans = ScanComparison(posed), len(posed.number)
    of_scan = piece[posed.number]
    steps, visits = _neighbours(num_scans), _earlier_visits(posed, of_scan)
    visits = visits[posed.number[visits[:, 0]] >= since]
    by_step, by_visit = comparison.compare(*steps.T), comparison.compare(*visits.T)
    by_step = by_step.of_pairs(of_scan[steps[:, 0]] == of_scan[steps[:, 1]])
    before, after = _lasting(steps, by_step, num_scans)
    step_contradiction, step_confirmation = _across_steps(steps, by_step, before, after)
    lasting = before | after
    by_visit = by_visit.only(lasting[visits[:, 0]], lasting[visits[:, 1]])
    visit_contradiction = np.full(num_scans, np.nan)
    np.fmax.at(visit_contradiction, visits[:, 0], by_visit.contradiction())
    warnings = map_warnings.step_warnings(posed, step_contradiction, step_confirmation)
    warnings += map_warnings.visit_warnings(posed, visits, by_visit, visit_contradiction)
    return MapConsistency(
        scan=posed.number,
        poses=posed.poses,
        step_contradiction=step_contradiction,
        step_confirmation=step_confirmation,
        visit_contradiction=visit_contradiction,
        wall_distance=by_visit.distance[by_visit.distance < MAX_WALL_DISTANCE],
        warnings=tuple(sorted(warnings)),
    )


def _neighbours(num_scans: int) -> np.ndarray:
    """Pairs (P, 2) of scans at most `NUM_NEIGHBOURS` apart in time."""
    first = np.arange(num_scans)
    pairs = [np.stack([first, first + k], axis=1) for k in range(1, NUM_NEIGHBOURS + 1)]
    every = np.concatenate(pairs)
    return every[every[:, 1] < num_scans]


def _earlier_visits(posed: PosedScans, piece: np.ndarray) -> np.ndarray:
    """Pairs (P, 2) of a scan and the scan of an earlier visit that is most like it in pose.

    Args:
        posed: K scans.
        piece: (K,) int piece of the drive of each; another piece is another visit.
    """
    pairs = []
    near = cKDTree(posed.poses[:, :2]).query_ball_point(posed.poses[:, :2], VISIT_RADIUS)
    for scan, others in enumerate(near):
        earlier = np.sort(np.array(others))
        path = posed.travelled[scan] - posed.travelled[earlier]
        other = (path > VISIT_SEPARATION) | (piece[earlier] != piece[scan])
        earlier = earlier[(earlier < scan) & other]
        visit = np.cumsum(np.diff(earlier, prepend=earlier[:1]) > NUM_NEIGHBOURS)
        offset = posed.poses[earlier] - posed.poses[scan]
        cost = np.hypot(offset[:, 0], offset[:, 1]) + 0.5 * np.abs(wrap_angle(offset[:, 2]))
        order = np.argsort(cost)
        best = np.sort(np.unique(visit[order], return_index=True)[1])[:MAX_VISITS]
        pairs += [(scan, other) for other in earlier[order[best]].tolist()]
    return np.array(pairs, int).reshape(-1, 2)


def _lasting(pairs: np.ndarray, found: Agreement, num_scans: int) -> tuple[np.ndarray, np.ndarray]:
    """Whether ends (K, Q) are confirmed by a scan just before, and by one just after.

    People who walk about are not.
    """
    before, after = np.zeros((2, num_scans, found.state.shape[2]), bool)
    np.logical_or.at(after, pairs[:, 0], found.state[:, 0] == CONFIRMED)
    np.logical_or.at(before, pairs[:, 1], found.state[:, 1] == CONFIRMED)
    return before, after


def _across_steps(
    pairs: np.ndarray, found: Agreement, before: np.ndarray, after: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Contradiction and confirmation (K - 1,) of each step.

    A step's contradiction is that of all pairs of a scan before and a scan after it together, by
    the ends that last on their own side of the step; by all ends where too few last. Its
    confirmation is that of the two scans beside it.

    Args:
        pairs: (P, 2) int indices of neighbours, those of successive scans first.
        found: [P] their comparison.
        before: (K, Q) bool as of `_lasting`.
        after: (K, Q) bool likewise.
    """
    num_steps = len(before) - 1

    def contradiction(found: Agreement) -> np.ndarray:
        counts = np.zeros((2, num_steps))
        bad, all_compared = found.num_ends(CONTRADICTED), found.num_ends(CONFIRMED, CONTRADICTED)
        for late in range(NUM_NEIGHBOURS):
            across = pairs[:, 1] - pairs[:, 0] > late
            step = pairs[across, 0] + late
            np.add.at(counts[0], step, bad[across])
            np.add.at(counts[1], step, all_compared[across])
        return found.share(*counts)

    of_lasting = contradiction(found.only(before[pairs[:, 0]], after[pairs[:, 1]]))
    in_view = found.num_ends(CONFIRMED, CONTRADICTED, HIDDEN)
    confirmation = found.share(found.num_ends(CONFIRMED), in_view)[:num_steps]
    return np.where(np.isnan(of_lasting), contradiction(found), of_lasting), confirmation
