"""Speed of the whole chain, of the front end and of the automaton, on one core, after compilation.

Ray casting, front end and filter of trials of the office drive, also in life and with 5,000 walls
(`life_benchmark`), and what each of their parts reaches of what the core gives (`roofline`); the
stages of the front end; the automaton, and the filter with its gradient, beside hand-written C and
other libraries, and scan matching beside the latter (`pip install '.[bench]'`); what the first
start of a command costs, by that of another build where one is named (`cold_start`). Seconds depend
on the machine; shares and ratios, measured in one process, depend on it little.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from experiments import (
    chain_profile,
    cold_start,
    common,
    filter_benchmark,
    growth,
    import_time,
    life_benchmark,
    peer_automata,
    peer_filters,
    peer_matching,
    roofline,
)
from experiments.timing import as_long_work, fastest, pin, seconds
from jaxslam.core.batching import map_batches
from jaxslam.core.episode import Episode
from jaxslam.core.features import Features
from jaxslam.core.scan import Scan
from jaxslam.core.types import Key
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import (
    automaton,
    extract,
    features,
    junctions,
    segmentation,
)
from jaxslam.frontend.automaton import EncodedDiagram
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.grid import seen_free
from jaxslam.frontend.segments import Segments
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import trial_episodes
from jaxslam.simulation.ray_casting import cast

FRONTEND_SCANS = 512  # scans at most that the front end is timed on
MATCHED_SCANS = 200  # of the drive on which scan matching is compared


def batched(function: Callable) -> Callable:
    """`function` of one item, compiled for many, as everywhere in batches of `SCAN_BATCH`."""

    def call(*items: Any) -> Any:
        return map_batches(lambda x: function(*x), items, batch_size=extract.SCAN_BATCH)

    return jax.jit(call)


@as_long_work()
def chain(seed: int, num_trials: int, repeats: int) -> tuple[common.Numbers, Scan]:
    """Scans per second of the whole chain, milliseconds per scan of its parts; and its scans."""
    config = Config()
    lidar = config.frontend.lidar
    world, robot, path, num_scans = common.drive_in()
    params = NoiseParams.for_simulated_robot(*robot[:2])
    keys = trial_episodes.trial_keys(jax.random.key(seed), np.arange(num_trials))

    def simulate(keys: Key) -> Episode:
        return trial_episodes.simulate_drives(
            keys, config.frontend, robot, world, path, num_scans=num_scans
        )

    simulated = simulate(keys)
    poses = simulated.truth.reshape(-1, 3)
    cast_rays = batched(partial(cast, lidar, world))
    scans = cast_rays(poses)
    calls = {
        "chain": (lambda k: episodes.filter_episodes(config, params, simulate(k)), keys),
        "ray_casting": (cast_rays, poses),
        "front_end": (batched(partial(extract.extract_features, config.frontend)), scans),
        "filter": (partial(episodes.filter_episodes, config, params), simulated),
    }
    taken = fastest(calls, repeats=repeats)
    count = num_trials * num_scans
    numbers = {
        "runs": num_trials,
        "scans": count,
        "scans_per_second": count / taken["chain"],
        "ms_per_scan": {name: 1e3 * s / count for name, s in taken.items()},
        "share_of_chain": {name: s / taken["chain"] for name, s in taken.items()},
    }
    return numbers, jax.tree.map(lambda x: x[:FRONTEND_SCANS], scans)


def stages(config: FrontendConfig, scans: Scan) -> dict[str, tuple]:
    """Stages of `extract.extract_diagram` with segments as labels.

    Returns:
        For each stage its function for all scans, and the arguments.
    """
    lidar, spec, levels = config.lidar, config.features, config.pyramid()

    def source_cells(scan: Scan, found: Segments) -> tuple[list[jax.Array], list[jax.Array]]:
        own = [extract.level_segments(lidar, level, scan, found) for level in levels]
        free = [seen_free(lidar, level.grid, scan) for level in levels]
        return own, [extract.encode_segments(*cells) for cells in zip(own, free, strict=True)]

    def expand_levels(start: list[jax.Array]) -> list[EncodedDiagram]:
        steps = config.automaton_steps
        return [automaton.expand_encoded(cells, steps=steps, octagon=True) for cells in start]

    def find_junctions(
        own: list[jax.Array], diagrams: list[EncodedDiagram], scan: Scan, found: Segments
    ) -> Features:
        cells = extract.junction_cells(levels, diagrams, [segment >= 0 for segment in own])
        return junctions.find_junctions(lidar, levels, spec, cells, scan, found)

    def find_others(found: Segments) -> tuple[Features, Features]:
        return features.find_corners(spec, found), features.find_wall_directions(spec, found)

    find_segments = batched(partial(segmentation.find_segments, lidar, config.segments))
    cells_of = batched(source_cells)
    expand = batched(expand_levels)
    found = find_segments(scans)
    own, start = cells_of(scans, found)
    return {
        "runs": (find_segments, scans),
        "labels_and_free_cells": (cells_of, scans, found),
        "automaton": (expand, start),
        "junctions": (batched(find_junctions), own, expand(start), scans, found),
        "corners_and_walls": (batched(find_others), found),
    }


def compile_seconds(config: FrontendConfig, scans: Scan) -> float:
    """Seconds to trace and compile the front end, without any cache."""
    enabled = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    jax.clear_caches()
    extract_features = batched(partial(extract.extract_features, config))
    try:
        return seconds(lambda: extract_features.lower(scans).compile())
    finally:
        jax.config.update("jax_enable_compilation_cache", enabled)
        compilation_cache.reset_cache()


def frontend(scans: Scan, maps: int, repeats: int) -> common.Numbers:
    """Speed of the front end and its stages on given scans, and of the automaton alone."""
    config = FrontendConfig()
    whole = batched(partial(extract.extract_features, config))
    parts = stages(config, scans)
    taken = fastest({"whole": (whole, scans)} | parts, repeats=repeats)
    total, count = sum(taken[name] for name in parts), len(scans.ranges)
    return {
        "beams": config.lidar.num_beams,
        "labels": common.LABEL_KEYS[config.labels],
        "scans": count,
        "scans_per_s": count / taken["whole"],
        "ms_per_scan": {name: 1e3 * s / count for name, s in taken.items()},
        "share": {name: taken[name] / total for name in parts},
        "compile_s": compile_seconds(config, scans),
        **peer_automata.automaton(maps, repeats),
        "peers": peer_automata.table(maps, repeats),
    }


def profile(seed: int, num_trials: int, repeats: int) -> common.Numbers:
    """The parts of the chain, each with what it reaches of what the core gives, and that."""
    core = roofline.machine(3 * repeats)
    rows = chain_profile.compute(seed, num_trials, repeats)
    return {
        "chain_profile": [roofline.with_bounds(row, core) for row in rows],
        "roofline": core,
    }


def compute(
    seed: int,
    num_trials: int,
    maps: int,
    drives: int,
    repeats: int,
    log: str,
    against: str,
    with_growth: bool,
) -> common.Numbers:
    """All numbers, by what they measure; `growth`, which takes minutes, where it is wanted."""
    of_starts = cold_start.compute(seed, log, against, repeats=1)
    of_chain, scans = chain(seed, num_trials, repeats)
    of_filter = filter_benchmark.compute(seed, drives, repeats, office=num_trials)
    return {
        "seed": seed,
        "cores": 1,
        "import_vs_jax": import_time.import_vs_jax(),
        **of_starts,
        "chain": of_chain,
        **profile(seed, num_trials, repeats),
        "life": life_benchmark.compute(seed, num_trials, repeats),
        "front_end": frontend(scans, maps, repeats),
        "estimator": of_filter,
        "scan_matching": peer_matching.table(seed, MATCHED_SCANS, repeats),
        "growth": growth.compute(seed) if with_growth else None,
    }


def draw(numbers: common.Numbers, path: Path) -> None:
    """Bars: time of the chain, the front end, peers, and starts; and the roofline of a core."""
    figure, axes = common.canvas(11, 11.6, 4, 2)
    figure.suptitle("one core", fontsize=10)
    found = numbers["front_end"]
    bars(axes[0, 0], numbers["chain"]["ms_per_scan"], "%.2f", "chain: milliseconds per scan")
    bars(axes[0, 1], stage_names(found["ms_per_scan"]), "%.3f", "front end: milliseconds per scan")
    own = {name.replace("_", " "): ms for name, ms in found["ms_per_map"].items() if ms is not None}
    bars(axes[1, 0], own, "%.3f", f"automaton and C, {found['steps']} steps: milliseconds per map")
    rows = {name: row for name, row in found["peers"].items() if isinstance(row, dict)}
    rows = dict(sorted(rows.items(), key=lambda item: item[1]["ms_in_batch"]))
    batch = {name: row["ms_in_batch"] for name, row in rows.items()}
    bars(axes[1, 1], batch, "%.3g", f"batch of {found['batch']}: milliseconds per map")
    steps = {
        kind: peer_filters.per_step(numbers["estimator"], kind) for kind in ("filter", "gradient")
    }
    bars(axes[2, 0], steps["filter"], "%.3g", "filter: microseconds per step of a trial")
    bars(axes[2, 1], steps["gradient"], "%.3g", "value and gradient: microseconds per step")
    roofline.draw(axes[3, 0], numbers["chain_profile"], numbers["roofline"])
    cold_start.draw(axes[3, 1], numbers)
    for axis in (axes[1, 1], *axes[2]):
        axis.set_xscale("log")
        axis.minorticks_off()
        axis.margins(x=0.25)
    figure.savefig(path)


def stage_names(values: dict[str, float]) -> dict[str, float]:
    """The numbers of stages under the names that are shown; JSON calls segmentation `runs`."""
    return {"segments" if name == "runs" else name: value for name, value in values.items()}


def percent(shares: dict[str, float]) -> dict[str, str]:
    """Shares as text."""
    return {name: f"{100 * share:.0f} %" for name, share in shares.items()}


def bars(axis: Any, values: dict[str, float], form: str, title: str) -> None:
    """Horizontal bars with their values, the first on top."""
    names = list(values)[::-1]
    drawn = axis.barh([n.replace("_", " ") for n in names], [values[n] for n in names])
    for bar in drawn:
        bar.set_color(common.SKY)
    axis.bar_label(drawn, fmt=lambda x: f"{x:,.0f}" if x > 100 else form % x, padding=2)
    axis.margins(x=0.15)
    axis.set_title(title, fontsize=10)


@common.report_errors("benchmark")
def main(argv: list[str] | None = None) -> int:
    """Run the benchmark."""
    pin()
    sizes = {"runs": 4, "maps": 256, "drives": 512, "repeats": 3, "growth": 1}
    args = common.parse(__doc__, argv, **sizes, log="", against="")
    numbers = compute(
        *(args.seed, args.runs, args.maps, args.drives, args.repeats),
        *(args.log, args.against, bool(args.growth)),
    )
    common.save(args.out, "benchmark", numbers, draw)
    of_chain, of_front, rows = numbers["chain"], numbers["front_end"], numbers["chain_profile"]
    new = set(roofline.KEYS)
    chain_profile.print_table([{k: x for k, x in row.items() if k not in new} for row in rows])
    roofline.print_table(rows, numbers["roofline"])
    cold_start.print_table(numbers)
    peer_matching.print_table(numbers["scan_matching"])
    print(f"{of_chain['scans_per_second']:.0f} scans per second on one core")
    print(percent(of_chain["share_of_chain"]))
    in_life = numbers["life"]
    print(
        f"{in_life['walls']} walls, {in_life['people']} people and faults: "
        f"{in_life['in_life_vs_office']:.2f} of the scans per second; ray casting "
        f"{in_life['rays_vs_brute_force']:.0f} times as fast as wall by wall"
    )
    print(
        f"front end: {of_front['scans_per_s']:.0f} scans per second",
        percent(stage_names(of_front["share"])),
    )
    ratio = {name: x for name, x in of_front.items() if name.startswith("automaton")}
    ratio |= {name: numbers["estimator"][name] for name in ("filter_vs_c", "gradient_vs_filter")}
    print({name: x if x is None else round(x, 2) for name, x in ratio.items()})
    imports = {code: round(x, 2) for code, x in numbers["import_vs_jax"].items()}
    if numbers["growth"]:
        print("growth:", growth.summary(numbers["growth"]))
    print(f"processor time of imports, by that of `{import_time.JAX}`: {imports}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
