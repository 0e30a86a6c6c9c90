"""What is wrong with the odometry of a log, as the scans show it: lines to be printed."""

import numpy as np

from jaxslam.core.measurement import ScanMatch
from jaxslam.core.scan import Scan
from jaxslam.matching.latched_odometry import share_out_leaps

MIN_WRONG_SCALE = 0.025  # of the wheels' distances, from which it is noted
MIRRORED = 0.5  # error of a distance, of itself, up to which it is the wheels' but for the sign
MIN_MIRRORED = 5  # scans from which on such wheels are noted
MIN_CONTRADICTED = 0.01  # fraction of the scans from which contradictions are noted


def share_out(
    odometry: np.ndarray, scans: Scan, unknown: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Odometry (T, 3) whose leaps are shared out, its shares (T,), and a note if there are any."""
    odometry, is_share, num_leaps = share_out_leaps(odometry, scans, unknown)
    leaps = "1 leap" if num_leaps == 1 else f"{num_leaps} leaps"
    note = f"{leaps} after latched poses shared out over the scans before"
    return odometry, is_share, (note,) if num_leaps else ()


def contradictions(matches: ScanMatch) -> tuple[str, ...]:
    """A note if scans [T] contradict the odometry more than now and then."""
    weight = np.asarray(matches.odometry_weight)
    contradicted = int(np.sum(weight < 0.5))
    if contradicted < MIN_CONTRADICTED * len(weight):
        return ()
    note = f"contradicted by scan matching at {contradicted} of {len(weight)} scans"
    return (f"{note}, where it is not used",)


def unsigned(matches: ScanMatch, odometry: np.ndarray) -> tuple[str, ...]:
    """A note if at most of the scans [T] that contradict the wheels, these have the wrong sign.

    Args:
        matches: Of all scans.
        odometry: (T, 3) [m, m, rad] increments by the wheels.
    """
    contradicted = np.asarray(matches.odometry_weight) < 0.5
    wheels, found = odometry[:, 0], np.asarray(matches.increment, float)[:, 0]
    mirrored = (wheels > 0.0) & (np.abs(found + wheels) < MIRRORED * wheels)
    num_mirrored = int(np.sum(contradicted & mirrored))
    if num_mirrored < max(MIN_MIRRORED, int(np.sum(contradicted)) / 2):
        return ()
    return (f"wheels report driving backwards as driving forwards at {num_mirrored} scans",)


def wrong_scale(matches: ScanMatch, odometry: np.ndarray) -> tuple[str, ...]:
    """A note if scans show that the wheels report distances clearly too long or too short.

    Args:
        matches: [T] whose expected increments are those of the wheels, by the scale that was
            learned up to then.
        odometry: (T, 3) [m, m, rad] increments by the wheels.
    """
    late = np.arange(len(odometry)) >= len(odometry) // 2  # when it has been learned
    late &= np.asarray(matches.odometry_weight) > 0.99
    wheels, learned = odometry[late, 0], np.asarray(matches.expected, float)[late, 0]
    if not wheels.any():
        return ()
    too_long = np.sum(wheels**2) / np.sum(wheels * learned) - 1.0
    if abs(too_long) < MIN_WRONG_SCALE:
        return ()
    what = f"{100 * abs(too_long):.0f} % too {'long' if too_long > 0 else 'short'}"
    return (f"wheels report distances {what}, corrected by scan matching",)
