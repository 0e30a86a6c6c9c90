"""Time, memory and errors of EKF-SLAM against the number of landmarks, scans and trials.

One map with a dense covariance, as it is and with deferred downdates, and a town of corridors of
10,000 landmarks in 50,000 scans by submaps; what submaps cost in accuracy, in towns that one map
can hold (`growth_submaps`). Times are of the processor, of all threads. An exponent is the slope of
the logarithms over the three largest sizes; in a town over a quarter, half and all of its scans.
There are no scans: the corners of the town are measured themselves, with draws of the noise that
the filter assumes (`town`), and the filter associates them.
"""

import json
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from tqdm import tqdm

from experiments import common, town, workload
from experiments.common import Numbers
from experiments.filter_benchmark import run_named_task, run_task
from experiments.growth_picture import draw
from experiments.growth_submaps import CAPACITY, accuracy, exponent, in_town, rms
from jaxslam.core.batching import on_device
from jaxslam.core.caches import enable_caches
from jaxslam.core.measurement import Measurement
from jaxslam.core.memory import memory_now, peak_memory
from jaxslam.core.types import CORNER, Array
from jaxslam.filtering.belief import Belief, add_known_landmarks
from jaxslam.filtering.config import FilterConfig, init
from jaxslam.filtering.covariance import defer, flush_if_full
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.slam_filter import unchecked_step

NAME = "growth"
SCANS = 200  # of a time of one capacity
ROUNDS = 3  # of which the fastest counts
SCAN_COUNTS = (500, 1000, 2000, 4000)
TRIAL_COUNTS = (8, 32, 128)
SMALL_TOWN = (2, 1200)  # blocks and scans where one map is compared with submaps


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


TASKS = {"landmarks": landmarks, "scans": scans, "trials": trials, "accuracy": accuracy}


Keep = Callable[[str, Callable[[], Numbers]], Numbers]
"""Keeps the result of a function under a name, as `common.ResultCache`."""


def _compute_now(_: str, make: Callable[[], Numbers]) -> Numbers:
    """The result, which is not kept."""
    return make()


def compute(
    seed: int,
    *,
    blocks: int = 17,
    num_scans: int = 50_000,
    largest: int = 2048,
    num_drives: int = 8,
    run=run_task,
    keep: Keep = _compute_now,
) -> Numbers:
    """All figures; each of one map comes from its own process.

    Args:
        seed: Of all that is random.
        blocks: Of the town, along each side.
        num_scans: In the town.
        largest: Largest capacity of one map.
        num_drives: Drives on which one map and submaps are compared.
        run: How a task is run, by default in its own process.
        keep: How results are kept, so that what was stopped goes on from there.
    """
    of_town = keep(f"town {blocks} {num_scans}", partial(in_town, seed, blocks, num_scans))
    numbers: Numbers = {"seed": seed, "town": of_town}
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
                    make = partial(run, task, cache, arguments, module="experiments.growth")
                    named = " ".join(str(value) for value in arguments.values())
                    numbers[name].append(keep(f"{name} {named}", make))
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
            mean = rms(values) if name.endswith("rmse_m") else float(values.mean())
            result.setdefault(of, {})[name] = mean
    return result


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
    sizes = SCANS, ROUNDS, SCAN_COUNTS, TRIAL_COUNTS, SMALL_TOWN, CAPACITY
    cache = common.ResultCache(args.out / f"{NAME}_parts", (args.seed, sizes))
    numbers = compute(
        args.seed,
        blocks=args.blocks,
        num_scans=args.scans,
        largest=args.largest,
        num_drives=args.drives,
        keep=cache,
    )
    common.save(args.out, NAME, numbers, draw)
    cache.clear()
    print(summary(numbers))
    return 0


if __name__ == "__main__":
    if len(sys.argv) > 1 and sys.argv[1] in TASKS:
        run_named_task(TASKS, sys.argv[1:])
    else:
        sys.exit(main())
