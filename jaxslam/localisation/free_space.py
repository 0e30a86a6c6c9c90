"""What a map saw to be free, and how a query contradicts it.

A cell is free if a beam of the map passed it, and no wall is within `CLEAR` of it. A robot whose
scan shows walls there is somewhere else, or something is new:

    score = score of `place_fit.score_pose` - share of the points that are in free cells

A look-alike place beyond the map has its walls where the map has walls, but rarely everywhere: what
is different is in free space. What the map has never seen contradicts nothing.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core.batching import pad_to
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import transform
from jaxslam.core.types import AnyArray, Array
from jaxslam.frontend.lidar import beam_ends
from jaxslam.localisation.config import LocaliseSpec, PlaceMap
from jaxslam.matching import checks
from jaxslam.matching.place_fit import PlaceQuery, cells_of, mean_of, score_pose
from jaxslam.matching.place_index import KEYFRAME_BLOCK, PlaceIndex

CLEAR = 0.25
"""[m] least distance of a free cell from any wall."""

MAX_STEPS = 512
"""Cells of a beam that are seen, at most."""


def free_space(
    spec: LocaliseSpec, lidar: Lidar, places: PlaceIndex, poses: AnyArray, scans: Scan
) -> Array:
    """Cells (G, H) bool of the grid of a map that its scans saw to be free.

    Args:
        spec: Options.
        lidar: The scanner of the map.
        places: Index of the map.
        poses: (K, 3) [m, m, rad] of the scanner, map frame.
        scans: [K].
    """
    poses = np.asarray(poses, np.float64)
    scans = checks.as_scans("scans", lidar, scans, (len(poses),))
    padded = pad_to((poses, scans), to=len(poses) + -len(poses) % KEYFRAME_BLOCK)
    return _free(spec, lidar, places, jnp.asarray(padded[0], float), padded[1])


@partial(jax.jit, static_argnames=("spec", "lidar"))
def _free(spec: LocaliseSpec, lidar: Lidar, places: PlaceIndex, poses: Array, scans: Scan) -> Array:
    """`free_space` of poses (K, 3) and scans [K]."""
    cell = spec.place.cell
    along = jnp.asarray(cell * np.arange(MAX_STEPS), poses.dtype)

    def add(seen: Array, keyframe: tuple[Array, Scan]) -> tuple[Array, None]:
        pose, scan = keyframe
        ends = beam_ends(lidar, scan)
        ranges = jnp.linalg.norm(ends, axis=-1)
        share = along[:, None] / jnp.maximum(ranges, cell)[None]
        passed = (share <= 1.0) & scan.hit[None]
        points = (share[..., None] * ends[None]).reshape(-1, 2)
        rows, columns = cells_of(spec.place, places, transform(pose, points))
        return seen.at[rows, columns].max(passed.ravel()), None

    seen = lax.scan(add, jnp.zeros(places.distance.shape, bool), (poses, scans))[0]
    return seen & (places.distance > CLEAR)


def map_score(spec: LocaliseSpec, place_map: PlaceMap, query: PlaceQuery, pose: Array) -> Array:
    """Score () of a query at a pose (3,), at most 1: of its walls, less what contradicts."""
    cells = cells_of(spec.place, place_map.places, transform(pose, query.points))
    in_free = place_map.free[cells].astype(pose.dtype)
    return score_pose(spec.place, place_map.places, query, pose) - mean_of(in_free, query.valid)
