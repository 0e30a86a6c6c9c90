"""What the filter is given at a step: odometry, features, and scan matching if there is any."""

from typing import NamedTuple

from jaxslam.core.features import Features
from jaxslam.core.types import Array


class ScanMatch(NamedTuple):
    """Result of scan matching: an odometry increment in the frame of the pose before.

    Where the scans contradict the odometry, it is replaced by a motion as before. The last three
    fields say so; None stands for odometry that is taken as it is.

    Attributes:
        increment: (3,) [m, m, rad].
        information: (3, 3) inverse covariance, from the scan alone; zero in directions that it does
            not constrain.
        inlier_fraction: () fraction of the points that lie on a surface of the submap.
        expected: (3,) [m, m, rad] increment to be fused in place of the odometry.
        expected_variance: (3,) [m^2, m^2, rad^2] its variance in addition to the odometry's.
        odometry_weight: () 0 to 1, how much of it is by odometry.
    """

    increment: Array
    information: Array
    inlier_fraction: Array
    expected: Array | None = None
    expected_variance: Array | None = None
    odometry_weight: Array | None = None


class Measurement(NamedTuple):
    """Measurements of one step: odometry increment and features.

    Attributes:
        odometry: (3,) [m, m, rad] odometry since the scan before, frame of the pose before.
        features: M features of this scan, robot frame.
        landmark_ids: (M,) int32 known landmark 0..L-1 of each feature, -1 for none; None: the
            filter associates.
        scan_match: The same increment by scan matching, to be fused with the odometry, if any.
    """

    odometry: Array
    features: Features
    landmark_ids: Array | None = None
    scan_match: ScanMatch | None = None
