"""Speed of the whole chain and of its parts, batched, on one core, after compilation.

Ray casting, front end and filter of runs of the office drive. Seconds depend on the machine;
the shares of the parts, measured in one run, depend on it little.
"""

import os
import time
from pathlib import Path

if hasattr(os, "sched_setaffinity"):  # before JAX starts its threads
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax
import numpy as np

from experiments import common
from jaxslam import monte_carlo, slam
from jaxslam.lidar import cast
from jaxslam.slam import map_batches

REPEATS = 3


def best_of(function, *arguments) -> float:
    """Least seconds of a few calls, compilation left out."""
    jax.block_until_ready(function(*arguments))
    taken = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        taken.append(time.perf_counter() - begin)
    return min(taken)


def compute(seed: int, runs: int) -> common.Numbers:
    """Scans a second of the chain, and the milliseconds a scan of its parts."""
    config = slam.Config()
    place, robot, path, steps = common.scene()
    noise = slam.wheel_noise(robot)
    keys = monte_carlo.run_keys(jax.random.key(seed), np.arange(runs))

    def simulate(keys):
        return monte_carlo.simulate_keys(keys, config, place, robot, path, steps=steps)

    logs = simulate(keys)

    @jax.jit
    def scans(truth):
        see = lambda pose: cast(place, pose, config.lidar)
        return map_batches(see, truth.reshape(-1, 3), size=slam.BATCH)

    @jax.jit
    def features(scans):
        return map_batches(lambda scan: slam.front_end(config, scan), scans, size=slam.BATCH)

    seconds = {
        "chain": best_of(lambda k: monte_carlo.tracks(config, noise, simulate(k)), keys),
        "ray_casting": best_of(scans, logs.truth),
        "front_end": best_of(features, scans(logs.truth)),
        "filter": best_of(lambda logs: monte_carlo.tracks(config, noise, logs), logs),
    }
    count = runs * steps
    return {
        "seed": seed,
        "runs": runs,
        "scans": count,
        "cores": 1,
        "scans_per_second": count / seconds["chain"],
        "ms_per_scan": {name: 1e3 * s / count for name, s in seconds.items()},
        "share_of_chain": {name: s / seconds["chain"] for name, s in seconds.items()},
    }


def draw(numbers: common.Numbers, path: Path) -> None:
    """Bars of the time of each part."""
    figure, axes = common.canvas(7, 2.6, 1, 1)
    parts = numbers["ms_per_scan"]
    names = list(parts)[::-1]
    bars = axes[0, 0].barh(names, [parts[name] for name in names], color=common.SKY)
    axes[0, 0].bar_label(bars, fmt="%.2f")
    axes[0, 0].set(xlabel="milliseconds a scan, one core")
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the benchmark."""
    given = common.parse(__doc__, argv, runs=8)
    numbers = compute(given.seed, given.runs)
    common.save(given.out, "benchmark", numbers, draw)
    print(f"{numbers['scans_per_second']:.0f} scans a second on one core")
    print({name: f"{100 * share:.0f} %" for name, share in numbers["share_of_chain"].items()})


if __name__ == "__main__":
    main()
