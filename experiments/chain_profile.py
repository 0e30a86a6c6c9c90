"""Where the time of the whole chain goes: each part of ray casting, front end and filter, a scan.

A part is timed alone, on what the parts before it found, so that the sum of the parts is a little
above the whole. On a CPU each operation of a compiled program is dispatched, which costs about as
much as some hundred numbers: `operations` counts them, those of a loop as often as it turns. On a
device with thousands of lanes their longest chain matters, the `depth`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import common, program_depth
from experiments.program_sizes import num_equations
from experiments.timing import fastest
from jaxslam.core.batching import map_batches
from jaxslam.core.scan import Scan
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import automaton, extract, features, junctions, segmentation
from jaxslam.frontend.circle_fitting import fit_circles
from jaxslam.frontend.circle_search import find_circles
from jaxslam.frontend.dropouts import FilledScan, fill_dropouts
from jaxslam.frontend.grid import seen_free
from jaxslam.frontend.line_fitting import Partition, partition_beams
from jaxslam.frontend.tangent_circles import wall_segments
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import trial_episodes
from jaxslam.simulation.ray_casting import cast


def batched(function: Callable) -> Callable:
    """`function` of one item for many, in batches of `SCAN_BATCH`."""

    def call(*items: Any) -> Any:
        return map_batches(lambda x: function(*x), items, batch_size=extract.SCAN_BATCH)

    return jax.jit(call)


def frontend(config: Config, scans: Scan) -> dict[str, tuple[Any, ...]]:
    """Each part of the front end as a function of all scans, with its arguments."""
    spec = config.frontend
    lidar, (level,) = spec.lidar, spec.pyramid()

    def partition(filled: FilledScan) -> Partition:
        found = spec.segments
        return partition_beams(
            lidar,
            filled.scan,
            filled.jump,
            filled.measured,
            max(lidar.range_std, 0.005),
            segment_cost=found.segment_cost,
            outlier_cost=found.outlier_cost,
            num_candidates=found.num_candidates,
            roughness_std=found.roughness_std,
            roughness_length=found.roughness_length,
        )

    fill = batched(partial(fill_dropouts, lidar, spec.segments))
    segment = batched(partial(segmentation.segment_filled, lidar, spec.segments))
    draw = batched(partial(extract.level_segments, lidar, level))
    free = batched(partial(seen_free, lidar, level.grid))
    expand = batched(
        partial(automaton.expand_encoded, steps=spec.automaton_steps, octagon=True),
    )
    mark = batched(lambda own, cells: extract.junction_cells([level], [own], [cells >= 0])[0])
    search = batched(
        lambda cells, found: find_circles(
            [cells], wall_segments(found), [level], spec.features, jnp.float32
        )[:2]
    )
    gate, thick = spec.features.tangency_gate, spec.features.wall_thickness
    fit = batched(partial(fit_circles, within=gate, thick=thick))
    select = batched(
        lambda cells, scan, found: junctions.find_junctions(
            lidar, [level], spec.features, [cells], scan, found
        )
    )
    others = batched(
        lambda found: (
            features.find_corners(spec.features, found),
            features.find_wall_directions(spec.features, found),
        )
    )
    filled = fill(scans)
    scan, found = filled.scan, segment(filled)
    cells = draw(scan, found)
    start = extract.encode_segments(cells, free(scan))
    grown = expand(start)
    marked = mark(grown, cells)
    return {
        "frontend": (batched(partial(extract.extract_features, spec)), scans),
        "dropouts": (fill, scans),
        "segments": (segment, filled),
        "segments: partition": (batched(partition), filled),
        "wall_cells": (draw, scan, found),
        "free_cells": (free, scan),
        "automaton": (expand, start),
        "junction_cells": (mark, grown, cells),
        "junctions": (select, marked, scan, found),
        "junctions: circle_search": (search, marked, found),
        "junctions: circle_fit": (fit, search(marked, found)[0], found),
        "corners_and_walls": (others, found),
    }


def compute(seed: int, num_trials: int, repeats: int) -> list[dict[str, Any]]:
    """Rows of the profile: time, size and cost of each part.

    They hold `part`, `us_per_scan`, `equations`, `unknown_loops`, and of `program_depth`, a scan,
    `operations`, `depth`, `flops` and `bytes`. The scans of a batch share its depth.

    Args:
        seed: Of the trials.
        num_trials: Trials of the office drive.
        repeats: Rounds in which all parts are timed in turns.
    """
    config = Config()
    world, robot, path, num_scans = common.drive_in()
    params = NoiseParams.for_simulated_robot(*robot[:2])
    keys = trial_episodes.trial_keys(jax.random.key(seed), np.arange(num_trials))
    simulated = trial_episodes.simulate_drives(
        keys, config.frontend, robot, world, path, num_scans=num_scans
    )
    poses = simulated.truth.reshape(-1, 3)
    cast_rays = batched(partial(cast, config.frontend.lidar, world))
    run_filter = jax.jit(partial(episodes.filter_batch, config.filter, params))
    calls: dict[str, tuple[Any, ...]] = {
        "ray_casting": (cast_rays, poses),
        "filter": (run_filter, simulated),
    }
    calls |= frontend(config, cast_rays(poses))
    taken, count = fastest(calls, repeats=repeats), num_trials * num_scans
    rows = []
    for part, (function, *given) in calls.items():
        traced = function.trace(*given)
        found = program_depth.profile(traced.lower().compile())
        unknown = found.pop("unknown_loops")
        rows.append(
            {
                "part": part,
                "us_per_scan": 1e6 * taken[part] / count,
                "equations": num_equations(traced.jaxpr.jaxpr),
                "unknown_loops": unknown,
                **{key: number and number / count for key, number in found.items()},
            }
        )
    return rows


def print_table(rows: list[dict[str, Any]]) -> None:
    """Print the rows of the profile."""
    keys = list(rows[0])[1:]
    print(f"{'a scan':26}" + "".join(f"{key.replace('_', ' '):>15}" for key in keys))
    for row in rows:
        numbers = (row[key] for key in keys)
        shown = ("-" if x is None else f"{x:,.0f}" if x >= 100 else f"{x:.3g}" for x in numbers)
        print(f"{row['part']:26}" + "".join(f"{text:>15}" for text in shown))
