"""An episode: the measurements of one robot on one drive, and its true poses."""

from typing import NamedTuple

from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement, ScanMatch
from jaxslam.core.types import Array


class Episode(NamedTuple):
    """Data of one drive, simulated or recorded: what the filter is given, and the ground truth.

    Attributes:
        truth: (T, 3) [m, m, rad] pose at each scan, world frame; the filter starts at the first.
        odometry: (T, 3) [m, m, rad] odometry increment since the scan before, zero at the first.
        features: [T] features of each scan, robot frame.
        landmark_ids: (T, M) int32 landmark of each feature, -1 for none; None: the filter
            associates.
        truth_mask: (T,) bool, where `truth` is known and errors count; None: everywhere.
        num_steps: () int32 number of scans, those after it are padding; None: T.
        scan_matches: [T] increments by scan matching, fused with the odometry; None: not used.
    """

    truth: Array
    odometry: Array
    features: Features
    landmark_ids: Array | None = None
    truth_mask: Array | None = None
    num_steps: Array | None = None
    scan_matches: ScanMatch | None = None


def measurements_of(episode: Episode) -> Measurement:
    """Measurements and controls [T] of a drive, as the filter takes them."""
    return Measurement(
        episode.odometry, episode.features, episode.landmark_ids, episode.scan_matches
    )
