"""Speed of the whole chain, of the front end and of the automaton, on one core, after compilation.

Ray casting, front end and filter of runs of the office drive; the stages of the front end; the
automaton, and the filter with its gradient, beside hand-written C and other libraries
(`pip install '.[bench]'`). Seconds depend on the machine; shares and ratios, measured in one run,
depend on it little.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from experiments import common, estimator, filters, peers
from experiments.one_core import least, pin, seconds
from jaxslam import edges, junctions, monte_carlo, nodes, slam, voronoi
from jaxslam.batches import map_batches
from jaxslam.grid import seen_free
from jaxslam.lidar import Scan, cast

LOOKED_AT = 512  # scans at most that the front end is timed on


def batched(function: Callable) -> Callable:
    """`function` of one item, compiled for many, as everywhere in batches of `slam.BATCH`."""
    return jax.jit(lambda *items: map_batches(lambda x: function(*x), items, size=slam.BATCH))


def chain(seed: int, runs: int, repeats: int) -> tuple[common.Numbers, Scan]:
    """Scans a second of the chain, and the milliseconds a scan of its parts; and its scans."""
    config = slam.Config()
    place, robot, path, steps = common.scene()
    noise = slam.wheel_noise(robot)
    keys = monte_carlo.run_keys(jax.random.key(seed), np.arange(runs))

    def simulate(keys: jax.Array) -> monte_carlo.Log:
        return monte_carlo.simulate_keys(keys, config, place, robot, path, steps=steps)

    logs = simulate(keys)
    poses = logs.truth.reshape(-1, 3)
    see = batched(lambda pose: cast(place, pose, config.lidar))
    scans = see(poses)
    calls = {
        "chain": (lambda k: monte_carlo.tracks(config, noise, simulate(k)), keys),
        "ray_casting": (see, poses),
        "front_end": (batched(partial(slam.front_end, config)), scans),
        "filter": (lambda logs: monte_carlo.tracks(config, noise, logs), logs),
    }
    taken = least(calls, repeats=repeats)
    count = runs * steps
    numbers = {
        "runs": runs,
        "scans": count,
        "scans_per_second": count / taken["chain"],
        "ms_per_scan": {name: 1e3 * s / count for name, s in taken.items()},
        "share_of_chain": {name: s / taken["chain"] for name, s in taken.items()},
    }
    return numbers, jax.tree.map(lambda x: x[:LOOKED_AT], scans)


def stages(config: slam.Config, scans: Scan) -> dict[str, tuple]:
    """The stages of `slam.look` with run labels: what each does to all scans, and its inputs."""
    lidar, grid, spec = config.lidar, config.grid, config.nodes

    def cells(scan: Scan, runs: edges.Runs) -> tuple[jax.Array, jax.Array]:
        own = edges.run_cells(scan, lidar, runs, grid)
        return own, slam.start_of(own, seen_free(scan, lidar, grid))

    def found(own: jax.Array, fronts: voronoi.Fronts, scan: Scan, runs: edges.Runs) -> Any:
        near = voronoi.crowded(fronts, own >= 0)
        return junctions.find_junctions(near, scan, runs, lidar, grid, spec)

    def others(runs: edges.Runs) -> tuple[nodes.Nodes, nodes.Nodes]:
        return nodes.find_corners(runs, spec), nodes.find_walls(runs, spec)

    runs_of = batched(lambda scan: edges.runs(scan, lidar, config.runs))
    cells_of = batched(cells)
    grow = batched(partial(voronoi.grow, steps=config.steps, octagon=True))
    runs = runs_of(scans)
    own, start = cells_of(scans, runs)
    return {
        "runs": (runs_of, scans),
        "labels_and_free_cells": (cells_of, scans, runs),
        "automaton": (grow, start),
        "junctions": (batched(found), own, grow(start), scans, runs),
        "corners_and_walls": (batched(others), runs),
    }


def compile_seconds(config: slam.Config, scans: Scan) -> float:
    """Seconds to trace and compile the front end, nothing of it kept from before."""
    kept = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    jax.clear_caches()
    try:
        return seconds(lambda: batched(partial(slam.front_end, config)).lower(scans).compile())
    finally:
        jax.config.update("jax_enable_compilation_cache", kept)
        compilation_cache.reset_cache()


def front_end(scans: Scan, maps: int, repeats: int) -> common.Numbers:
    """Speed of the front end and its stages on given scans, and of the automaton by itself."""
    config = slam.Config()
    whole = batched(partial(slam.front_end, config))
    parts = stages(config, scans)
    taken = least({"whole": (whole, scans)} | parts, repeats=repeats)
    total, count = sum(taken[name] for name in parts), len(scans.ranges)
    return {
        "beams": config.lidar.beams,
        "labels": config.labels,
        "scans": count,
        "scans_per_s": count / taken["whole"],
        "ms_per_scan": {name: 1e3 * s / count for name, s in taken.items()},
        "share": {name: taken[name] / total for name in parts},
        "compile_s": compile_seconds(config, scans),
        **peers.automaton(maps, repeats),
        "peers": peers.table(maps, repeats),
    }


def compute(seed: int, runs: int, maps: int, drives: int, repeats: int) -> common.Numbers:
    """All numbers, by what they are of."""
    of_chain, scans = chain(seed, runs, repeats)
    of_filter = estimator.compute(seed, drives, repeats, office=runs)
    return {
        "seed": seed,
        "cores": 1,
        "chain": of_chain,
        "front_end": front_end(scans, maps, repeats),
        "estimator": of_filter,
    }


def draw(numbers: common.Numbers, path: Path) -> None:
    """Bars: time of each part of the chain and of the front end; peers of automaton and filter."""
    figure, axes = common.canvas(11, 8.4, 3, 2)
    figure.suptitle("one core", fontsize=10)
    of = numbers["front_end"]
    bars(axes[0, 0], numbers["chain"]["ms_per_scan"], "%.2f", "chain: milliseconds a scan")
    bars(axes[0, 1], of["ms_per_scan"], "%.3f", "front end: milliseconds a scan")
    own = {name.replace("_", " "): ms for name, ms in of["ms_per_map"].items() if ms is not None}
    bars(axes[1, 0], own, "%.3f", f"automaton and C, {of['steps']} steps: milliseconds a map")
    rows = {name: row for name, row in of["peers"].items() if isinstance(row, dict)}
    rows = dict(sorted(rows.items(), key=lambda item: item[1]["ms_in_batch"]))
    batch = {name: row["ms_in_batch"] for name, row in rows.items()}
    bars(axes[1, 1], batch, "%.3g", f"batch of {of['batch']}: milliseconds a map")
    steps = {kind: filters.per_step(numbers["estimator"], kind) for kind in ("filter", "gradient")}
    bars(axes[2, 0], steps["filter"], "%.3g", "filter: microseconds a step of a run")
    bars(axes[2, 1], steps["gradient"], "%.3g", "value and gradient: microseconds a step")
    for axis in (axes[1, 1], *axes[2]):
        axis.set_xscale("log")
        axis.minorticks_off()
        axis.margins(x=0.25)
    figure.savefig(path)


def bars(axis: Any, values: dict[str, float], form: str, title: str) -> None:
    """Horizontal bars with their values, the first on top."""
    names = list(values)[::-1]
    drawn = axis.barh([n.replace("_", " ") for n in names], [values[n] for n in names])
    for bar in drawn:
        bar.set_color(common.SKY)
    axis.bar_label(drawn, fmt=lambda x: f"{x:,.0f}" if x > 100 else form % x, padding=2)
    axis.margins(x=0.15)
    axis.set_title(title, fontsize=10)


def main(argv: list[str] | None = None) -> None:
    """Run the benchmark."""
    pin()
    given = common.parse(__doc__, argv, runs=4, maps=256, drives=512, repeats=3)
    numbers = compute(given.seed, given.runs, given.maps, given.drives, given.repeats)
    common.save(given.out, "benchmark", numbers, draw)
    of_chain, of_front = numbers["chain"], numbers["front_end"]
    percent = lambda shares: {name: f"{100 * share:.0f} %" for name, share in shares.items()}
    print(f"{of_chain['scans_per_second']:.0f} scans a second on one core")
    print(percent(of_chain["share_of_chain"]))
    print(f"front end: {of_front['scans_per_s']:.0f} scans a second", percent(of_front["share"]))
    ratio = {name: x for name, x in of_front.items() if name.startswith("automaton")}
    ratio |= {name: numbers["estimator"][name] for name in ("filter_vs_c", "gradient_vs_filter")}
    print({name: x if x is None else round(x, 2) for name, x in ratio.items()})


if __name__ == "__main__":
    main()
