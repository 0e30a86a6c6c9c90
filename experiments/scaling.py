"""Time and memory of the whole chain over numbers of trials, scans, landmarks and devices.

Every figure comes from a separate process, which has its own memory: `python -m
experiments.scaling TASK ARGUMENTS` prints it. All trials drive through the office from S.
"""

import sys
import tempfile
from time import perf_counter

import jax

from experiments import common, timing
from experiments.common import Numbers
from experiments.filter_benchmark import run_named_task, run_task
from jaxslam.core.memory import peak_memory
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config
from jaxslam.simulation import trials

LONG = 346  # scans of a trial where devices are compared, as start and end take their time
RUNS, STEPS, LANDMARKS = 32, 50, 96  # trials, scans and landmark slots where they do not vary
VARIED = {"runs": (8, 32, 128), "steps": (50, 100, LONG), "landmarks": (32, 64, 96, 128)}
ROUNDS = 4  # of one device and two, in turns


def chain(seed: int, runs: int, steps: int, landmarks: int, pinned: bool) -> Numbers:
    """Seconds of B trials of ray casting, front end and filter, and the peak memory of all of it.

    Args:
        seed: Of the noise.
        runs: B, number of trials.
        steps: Scans of a trial.
        landmarks: Capacity of the map.
        pinned: Whether to use one core only.
    """
    timing.pin() if pinned else timing.unpin()
    world, robot, path, _ = common.drive_in()
    config = Config(filter=FilterConfig(max_landmarks=landmarks))
    params = NoiseParams.for_simulated_robot(*robot[:2])
    key = jax.random.key(seed)

    def run(count: int) -> float:
        begin = perf_counter()
        for _ in trials.run_trials(
            key, config, params, robot, world, path, num_trials=count, num_scans=steps
        ):
            pass  # results are dropped
        return perf_counter() - begin

    first, taken = run(1), run(runs)
    return {
        "devices": jax.device_count(),
        "runs": runs,
        "steps": steps,
        "landmarks": landmarks,
        "first_s": first,
        "seconds": taken,
        "ms_per_scan": 1e3 * taken / (runs * steps),
        "peak_mb": peak_memory(),
    }


def compute(seed: int) -> Numbers:
    """All figures, on one device except for those of two; what cannot be measured has a note."""
    default = {"seed": seed, "runs": RUNS, "steps": STEPS, "landmarks": LANDMARKS}
    with tempfile.TemporaryDirectory() as temporary:
        cache = jax.config.jax_compilation_cache_dir or temporary

        def measure(count: int, changed: dict[str, int]) -> Numbers:
            arguments = default | changed | {"pinned": count == 1}
            return run_task(
                "chain",
                cache,
                arguments,
                num_devices=count,
                module="experiments.scaling",
                no_split=True,
            )

        found = {name: [] for name in VARIED}
        compiling = measure(1, {"runs": 1})
        for name, values in VARIED.items():
            for value in values:
                if name != "runs" and value != default[name]:
                    # Compiled by a process before: its memory is not that of the trials.
                    measure(1, {name: value, "runs": 1})
                found[name].append(measure(1, {name: value}))
        by_devices = {1: [], 2: []}
        for _ in range(ROUNDS):
            for count, done in by_devices.items():
                done.append(measure(count, {"steps": LONG}))
    return found | {"compiling": compiling} | {"devices": _fastest(by_devices)}


def _fastest(by_devices: dict[int, list[Numbers]]) -> Numbers:
    """The fastest round of each number of devices, and their ratio."""
    bad = [one for done in by_devices.values() for one in done if "seconds" not in one]
    if bad:
        return {"two_vs_one": None, "rows": [], **bad[0]}
    rows = [min(done, key=lambda one: one["seconds"]) for done in by_devices.values()]
    return {"two_vs_one": rows[0]["seconds"] / rows[1]["seconds"], "rows": rows}


TASKS = {"chain": chain}

if __name__ == "__main__":
    run_named_task(TASKS, sys.argv[1:])
