"""Landmarks as a user of scikit-image and sknw finds them: junctions of the thinned free space."""

from functools import partial
from importlib import import_module

import jax
import numpy as np
from scipy import ndimage

from jaxslam.core.batching import map_batches
from jaxslam.core.features import Features
from jaxslam.core.scan import Scan
from jaxslam.core.types import JUNCTION
from jaxslam.frontend import extract, grid
from jaxslam.frontend.grid import GridSpec
from jaxslam.frontend.lidar import beam_ends
from jaxslam.pipeline.config import Config

NEEDS = ("skimage.morphology", "sknw")
GAP = 0.3  # [m] between neighbouring hits that are one wall
SLOTS = 32  # landmarks of a scan at most


def missing() -> list[str]:
    """What is needed and not installed."""
    lacking = []
    for name in NEEDS:
        try:
            import_module(name)
        except ImportError:
            lacking.append(name)
    return lacking


@partial(jax.jit, static_argnames="config")
def _seen(config: Config, scans: Scan):
    """Ends (N, R, 2) [m] of scans [N], and the cells (N, H, W) that they show to be free."""
    one = lambda scan: (
        beam_ends(config.frontend.lidar, scan),
        grid.seen_free(config.frontend.lidar, config.frontend.grid, scan),
    )
    return map_batches(one, scans, batch_size=extract.SCAN_BATCH)


def walls(ends: np.ndarray, hit: np.ndarray, spec: GridSpec) -> np.ndarray:
    """Cells (H, W) bool of the hits (R,) among ends (R, 2) [m], neighbours joined."""
    both = hit[:-1] & hit[1:] & (np.hypot(*np.diff(ends, axis=0).T) < GAP)
    part = np.linspace(0, 1, int(np.ceil(2 * GAP / spec.cell_size)) + 1)[:, None, None]
    joined = ends[:-1][both] + part * np.diff(ends, axis=0)[both]
    at = np.concatenate([joined.reshape(-1, 2), ends[hit]])
    index = np.floor((at - grid.grid_origin(spec)) / spec.cell_size).astype(int)
    index = index[np.all((index >= 0) & (index < spec.shape), axis=1)]
    cells = np.zeros(spec.shape, bool)
    cells[tuple(index.T)] = True
    return cells


def room(free: np.ndarray) -> np.ndarray:
    """Distance (H, W) [cells] of each cell to the edge of the nearest that is not free."""
    return ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] - 0.5


def junctions(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (K, 2) [cells] of three branches or more in free cells (H, W), and their clearance.

    Branches that end and are no longer than the clearance (K,) [cells] at their root are none.
    """
    skeletonize, build = (import_module(name) for name in NEEDS)
    away = room(free)
    thin = skeletonize.skeletonize(free)
    while True:
        graph = build.build_sknw(thin.astype(np.uint16), multi=True, full=False)
        degree = dict(graph.degree())
        centre = {n: np.asarray(own["o"], float) for n, own in graph.nodes(data=True)}
        height = {n: away[tuple(np.round(at).astype(int))] for n, at in centre.items()}
        pruned = thin.copy()
        for one, other, arc in graph.edges(data=True):
            tip, root = sorted((one, other), key=degree.get)
            if degree[tip] == 1 and degree[root] > 2 and arc["weight"] <= height[root]:
                pruned[tuple(arc["pts"].T)] = False
                pruned[tuple(graph.nodes[root]["pts"].T)] = True
        if np.array_equal(pruned, thin):
            break
        thin = skeletonize.skeletonize(pruned)
    kept = [n for n in centre if degree[n] > 2]
    return np.array([centre[n] for n in kept]).reshape(-1, 2), np.array([height[n] for n in kept])


def landmarks(config: Config, scans: Scan) -> Features:
    """Landmarks of scans [N]; their covariance is not known.

    Those whose circles come within a cell of what was not seen are not trusted.
    """
    ends, free = jax.tree.map(np.asarray, _seen(config, scans))
    hit, spec = np.asarray(scans.hit), config.frontend.grid
    count = len(hit)
    xy, clearance = np.zeros((count, SLOTS, 2)), np.zeros((count, SLOTS))
    valid, known = np.zeros((count, SLOTS), bool), np.zeros((count, SLOTS), bool)
    for n in range(count):
        solid = walls(ends[n], hit[n], spec)
        open = ndimage.binary_closing(free[n] & ~solid) & ~solid
        at, height = junctions(open)
        seen = open | ndimage.binary_dilation(solid, np.ones((3, 3)))
        away = room(seen)[tuple(np.round(at).astype(int).T)]
        k = min(SLOTS, len(at))
        xy[n, :k] = grid.grid_origin(spec) + (at[:k] + 0.5) * spec.cell_size
        clearance[n, :k], valid[n, :k] = height[:k] * spec.cell_size, True
        known[n, :k] = (away > height + 1.0)[:k]
    zero = np.zeros((count, SLOTS))
    fits = (clearance >= config.frontend.features.min_clearance) & (
        clearance <= config.frontend.features.max_clearance
    )
    return Features(
        kind=np.full(valid.shape, JUNCTION),
        xy=xy,
        cov=np.full((count, SLOTS, 2, 2), np.nan),
        direction=zero,
        direction_variance=zero,
        descriptor=clearance,
        degree=3 * valid,
        certified=known,
        trusted=known & fits,
        valid=valid,
    )
