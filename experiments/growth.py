"""Time, memory and errors of EKF-SLAM against the number of landmarks, scans and trials.

One map with a dense covariance, as it is and with deferred downdates, and a town of corridors of
10,000 landmarks in 50,000 scans by submaps; what submaps cost in accuracy, in towns that one map
can hold. Times are of the processor, of all threads. An exponent is the slope of the logarithms
over the three largest sizes. There are no scans: the corners of the town are measured themselves,
with draws of the noise that the filter assumes (`town`), and the filter associates them.
"""

import json
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from tqdm import tqdm

from experiments import common, town, workload
from experiments.common import Numbers
from experiments.filter_benchmark import run_named_task, run_task
from jaxslam.core import se2_np
from jaxslam.core.batching import on_device
from jaxslam.core.caches import enable_caches
from jaxslam.core.measurement import Measurement
from jaxslam.core.memory import memory_now, peak_memory
from jaxslam.core.types import CORNER, Array
from jaxslam.filtering.belief import Belief, add_known_landmarks
from jaxslam.filtering.config import FilterConfig, init
from jaxslam.filtering.covariance import defer, flush_if_full
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import run_filter, unchecked_step
from jaxslam.pipeline.submap_slam import SubmapResult, SubmapState, run_submaps
from jaxslam.smoothing.submap_joining import relative_poses

NAME = "growth"
CAPACITY = 64  # landmarks of a submap
SCANS = 200  # of a time of one capacity
ROUNDS = 3  # of which the fastest counts
SCAN_COUNTS = (500, 1000, 2000, 4000)
TRIAL_COUNTS = (8, 32, 128)
SMALL_TOWN = (2, 1200)  # blocks and scans where one map is compared with submaps
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


def _fastest(call, *arguments) -> float:
    """Least processor seconds of a call that is compiled, of `ROUNDS`."""
    jax.block_until_ready(call(*arguments))
    taken = []
    for _ in range(ROUNDS):
        begin = time.process_time()
        jax.block_until_ready(call(*arguments))
        taken.append(time.process_time() - begin)
    return min(taken)


@partial(jax.jit, static_argnames=("config", "is_deferred"))
def _filter(
    config: FilterConfig,
    is_deferred: bool,
    params: NoiseParams,
    belief: Belief,
    measurements: Measurement,
) -> tuple[Array, Belief]:
    """Poses (T, 3) and the belief after T scans, with deferred downdates of the map or without."""

    def body(belief: Belief, measurement: Measurement) -> tuple[Belief, Array]:
        cov = flush_if_full(belief.map_cov, 2 * config.max_updates + 2)
        belief, info = unchecked_step(config, params, belief._replace(map_cov=cov), measurement)
        return belief, info.pose

    if is_deferred:
        belief = belief._replace(map_cov=defer(belief.map_cov))
    belief, poses = lax.scan(body, belief, measurements)
    return poses, belief


def landmarks(seed: int, capacity: int, deferred: bool) -> Numbers:
    """Milliseconds a scan of one map that is full, and the memory for it."""
    blocks = int(np.ceil(np.sqrt(capacity / 30))) + 1
    where = town.make(blocks, SCANS, seed)
    seen = np.unique(where.corner[where.corner >= 0])
    chosen = np.concatenate([seen, np.setdiff1d(np.arange(len(where.corners)), seen)])[:capacity]
    config = town.config(capacity)
    belief = init(config, jnp.asarray(where.truth[0], float))
    cov = np.tile(0.05**2 * np.eye(2), (len(chosen), 1, 1))
    belief = add_known_landmarks(belief, where.corners[chosen], cov, CORNER)
    belief = belief._replace(
        num_seen=jnp.where(belief.num_seen > 0, 5, 0).astype(jnp.int32),
        direction=belief.direction.at[: len(chosen)].set(where.directions[chosen]),
        descriptor=belief.descriptor.at[: len(chosen)].set(where.angles[chosen]),
    )
    measurements = on_device(where.measurements)
    before = memory_now()
    seconds = _fastest(_filter, config, deferred, town.params(), belief, measurements)
    return {
        "landmarks": len(chosen),
        "ms_per_scan": 1e3 * seconds / SCANS,
        "peak_mb": peak_memory(),
        "before_mb": before,
        "covariance_mb": (3 + 2 * capacity) ** 2 * 4 / 2**20,
    }


def scans(seed: int, count: int) -> Numbers:
    """Seconds of the filter over T scans of one drive, with the capacity of a submap."""
    where = town.make(2, count, seed)
    config = town.config(CAPACITY)
    belief = init(config, jnp.asarray(where.truth[0], float))
    measurements = on_device(where.measurements)
    seconds = _fastest(_filter, config, False, town.params(), belief, measurements)
    return {"scans": count, "seconds": seconds, "peak_mb": peak_memory()}


def trials(seed: int, count: int) -> Numbers:
    """Seconds of the filter over B trials of 200 scans past 32 known landmarks."""
    drive = workload.as_floats(workload.rings(seed, count), float)
    seconds = _fastest(workload.filter_drive, "standard", drive)
    return {"trials": count, "seconds": seconds, "peak_mb": peak_memory()}


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
    counts = [x["scans"] for x in closing]
    position, corner = _landmarks(found, where)
    numbers = {
        "blocks": blocks,
        "scans": num_scans,
        "driven_m": float(np.linalg.norm(np.diff(where.truth[:, :2], axis=0), axis=1).sum()),
        "submaps": len(found.submaps),
        "ms_per_scan": 1e3 * seconds / num_scans,
        "peak_mb": peak_memory(),
        "seconds_exponent": exponent(counts, [x["seconds"] for x in closing]),
        "memory_exponent": exponent(counts, [x["memory_mb"] for x in closing]),
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
        "pose_rmse_m": _rms(_errors(found.poses, where)),
        "online_rmse_m": _rms(_errors(found.online_poses, where)),
        "online_max_m": float(_errors(found.online_poses, where).max()),
        "landmark_rmse_m": _rms(np.linalg.norm(position - where.corners[corner], axis=1)),
        "nees_per_dof": float(error @ np.linalg.solve(cov[0], error) / 3),
    }


def _rms(x: np.ndarray) -> float:
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
        "online_rmse_m": _rms(_errors(np.asarray(info.pose), where)),
        "landmark_rmse_m": _rms(np.linalg.norm(position - where.corners[corner], axis=1)),
        "nees_per_dof": float(error @ np.linalg.solve(cov, error) / 3),
        "ms_per_scan": dense_ms,
    }
    submaps = _measures(timed[1][0], where) | {"ms_per_scan": timed[1][1]}
    return {"one_map": one_map, "submaps": submaps}


TASKS = {"landmarks": landmarks, "scans": scans, "trials": trials, "accuracy": accuracy}


def compute(
    seed: int,
    *,
    blocks: int = 17,
    num_scans: int = 50_000,
    largest: int = 2048,
    num_drives: int = 8,
    run=run_task,
) -> Numbers:
    """All figures; each of one map comes from its own process.

    Args:
        seed: Of all that is random.
        blocks: Of the town, along each side.
        num_scans: In the town.
        largest: Largest capacity of one map.
        num_drives: Drives on which one map and submaps are compared.
        run: How a task is run, by default in its own process.
    """
    numbers: Numbers = {"seed": seed, "town": in_town(seed, blocks, num_scans)}
    sizes = [size for size in (64, 128, 256, 512, 1024, 2048, 4096) if size <= largest]
    small, drives = SMALL_TOWN, range(seed, seed + num_drives)
    wanted: dict[str, tuple[str, list[dict]]] = {
        "dense": ("landmarks", [{"capacity": n, "deferred": False} for n in sizes]),
        "deferred": ("landmarks", [{"capacity": n, "deferred": True} for n in sizes]),
        "scans": ("scans", [{"count": n} for n in SCAN_COUNTS]),
        "trials": ("trials", [{"count": n} for n in TRIAL_COUNTS]),
        "accuracy": (
            "accuracy",
            [{"seed": n, "blocks": small[0], "num_scans": small[1]} for n in drives],
        ),
    }
    with tempfile.TemporaryDirectory() as temporary:
        cache = jax.config.jax_compilation_cache_dir or temporary
        total = sum(len(given) for _, given in wanted.values())
        with tqdm(total=total, unit="task", leave=False) as bar:
            for name, (task, given) in wanted.items():
                numbers[name] = []
                for arguments in given:
                    arguments = {"seed": seed} | arguments
                    numbers[name].append(run(task, cache, arguments, module="experiments.growth"))
                    bar.update()
    return numbers | {"exponents": _exponents(numbers), "cost": _cost_of_submaps(numbers)}


def _exponents(numbers: Numbers) -> Numbers:
    """Exponents of time and memory, by what they grow with; None where there are too few."""

    def of(rows: list[Numbers], x: str, y: str) -> float | None:
        rows = [row for row in rows if y in row]
        return exponent([row[x] for row in rows], [row[y] for row in rows])

    return {
        "dense_time_by_landmarks": of(numbers["dense"], "landmarks", "ms_per_scan"),
        "deferred_time_by_landmarks": of(numbers["deferred"], "landmarks", "ms_per_scan"),
        "covariance_by_landmarks": of(numbers["dense"], "landmarks", "covariance_mb"),
        "time_by_scans": of(numbers["scans"], "scans", "seconds"),
        "time_by_trials": of(numbers["trials"], "trials", "seconds"),
        "submaps_time_by_scans": numbers["town"]["seconds_exponent"],
        "submaps_memory_by_scans": numbers["town"]["memory_exponent"],
    }


def _cost_of_submaps(numbers: Numbers) -> Numbers:
    """Means over the drives of one map and of submaps; errors are root mean squares."""
    rows = [row for row in numbers["accuracy"] if "submaps" in row]
    result: Numbers = {}
    for of in ("one_map", "submaps") if rows else ():
        for name in rows[0][of]:
            values = np.array([row[of][name] for row in rows], float)
            mean = _rms(values) if name.endswith("rmse_m") else float(values.mean())
            result.setdefault(of, {})[name] = mean
    return result


def draw(numbers: Numbers, path: Path) -> None:
    """Time by landmarks, time by scans, the map of the town, errors along its drive."""
    figure, axes = common.canvas(12, 9, 2, 2)
    axis, in_submaps = axes[0, 0], numbers["town"]["progress"]
    for name, colour in (("dense", common.RED), ("deferred", common.ORANGE)):
        rows = [row for row in numbers[name] if "ms_per_scan" in row]
        slope = numbers["exponents"][f"{name}_time_by_landmarks"]
        label = f"one map, {name}" + ("" if slope is None else f": exponent {slope:.2f}")
        x, y = ([row[k] for row in rows] for k in ("landmarks", "ms_per_scan"))
        axis.plot(x, y, "o-", color=colour, label=label)
    x = [row["landmarks"] for row in in_submaps]
    y = [1e3 * row["seconds"] / row["scans"] for row in in_submaps]
    axis.plot(x, y, ".-", color=common.BLUE, label="submaps, mean since the start")
    axis.axhline(15.0, color=common.BLACK, linestyle=":", linewidth=1)
    axis.set(xscale="log", yscale="log", xlabel="landmarks", ylabel="processor time a scan [ms]")
    axis.legend(fontsize=8)

    axis = axes[0, 1]
    kinds = (("scans", common.GREEN), ("trials", common.PINK))
    for name, colour in kinds:
        rows = [row for row in numbers[name] if "seconds" in row]
        label = f"one map of {CAPACITY}, by scans" if name == "scans" else "trials of 200 scans"
        slope = numbers["exponents"][f"time_by_{name}"]
        label += "" if slope is None else f": exponent {slope:.2f}"
        x, y = ([row[k] for row in rows] for k in (name, "seconds"))
        axis.plot(x, y, "o-", color=colour, label=label)
    slope = numbers["exponents"]["submaps_time_by_scans"]
    label = "town by submaps" + ("" if slope is None else f": exponent {slope:.2f}")
    x, y = ([row[k] for row in in_submaps] for k in ("scans", "seconds"))
    axis.plot(x, y, ".-", color=common.BLUE, label=label)
    axis.set(xscale="log", yscale="log", xlabel="scans, or trials", ylabel="processor time [s]")
    axis.legend(fontsize=8)

    axis, where = axes[1, 0], numbers["town"]
    found, true = np.asarray(where["estimated_m"]), np.asarray(where["true_m"])
    axis.plot(*true.T, ".", color=common.BLACK, markersize=1.5, label="true")
    axis.plot(*found.T, ".", color=common.SKY, markersize=1.5, label="estimated")
    rmse = where["landmark_rmse_m"]
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axis.set_title(f"{where['landmarks']} landmarks, RMSE {rmse:.2f} m", fontsize=10)
    axis.legend(fontsize=8, loc="upper right", markerscale=5)

    axis = axes[1, 1]
    for name, colour, label in (
        ("online_error_by_scan_m", common.ORANGE, "at the time of the scan"),
        ("error_by_scan_m", common.BLUE, "by all submaps"),
    ):
        error = np.asarray(where[name])
        scan = np.linspace(0, where["scans"], len(error))
        axis.plot(scan, error, color=colour, linewidth=0.8, label=label)
    axis.set(xlabel="scan", ylabel="error of the position in the town [m]", ylim=(0, None))
    axis.legend(fontsize=8)
    figure.savefig(path)


def summary(numbers: Numbers) -> str:
    """The figures of the town, the exponents and the cost of submaps as JSON."""
    shown = {k: v for k, v in numbers["town"].items() if isinstance(v, (int, float))}
    chosen = {"town": shown, "exponents": numbers["exponents"], "cost": numbers["cost"]}
    return json.dumps(chosen)


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code."""
    args = common.parse(__doc__, argv, blocks=17, scans=50_000, largest=2048, drives=8)
    enable_caches()
    numbers = compute(
        args.seed,
        blocks=args.blocks,
        num_scans=args.scans,
        largest=args.largest,
        num_drives=args.drives,
    )
    common.save(args.out, NAME, numbers, draw)
    print(summary(numbers))
    return 0


if __name__ == "__main__":
    if len(sys.argv) > 1 and sys.argv[1] in TASKS:
        run_named_task(TASKS, sys.argv[1:])
    else:
        sys.exit(main())
