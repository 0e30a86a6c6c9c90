"""Towns by submaps: time, memory and errors, and beside one map with a dense covariance.

See `growth`, whose figures these are.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import town
from experiments.common import Numbers
from jaxslam.core import se2_np
from jaxslam.core.memory import memory_now, peak_memory
from jaxslam.filtering.config import init
from jaxslam.filtering.slam_filter import run_filter
from jaxslam.pipeline.submap_slam import SubmapResult, SubmapState, run_submaps
from jaxslam.smoothing.submap_joining import relative_poses

CAPACITY = 64  # landmarks of a submap
WARM = 400  # scans that compile the programs of submaps
POINTS = 40  # of the progress of a town
DRAWN = 3  # of so many landmarks one is kept for the picture


def exponent(x: list[float], y: list[float]) -> float | None:
    """Slope of log y by log x over the three largest x; None of fewer than two."""
    if len(x) < 2:
        return None
    last = np.argsort(x)[-3:]
    slope = np.polyfit(np.log(np.asarray(x, float)[last]), np.log(np.asarray(y, float)[last]), 1)[0]
    return float(slope)


def in_town(seed: int, blocks: int, num_scans: int) -> Numbers:
    """A town by submaps: time, memory, errors, and how both grew."""
    where = town.make(blocks, num_scans, seed)
    config, progress = town.config(CAPACITY), []
    warm = jax.tree.map(lambda x: x[:WARM], where.measurements)
    run_submaps(config, town.params(), where.truth[0], warm)  # compiles
    every, begin = max(1, num_scans // POINTS), time.process_time()
    with tqdm(total=num_scans, unit="scan", leave=False) as bar:

        def follow(done: int, state: SubmapState) -> None:
            bar.update(done - bar.n)
            if done // every > len(progress) and state.joined is not None:
                progress.append(
                    {
                        "scans": done,
                        "submaps": len(state.submaps),
                        "landmarks": len(state.joined.landmark_positions),
                        "seconds": time.process_time() - begin,
                        "memory_mb": memory_now(),
                    }
                )

        found = run_submaps(
            config, town.params(), where.truth[0], where.measurements, callback=follow
        )
    seconds = time.process_time() - begin
    closing = [x for x in progress if x["landmarks"] > 0]
    spread = [closing[len(closing) * k // 4 - 1] for k in (1, 2, 4)] if len(closing) > 3 else []
    counts = [x["scans"] for x in spread]
    position, corner = _landmarks(found, where)
    numbers = {
        "blocks": blocks,
        "scans": num_scans,
        "driven_m": float(np.linalg.norm(np.diff(where.truth[:, :2], axis=0), axis=1).sum()),
        "submaps": len(found.submaps),
        "ms_per_scan": 1e3 * seconds / num_scans,
        "peak_mb": peak_memory(),
        "seconds_exponent": exponent(counts, [x["seconds"] for x in spread]),
        "memory_exponent": exponent(counts, [x["memory_mb"] for x in spread]),
        "progress": progress,
    }
    drawn = slice(None, None, DRAWN)
    numbers["estimated_m"] = np.round(position[drawn], 2)
    numbers["true_m"] = np.round(where.corners[corner[drawn]], 2)
    numbers["error_by_scan_m"] = np.round(_errors(found.poses, where)[:: max(1, every // 10)], 3)
    numbers["online_error_by_scan_m"] = np.round(
        _errors(found.online_poses, where)[:: max(1, every // 10)], 3
    )
    return numbers | _measures(found, where)


def _errors(poses: np.ndarray, where: town.Town) -> np.ndarray:
    """Errors (T,) [m] of the positions of the robot."""
    return np.linalg.norm(poses[:, :2] - where.truth[:, :2], axis=1)


def _corners_of(ids: np.ndarray, corner: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The corner (n,) that each landmark with an id was seen as most often."""
    result = []
    for one in wanted:
        seen = corner[(ids == one) & (corner >= 0)]
        values, times = np.unique(seen, return_counts=True)
        result.append(values[times.argmax()])
    return np.array(result, int)


def _corners_of_submaps(found: SubmapResult, where: town.Town) -> list[np.ndarray]:
    """The corner of each landmark, of each submap."""
    result = []
    for i, submap in enumerate(found.submaps):
        at = found.submap == i
        result.append(_corners_of(found.landmark_id[at], where.corner[at], submap.id))
    return result


def _landmarks(found: SubmapResult, where: town.Town) -> tuple[np.ndarray, np.ndarray]:
    """Estimated positions (L, 2) [m] of the landmarks, and the corner (L,) that each is."""
    corner = np.zeros(len(found.joined.landmark_positions), int)
    for index, own in zip(found.landmark_index, _corners_of_submaps(found, where), strict=True):
        corner[index] = own
    return found.joined.landmark_positions, corner


def _measures(found: SubmapResult, where: town.Town) -> Numbers:
    """Errors of joined submaps, and what went wrong with the numbers of their landmarks."""
    corners = np.concatenate(_corners_of_submaps(found, where))
    numbers = np.concatenate(found.landmark_index)
    pairs = np.unique(np.stack([numbers, corners]), axis=1)
    position, corner = _landmarks(found, where)
    last, cov = relative_poses(found.joined, np.array([0]), len(found.submaps))
    error = last[0] - se2_np.relative(where.truth[0], where.truth[-1])
    error[2] = se2_np.wrap_angle(error[2])
    return {
        "landmarks": len(position),
        "corners": len(np.unique(corners)),
        "duplicates": int(pairs.shape[1] - len(np.unique(corners))),
        "wrong_matches": int(pairs.shape[1] - len(position)),
        "cost_per_dof": float(found.joined.cost[-1] / max(found.joined.dof, 1)),
        "pose_rmse_m": rms(_errors(found.poses, where)),
        "online_rmse_m": rms(_errors(found.online_poses, where)),
        "online_max_m": float(_errors(found.online_poses, where).max()),
        "landmark_rmse_m": rms(np.linalg.norm(position - where.corners[corner], axis=1)),
        "nees_per_dof": float(error @ np.linalg.solve(cov[0], error) / 3),
    }


def rms(x: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


def accuracy(seed: int, blocks: int, num_scans: int) -> Numbers:
    """Errors of one dense map and of submaps on one drive, and the time of both."""
    where = town.make(blocks, num_scans, seed)
    config = town.config(len(where.corners) + 32)
    belief = init(config, jnp.asarray(where.truth[0], float))

    def of_one_map() -> tuple:
        belief_after, info = run_filter(config, town.params(), belief, where.measurements)
        return jax.block_until_ready((belief_after, info))

    def of_submaps() -> SubmapResult:
        return run_submaps(town.config(CAPACITY), town.params(), where.truth[0], where.measurements)

    timed = []
    for call in (of_one_map, of_submaps):
        call()  # compiles
        begin = time.process_time()
        timed.append((call(), 1e3 * (time.process_time() - begin) / num_scans))
    (after, info), dense_ms = timed[0]
    slot = np.flatnonzero(np.asarray(after.num_seen) > 1)
    corner = _corners_of(np.asarray(info.id), where.corner, np.asarray(after.id)[slot])
    position = np.asarray(after.landmark_positions)[slot]
    error = np.asarray(info.pose[-1], float) - where.truth[-1]
    error[2] = se2_np.wrap_angle(error[2])
    cov = np.asarray(info.pose_cov[-1], float)
    one_map = {
        "landmarks": len(slot),
        "corners": len(np.unique(corner)),
        "online_rmse_m": rms(_errors(np.asarray(info.pose), where)),
        "landmark_rmse_m": rms(np.linalg.norm(position - where.corners[corner], axis=1)),
        "nees_per_dof": float(error @ np.linalg.solve(cov, error) / 3),
        "ms_per_scan": dense_ms,
    }
    submaps = _measures(timed[1][0], where) | {"ms_per_scan": timed[1][1]}
    return {"one_map": one_map, "submaps": submaps}
