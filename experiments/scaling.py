"""Time and memory of the whole chain over numbers of runs, scans, landmarks and devices.

Every figure comes from a process of its own, which has its own memory: `python -m
experiments.scaling TASK ARGUMENTS` prints it. All drive the office from S.
"""

import json
import sys
import tempfile
from time import perf_counter

import jax

from experiments import common, one_core
from experiments.common import Numbers
from experiments.estimator import apart, peak
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config
from jaxslam.simulation import trials

LONG = 346  # scans of a run where devices are compared, as starting and ending take their time
RUNS, STEPS, LANDMARKS = 32, 50, 96  # where they do not vary
VARIED = {"runs": (8, 32, 128), "steps": (50, 100, LONG), "landmarks": (32, 64, 96, 128)}
ROUNDS = 4  # of one device and two, in turns


def chain(seed: int, runs: int, steps: int, landmarks: int, pinned: bool) -> Numbers:
    """Seconds of B runs of ray casting, front end and filter, and the peak memory of all of it."""
    one_core.pin() if pinned else one_core.unpin()
    place, robot, path, _ = common.scene()
    config = Config(
        filter=FilterConfig(
            max_landmarks=landmarks,
        ),
    )
    given = (
        jax.random.key(seed),
        config,
        NoiseParams.for_simulated_robot(*robot),
        place,
        robot,
        path,
    )

    def some(runs: int) -> None:
        for _ in trials.run_trials(*given, num_trials=runs, num_scans=steps):
            pass  # nothing is kept

    begin = perf_counter()
    some(1)
    first = perf_counter() - begin
    begin = perf_counter()
    some(runs)
    taken = perf_counter() - begin
    return {
        "devices": jax.device_count(),
        "runs": runs,
        "steps": steps,
        "landmarks": landmarks,
        "first_s": first,
        "seconds": taken,
        "ms_per_scan": 1e3 * taken / (runs * steps),
        "peak_mb": peak(),
    }


def compute(seed: int) -> Numbers:
    """All figures, on one device but for those of two; what could not be measured has a note."""
    usual = {"seed": seed, "runs": RUNS, "steps": STEPS, "landmarks": LANDMARKS}
    with tempfile.TemporaryDirectory() as temporary:
        kept = jax.config.jax_compilation_cache_dir or temporary

        def measure(count: int, **other: int) -> Numbers:
            given = usual | other | {"pinned": count == 1}
            how = {"devices": count, "module": "experiments.scaling", "whole": True}
            return apart("chain", kept, **how, **given)

        told = {name: [] for name in VARIED}
        compiling = measure(1, runs=1)
        for name, values in VARIED.items():
            for value in values:
                if name != "runs" and value != usual[name]:
                    # A process before compiles it: its memory is not that of the runs.
                    measure(1, **{name: value, "runs": 1})
                told[name].append(measure(1, **{name: value}))
        by_devices = {1: [], 2: []}
        for _ in range(ROUNDS):
            for count, done in by_devices.items():
                done.append(measure(count, steps=LONG))
    return told | {"compiling": compiling} | {"devices": _fastest(by_devices)}


def _fastest(by_devices: dict[int, list[Numbers]]) -> Numbers:
    """The quickest round of each number of devices, and how they compare."""
    bad = [one for done in by_devices.values() for one in done if "seconds" not in one]
    if bad:
        return {"two_vs_one": None, "rows": [], **bad[0]}
    rows = [min(done, key=lambda one: one["seconds"]) for done in by_devices.values()]
    return {"two_vs_one": rows[0]["seconds"] / rows[1]["seconds"], "rows": rows}


TASKS = {"chain": chain}

if __name__ == "__main__":
    print(json.dumps(TASKS[sys.argv[1]](**json.loads(sys.argv[2]))))
