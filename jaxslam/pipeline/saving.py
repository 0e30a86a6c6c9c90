"""From the result of SLAM to the map that is kept for later sessions."""

from typing import Any

import jax
import numpy as np

from jaxslam.core.scan import Scan
from jaxslam.core.types import as_float64, check_array, check_type
from jaxslam.filtering.noise import NoiseParams
from jaxslam.mapping.saved_map import SavedMap, used_arcs, used_landmarks
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.results import SlamResult


def to_saved_map(
    config: Config,
    params: NoiseParams,
    result: SlamResult,
    times: Any,
    scans: Scan,
    saved_map: SavedMap | None = None,
) -> SavedMap:
    """The map that a result of `run_slam` leaves, for `io.map_file.write`.

    Args:
        config: Of the run; its scanner is kept.
        params: Q and R of the filter.
        result: Of the run, K keyframes.
        times: (K,) [s] of the keyframes.
        scans: [K] of the keyframes: ranges (K, R) [m] and hit (K, R).
        saved_map: The map that the run went on in, if any; its keyframes come first.

    Raises:
        ValueError: Times or scans are not those of K keyframes of this scanner; the result has no
            arcs; or it goes on in a map of another number of keyframes.
    """
    for name, record, kind in (
        ("config", config, Config),
        ("params", params, NoiseParams),
        ("result", result, SlamResult),
        ("scans", scans, Scan),
    ):
        check_type(name, record, kind)
    if result.arcs is None:
        raise ValueError("result.arcs is None: give the result of run_slam")
    count, lidar = len(result.keyframes), config.frontend.lidar
    hit = np.asarray(scans.hit)
    check_array("scans.hit", hit, (count, lidar.num_beams), np.bool_)
    ranges = as_float64("scans.ranges", scans.ranges, hit.shape).astype(np.float32)
    belief = used_landmarks(result.belief)
    next_id: Any = np.maximum(belief.next_id, np.int32(result.next_id))
    new = SavedMap(
        lidar=lidar,
        params=jax.tree.map(np.asarray, params),
        times=as_float64("times", times, (count,)),
        poses=np.asarray(result.poses, np.float64)[result.keyframes],
        pose_cov=np.asarray(result.info.pose_cov, np.float32),
        scans=Scan._make((np.where(hit, ranges, np.float32(lidar.range_max)), hit)),
        belief=belief._replace(next_id=next_id),
        arcs=used_arcs(result.arcs),
        topological_map=jax.tree.map(_as_64_bits, result.topological_map),
    )
    if result.saved_poses is None:
        return new
    if saved_map is None or len(saved_map.poses) != len(result.saved_poses):
        raise ValueError("saved_map is not the map that the result goes on in")
    old = saved_map._replace(poses=result.saved_poses)
    fields = ("times", "poses", "pose_cov", "scans")
    both = {
        name: jax.tree.map(lambda *x: np.concatenate(x), getattr(old, name), getattr(new, name))
        for name in fields
    }
    return new._replace(**both)


def _as_64_bits(x: Any) -> np.ndarray:
    """Integers or floats in 64 bits; truth values stay."""
    x = np.asarray(x)
    if x.dtype == bool:
        return x
    return x.astype(np.float64 if x.dtype.kind == "f" else np.int64)
