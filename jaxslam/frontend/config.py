"""Static configuration of the front end."""

from typing import NamedTuple

from jaxslam.core.scan import Lidar
from jaxslam.frontend.features import FeatureSpec
from jaxslam.frontend.grid import GridSpec
from jaxslam.frontend.segments import SegmentSpec

LABELS = ("segments", "codes")


class FrontendConfig(NamedTuple):
    """Static configuration of the front end; hashable, static under jit.

    Attributes:
        lidar: Laser scanner.
        grid: Local grid of a scan.
        segments: Segmentation of a scan into straight wall segments.
        features: Extraction of features.
        labels: Sources of the Voronoi diagram: `"segments"`, the wall segments of the scan, or
            `"codes"`, the paper's edge codes of occupied cells.
        automaton_steps: Number of steps of the cellular automaton.
    """

    lidar: Lidar = Lidar()
    grid: GridSpec = GridSpec()
    segments: SegmentSpec = SegmentSpec()
    features: FeatureSpec = FeatureSpec()
    labels: str = "segments"
    automaton_steps: int = 32
