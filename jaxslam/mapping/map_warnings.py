"""Where a run is lost: the rules that turn contradictions between scans into warnings."""

from typing import NamedTuple

import numpy as np

from jaxslam.matching.scan_agreement import CONTRADICTED, Agreement, PosedScans

BROKEN_CONTRADICTION = 0.32  # of a step; people who walk about make less
BROKEN_CONFIRMATION = 0.08  # of a step, of what is in view; less is another place
SAME_BREAK = 0.7  # steps with this fraction of the contradiction of a broken one belong to it
USUAL_CONTRADICTION = 0.25  # of two visits, by doors and furniture that were moved
ALARM, MAX_ALARM = 1.5, 3.0  # sums of contradiction beyond the usual one: of a warning, and at most
VISIT_SEPARATION = 10.0  # [m] of path between two visits


class MapWarning(NamedTuple):
    """A part of a run where the map contradicts itself.

    Attributes:
        first_scan: Number of its first scan in the log.
        last_scan: Number of its last scan.
        x: [m] where it is worst, map frame.
        y: [m] likewise.
        reason: What is wrong, in words.
    """

    first_scan: int
    last_scan: int
    x: float
    y: float
    reason: str

    def __str__(self) -> str:
        """The warning as one sentence that names scans and place."""
        scans = f"scans {self.first_scan}-{self.last_scan}"
        return f"{scans} near ({self.x:.1f}, {self.y:.1f}) m {self.reason}"


def step_warnings(
    posed: PosedScans, contradiction: np.ndarray, confirmation: np.ndarray
) -> list[MapWarning]:
    """Warnings of steps across which the scans do not fit each other.

    Args:
        posed: K scans.
        contradiction: (K - 1,) as in `MapConsistency`.
        confirmation: (K - 1,) likewise.
    """
    warnings, contradicted = [], np.nan_to_num(contradiction)
    for start, stop in _runs(contradicted > BROKEN_CONTRADICTION):
        worst = contradicted[start:stop].max()
        broken = start + np.flatnonzero(contradicted[start:stop] > SAME_BREAK * worst)
        reason = f"do not fit the scans before them: {worst:.0%} of the walls that either saw are"
        reason += " where the other saw free space"
        at = start + int(np.argmax(contradicted[start:stop]))
        warnings.append(_warning(posed, broken[0], broken[-1] + 1, at, reason))
    for start, stop in _runs(np.nan_to_num(confirmation, nan=1.0) < BROKEN_CONFIRMATION):
        if contradicted[start:stop].max() <= BROKEN_CONTRADICTION:
            reason = "do not fit the scans before them: hardly any wall is seen by both"
            warnings.append(_warning(posed, start, stop, start, reason))
    return warnings


def visit_warnings(
    posed: PosedScans, pairs: np.ndarray, found: Agreement, contradiction: np.ndarray
) -> list[MapWarning]:
    """Warnings of successive scans that contradict earlier visits, by a CUSUM test.

    Where they are more than `VISIT_SEPARATION` apart they are different warnings.

    Args:
        posed: K scans.
        pairs: (P, 2) int indices of a scan and of one of an earlier visit.
        found: [P] their comparison.
        contradiction: (K,) as in `MapConsistency`.
    """
    warnings, compared = [], np.flatnonzero(np.isfinite(contradiction))
    total = np.zeros(len(compared) + 1)  # 0 after the last
    for k, excess in enumerate(contradiction[compared] - USUAL_CONTRADICTION):
        total[k] = min(MAX_ALARM, max(0.0, total[k - 1] + excess))
    for start, stop in _runs(total > 0.0):
        if total[start:stop].max() > ALARM:
            scans = compared[start:stop]
            scans = scans[contradiction[scans] > USUAL_CONTRADICTION]
            apart = np.diff(posed.travelled[scans]) > VISIT_SEPARATION
            for part in np.split(scans, np.flatnonzero(apart) + 1):
                warnings.append(_visit_warning(posed, pairs, found, part))
    return warnings


def _visit_warning(
    posed: PosedScans, pairs: np.ndarray, found: Agreement, scans: np.ndarray
) -> MapWarning:
    """The warning of scans that contradict earlier visits, placed where they do so most."""
    own = np.flatnonzero(np.isin(pairs[:, 0], scans))
    bad = found.state[own] == CONTRADICTED
    apart = np.median(found.distance[own][bad])
    at, other = pairs[own[np.argmax(bad.sum(axis=(1, 2)))]]
    reason = f"see walls {apart:.1f} m from where scan {posed.number[other]} saw them"
    return _warning(posed, scans[0], scans[-1], at, reason)


def _warning(posed: PosedScans, first: int, last: int, at: int, reason: str) -> MapWarning:
    """A warning of the scans from index `first` to `last`, with the place of scan `at`."""
    x, y = posed.poses[at, :2].tolist()
    return MapWarning(int(posed.number[first]), int(posed.number[last]), x, y, reason)


def _runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """First index, and index after the last, of each run of True in flags (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(first, stop) for first, stop in edges.reshape(-1, 2).tolist()]
