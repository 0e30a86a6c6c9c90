"""Junctions of the thinned free space, as a user of scikit-image and sknw finds landmarks."""

from functools import partial
from importlib import import_module
from typing import Any

import jax
import numpy as np
from scipy import ndimage

from jaxslam.core.batching import map_batches
from jaxslam.core.features import Features
from jaxslam.core.scan import Scan
from jaxslam.core.types import JUNCTION, Array
from jaxslam.frontend import extract, grid
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.grid import GridSpec
from jaxslam.frontend.lidar import beam_ends

NEEDS = ("skimage.morphology", "sknw")
MAX_GAP = 0.3  # [m] between neighbouring hits of one wall
MAX_LANDMARKS = 32  # of a scan


def missing() -> list[str]:
    """Names of the required packages that are not installed."""
    absent = []
    for name in NEEDS:
        try:
            import_module(name)
        except ImportError:
            absent.append(name)
    return absent


@partial(jax.jit, static_argnames="config")
def _ends_and_free_cells(config: FrontendConfig, scans: Scan) -> tuple[Array, Array]:
    """Beam ends (N, R, 2) [m] of scans [N], and their free cells (N, H, W)."""

    def of_scan(scan: Scan) -> tuple[Array, Array]:
        ends = beam_ends(config.lidar, scan)
        return ends, grid.seen_free(config.lidar, config.grid, scan)

    return map_batches(of_scan, scans, batch_size=extract.SCAN_BATCH)


def wall_cells(spec: GridSpec, ends: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Cells (H, W) bool of the hits (R,) among beam ends (R, 2) [m], neighbours joined."""
    both = hit[:-1] & hit[1:] & (np.hypot(*np.diff(ends, axis=0).T) < MAX_GAP)
    fraction = np.linspace(0, 1, int(np.ceil(2 * MAX_GAP / spec.cell_size)) + 1)[:, None, None]
    joined = ends[:-1][both] + fraction * np.diff(ends, axis=0)[both]
    points = np.concatenate([joined.reshape(-1, 2), ends[hit]])
    index = np.floor((points - grid.grid_origin(spec)) / spec.cell_size).astype(int)
    index = index[np.all((index >= 0) & (index < spec.shape), axis=1)]
    cells = np.zeros(spec.shape, bool)
    cells[tuple(index.T)] = True
    return cells


def distance_to_blocked(free: np.ndarray) -> np.ndarray:
    """Distance (H, W) [cells] of each cell to the edge of the nearest that is not free."""
    return ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] - 0.5


def pruned_graph(free: np.ndarray) -> tuple[Any, dict[int, float]]:
    """Graph of the thinned free cells (H, W), as sknw makes it, and the clearance [cells] of nodes.

    Dead ends no longer than the clearance at their junction are pruned.
    """
    skeletonize, build = (import_module(name) for name in NEEDS)
    distance = distance_to_blocked(free)
    thin = skeletonize.skeletonize(free)
    while True:
        graph = build.build_sknw(thin.astype(np.uint16), multi=True, full=False)
        degree = dict(graph.degree())
        clearance = {
            n: float(distance[tuple(np.round(own["o"]).astype(int))])
            for n, own in graph.nodes(data=True)
        }
        pruned = thin.copy()
        for one, other, arc in graph.edges(data=True):
            tip, root = sorted((one, other), key=degree.get)
            if degree[tip] == 1 and degree[root] > 2 and arc["weight"] <= clearance[root]:
                pruned[tuple(arc["pts"].T)] = False
                pruned[tuple(graph.nodes[root]["pts"].T)] = True
        if np.array_equal(pruned, thin):
            return graph, clearance
        thin = skeletonize.skeletonize(pruned)


def junctions(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Junctions (K, 2) [cells] of three or more branches in free cells (H, W), and their clearance.

    Dead ends no longer than the clearance (K,) [cells] at their junction are pruned.
    """
    graph, clearance = pruned_graph(free)
    kept = [n for n, degree in graph.degree() if degree > 2]
    xy = np.array([graph.nodes[n]["o"] for n in kept], float).reshape(-1, 2)
    return xy, np.array([clearance[n] for n in kept])


def landmarks(config: FrontendConfig, scans: Scan) -> Features:
    """Landmarks of scans [N]; their covariance is not known.

    Those whose circles come within a cell of unseen space are not trusted.
    """
    ends, free = jax.tree.map(np.asarray, _ends_and_free_cells(config, scans))
    hit, spec = np.asarray(scans.hit), config.grid
    shape = len(hit), MAX_LANDMARKS
    xy, clearance = np.zeros((*shape, 2)), np.zeros(shape)
    valid, certified = np.zeros(shape, bool), np.zeros(shape, bool)
    for n in range(len(hit)):
        solid = wall_cells(spec, ends[n], hit[n])
        closed = ndimage.binary_closing(free[n] & ~solid) & ~solid
        found, cells = junctions(closed)
        seen = closed | ndimage.binary_dilation(solid, np.ones((3, 3)))
        distance = distance_to_blocked(seen)[tuple(np.round(found).astype(int).T)]
        k = min(MAX_LANDMARKS, len(found))
        xy[n, :k] = grid.grid_origin(spec) + (found[:k] + 0.5) * spec.cell_size
        clearance[n, :k], valid[n, :k] = cells[:k] * spec.cell_size, True
        certified[n, :k] = (distance > cells + 1.0)[:k]
    least, most = config.features.min_clearance, config.features.max_clearance
    return Features(
        kind=np.full(shape, JUNCTION),
        xy=xy,
        cov=np.full((*shape, 2, 2), np.nan),
        direction=np.zeros(shape),
        direction_variance=np.zeros(shape),
        descriptor=clearance,
        degree=3 * valid,
        certified=certified,
        trusted=certified & (clearance >= least) & (clearance <= most),
        valid=valid,
    )
