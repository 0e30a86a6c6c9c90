"""What `localisation` counts: when a robot was found, how well it was tracked, wrong but sure."""

from typing import NamedTuple

import numpy as np

from experiments.common import Numbers
from experiments.localisation_drives import FOUND_WITHIN
from experiments.map_warnings import wilson_interval
from jaxslam.localisation.probability import RIGHT

STAYS = 10.0  # [m] of driving up to which a pose must stay right
BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.9, 0.95, 0.99)  # of the probability
QUANTILES = np.linspace(0.0, 1.0, 41)


class Tracks(NamedTuple):
    """What a method said on B drives of T scans.

    Attributes:
        position_error: (B, T) [m].
        heading_error: (B, T) [rad].
        probability: (B, T) that the pose is right; 0 or 1 of a method that has none.
        sure: (B, T) bool.
        driven: (B, T) [m] since the drive began.
        exists: (B, T) bool, whether there is a scan, and its true pose is known.
        inside: (B, T) bool, whether the map shows where it was taken.
    """

    position_error: np.ndarray
    heading_error: np.ndarray
    probability: np.ndarray
    sure: np.ndarray
    driven: np.ndarray
    exists: np.ndarray
    inside: np.ndarray

    @property
    def right(self) -> np.ndarray:
        """Whether a pose is right (B, T)."""
        return (self.position_error < RIGHT[0]) & (self.heading_error < RIGHT[1])


def split(tracks: Tracks, carried_at: np.ndarray) -> tuple[Tracks, Tracks]:
    """The drives before the robots were carried at scans (B,), and after it; each from 0 m on."""
    length = tracks.exists.shape[1]
    number = np.arange(length)[None]
    before = tracks._replace(exists=tracks.exists & (number < carried_at[:, None]))
    shifted = number + carried_at[:, None]
    rows = np.arange(len(carried_at))[:, None]
    after = Tracks(*(x[rows, np.minimum(shifted, length - 1)] for x in tracks))
    return before, after._replace(
        exists=after.exists & (shifted < length), driven=after.driven - after.driven[:, :1]
    )


def found_at(tracks: Tracks) -> np.ndarray:
    """Metres driven (B,) until the pose is right, and stays right; inf where it never does.

    It must stay right, wherever the map shows the robot, until it has driven 10 m, or 5 m more if
    these are more, or to the end.
    """
    right, counts = tracks.right, tracks.exists & tracks.inside
    result = np.full(len(right), np.inf)
    for k, driven in enumerate(tracks.driven):
        for t in np.flatnonzero(right[k] & counts[k]):
            until = max(STAYS, driven[t] + FOUND_WITHIN)
            later = counts[k, t:] & (driven[t:] <= until)
            if right[k, t:][later].all():
                result[k] = driven[t]
                break
    return result


def summary(tracks: Tracks) -> Numbers:
    """All numbers of some drives; lengths in m, angles in degrees."""
    right, exists, sure = tracks.right, tracks.exists, tracks.sure & tracks.exists
    metres = found_at(tracks)
    within = exists & tracks.inside & (tracks.driven <= FOUND_WITHIN)
    tracked = sure & right
    wrong = sure & ~right
    low, high = wilson_interval(int(wrong.sum()), int(sure.sum()))
    median, last = (_finite(np.quantile(metres, q, method="higher")) for q in (0.5, 0.95))
    position, heading = tracks.position_error[tracked], np.degrees(tracks.heading_error[tracked])
    return {
        "starts": len(metres),
        "found_at_m": [_finite(x) for x in metres],
        "found_within_5_m": float((metres <= FOUND_WITHIN).mean()),
        "found_interval": wilson_interval(int((metres <= FOUND_WITHIN).sum()), len(metres)),
        "sure_within_5_m": float((tracked & within).any(axis=1).mean()),
        "found_at_median_m": median,
        "found_at_95_m": last,
        "steps": int(exists.sum()),
        "sure": int(sure.sum()),
        "wrong_but_sure": int(wrong.sum()),
        "wrong_but_sure_share": float(wrong.sum() / sure.sum()) if sure.any() else None,
        "wrong_but_sure_interval": [low, high],
        "drives_wrong_but_sure": int(wrong.any(axis=1).sum()),
        "position_m": _quantiles(position),
        "heading_deg": _quantiles(heading),
    }


def reliability(tracks: Tracks) -> list[Numbers]:
    """For each bin of the probability: number of steps, mean probability, share that is right."""
    probability, right = tracks.probability[tracks.exists], tracks.right[tracks.exists]
    number = np.digitize(probability, BINS) - 1
    rows = []
    for k, low in enumerate(BINS):
        own = number == k
        some = bool(own.any())
        rows.append(
            {
                "from": low,
                "steps": int(own.sum()),
                "probability": float(probability[own].mean()) if some else None,
                "right": float(right[own].mean()) if some else None,
            }
        )
    return rows


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _quantiles(values: np.ndarray) -> list[float] | None:
    return np.quantile(values, QUANTILES).tolist() if len(values) else None
