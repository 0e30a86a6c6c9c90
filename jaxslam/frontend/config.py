"""Static configuration of the front end, and its check."""

import math
from itertools import pairwise
from typing import NamedTuple

from jaxslam.core.scan import Lidar, check_lidar
from jaxslam.frontend.circle_search import BLOCK
from jaxslam.frontend.features import FeatureSpec, check_feature_spec
from jaxslam.frontend.grid import GridSpec, check_grid_spec
from jaxslam.frontend.pyramid import Level, fit_to_range, make_level
from jaxslam.frontend.segments import SegmentSpec, check_segment_spec

COARSE_LEVEL = GridSpec(cell_size=0.4, x_max=25.6, x_min=-0.4, y_half=25.6)
"""Cells of 40 cm: halls with walls up to 12.8 m from their middle."""

PYRAMID = (COARSE_LEVEL,)
"""Levels for halls and scanners of long range, `FrontendConfig(levels=PYRAMID)`; the local map
takes about 1.55 times as long."""

LABELS = ("segments", "codes")
"""Known sources of the Voronoi diagram, for `FrontendConfig.labels`."""


class FrontendConfig(NamedTuple):
    """Static configuration of the front end; hashable, static under jit.

    Attributes:
        lidar: Laser scanner.
        grid: Local grid of a scan.
        segments: Segmentation of a scan into straight wall segments.
        features: Extraction of features.
        labels: Sources of the Voronoi diagram: `"segments"`, the wall segments of the scan, or
            `"codes"`, the paper's edge codes of occupied cells.
        automaton_steps: Number of steps of the cellular automaton, on every level.
        levels: Coarser grids of the pyramid, finer ones first, none or `PYRAMID`; of segments only.
            They are cut to the range of the scanner.
    """

    lidar: Lidar = Lidar()
    grid: GridSpec = GridSpec()
    segments: SegmentSpec = SegmentSpec()
    features: FeatureSpec = FeatureSpec()
    labels: str = "segments"
    automaton_steps: int = 32
    levels: tuple[GridSpec, ...] = ()

    def pyramid(self) -> tuple[Level, ...]:
        """All levels, the finest first; edge codes, the paper's method, have one."""
        coarser = self.levels if self.labels == "segments" else ()
        grids = [self.grid, *(fit_to_range(self.lidar, grid) for grid in coarser)]
        most, steps = self.features.max_clearance, self.automaton_steps
        return tuple(make_level(grid, self.grid, most, steps) for grid in grids)


def check_config(config: FrontendConfig) -> None:
    """Raise ValueError, naming the field, unless the front end can work with a configuration."""
    if not isinstance(config, FrontendConfig):
        raise ValueError(f"config is a {type(config).__name__}, not a FrontendConfig")
    check_lidar(config.lidar)
    check_grid_spec(config.grid)
    for finer, grid in pairwise((config.grid, *config.levels)):
        check_grid_spec(grid)
        if not grid.cell_size > finer.cell_size:
            raise ValueError(
                f"config.levels has cells of {grid.cell_size} m after cells of {finer.cell_size} m"
            )
    check_segment_spec(config.segments)
    check_feature_spec(config.features)
    max_corners, max_segments = config.features.max_corners, config.segments.max_segments
    if max_corners > max_segments:
        raise ValueError(
            f"features.max_corners is {max_corners}, more than segments.max_segments, "
            f"{max_segments}"
        )
    height, width = config.grid.shape
    num_blocks = math.ceil(height / BLOCK) * math.ceil(width / BLOCK)
    if config.features.num_candidates > num_blocks:
        max_junctions = config.features.max_junctions
        raise ValueError(
            f"features.max_junctions is {max_junctions}, too many for a grid of "
            f"{config.grid.shape} cells"
        )
    if config.labels not in LABELS:
        known = " or ".join(map(repr, LABELS))
        raise ValueError(f"config.labels is {config.labels!r}, not {known}")
    if config.automaton_steps < 0:
        raise ValueError(f"config.automaton_steps is {config.automaton_steps}, not 0 or more")
