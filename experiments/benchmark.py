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
from jaxslam.core.batching import map_batches
from jaxslam.core.episode import Episode
from jaxslam.core.features import Features
from jaxslam.core.scan import Scan
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import (
    automaton,
    extract,
    features,
    junctions,
    segmentation,
    segments,
    voronoi,
)
from jaxslam.frontend.automaton import Fronts
from jaxslam.frontend.grid import seen_free
from jaxslam.frontend.segments import Segments
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import trials
from jaxslam.simulation.ray_casting import cast

LOOKED_AT = 512  # scans at most that the front end is timed on


def batched(function: Callable) -> Callable:
    """`function` of one item, compiled for many, as everywhere in batches of `SCAN_BATCH`."""
    return jax.jit(
        lambda *items: map_batches(lambda x: function(*x), items, batch_size=extract.SCAN_BATCH)
    )


def chain(seed: int, runs: int, repeats: int) -> tuple[common.Numbers, Scan]:
    """Scans a second of the chain, and the milliseconds a scan of its parts; and its scans."""
    config = Config()
    place, robot, path, steps = common.scene()
    noise = NoiseParams.for_simulated_robot(*robot)
    keys = trials.trial_keys(jax.random.key(seed), np.arange(runs))

    def simulate(keys: jax.Array) -> Episode:
        return trials.simulate_keys(keys, config, robot, place, path, num_scans=steps)

    logs = simulate(keys)
    poses = logs.truth.reshape(-1, 3)
    see = batched(lambda pose: cast(config.frontend.lidar, place, pose))
    scans = see(poses)
    calls = {
        "chain": (lambda k: episodes.filter_episodes(config, noise, simulate(k)), keys),
        "ray_casting": (see, poses),
        "front_end": (batched(partial(extract.extract_features, config.frontend)), scans),
        "filter": (lambda logs: episodes.filter_episodes(config, noise, logs), logs),
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


def stages(config: Config, scans: Scan) -> dict[str, tuple]:
    """The stages of `extract.extract_diagram` with run labels: what each does to all scans, and its inputs."""
    lidar, grid, spec = config.frontend.lidar, config.frontend.grid, config.frontend.features

    def cells(scan: Scan, runs: Segments) -> tuple[jax.Array, jax.Array]:
        own = segments.segment_cells(lidar, grid, scan, runs)
        return own, extract.segment_fronts(own, seen_free(lidar, grid, scan))

    def found(own: jax.Array, fronts: Fronts, scan: Scan, runs: Segments) -> Any:
        near = voronoi.junction_cells_of_fronts(fronts, own >= 0)
        return junctions.find_junctions(lidar, grid, spec, near, scan, runs)

    def others(runs: Segments) -> tuple[Features, Features]:
        return features.find_corners(spec, runs), features.find_wall_directions(spec, runs)

    runs_of = batched(
        lambda scan: segmentation.find_segments(lidar, config.frontend.segments, scan)
    )
    cells_of = batched(cells)
    grow = batched(
        partial(automaton.expand_fronts, steps=config.frontend.automaton_steps, octagon=True)
    )
    runs = runs_of(scans)
    own, start = cells_of(scans, runs)
    return {
        "runs": (runs_of, scans),
        "labels_and_free_cells": (cells_of, scans, runs),
        "automaton": (grow, start),
        "junctions": (batched(found), own, grow(start), scans, runs),
        "corners_and_walls": (batched(others), runs),
    }


def compile_seconds(config: Config, scans: Scan) -> float:
    """Seconds to trace and compile the front end, nothing of it kept from before."""
    kept = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    jax.clear_caches()
    try:
        return seconds(
            lambda: (
                batched(partial(extract.extract_features, config.frontend)).lower(scans).compile()
            )
        )
    finally:
        jax.config.update("jax_enable_compilation_cache", kept)
        compilation_cache.reset_cache()


def front_end(scans: Scan, maps: int, repeats: int) -> common.Numbers:
    """Speed of the front end and its stages on given scans, and of the automaton by itself."""
    config = Config()
    whole = batched(partial(extract.extract_features, config.frontend))
    parts = stages(config, scans)
    taken = least({"whole": (whole, scans)} | parts, repeats=repeats)
    total, count = sum(taken[name] for name in parts), len(scans.ranges)
    return {
        "beams": config.frontend.lidar.num_beams,
        "labels": config.frontend.labels,
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
    numbers = compute(given.seed, given.frontend.segments, given.maps, given.drives, given.repeats)
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
