"""Localisation in a saved map, from random starts, beside the usual particle filter.

Each log of the folder `--data` that has a reference is mapped as by `jaxslam run`; `--starts`
drives of each kind of `localisation_drives` begin at random scans of it, without a guess of the
pose. A robot was found where its pose is within 0.25 m and 5 degrees of the truth and stays so
until it has driven 10 m. It is sure where the probability is above 0.9; errors are of poses that
are sure and right, and those that are sure and wrong are counted. The particle filter of
`particle_filter` is given the same scans and the same odometry, by scan matching; it is sure where
its particles are together within 0.25 m and 5 degrees (std). Steps of one drive are not
independent, so the intervals of their shares are too narrow.

With `--own_truth 1` the truth of the second half is the smoothed trajectory of the whole log
instead of its reference, whose own errors are those of a map.

`--batch` robots at once in a simulated office are then localised on all devices, and one by one.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import common, localisation_batch, localisation_picture, log_folder
from experiments.common import Numbers
from experiments.localisation_drives import (
    HALF,
    KINDS,
    OUTSIDE,
    OWN,
    SPEC,
    Drives,
    MappedLog,
    in_first_half,
    in_own_map,
    make_drives,
    scans_of,
    with_own_truth,
)
from experiments.localisation_metrics import Tracks, reliability, split, summary
from experiments.log_folder import Log
from experiments.particle_filter import ParticleSpec, run_drive
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import DeviceMap, use_cpu_devices
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import relative
from jaxslam.core.types import Array
from jaxslam.io.errors import InputError
from jaxslam.localisation import LocaliseSpec, PlaceMap, init, run_steps

NAME = "localisation"
SURE = 0.9  # probability above which it is sure
MAX_SCANS = 1000  # of a log; dense ones have few starts that differ
CHUNK = 16  # drives between two updates of the progress bar
TIMED = 4  # drives that time is taken with
CARRIED = "carried"
JAXSLAM = "jaxslam"


class Answer(NamedTuple):
    """Poses (T, 3) of a drive, and the probabilities (T,) that they are right."""

    pose: Array
    probability: Array


def _localise(
    spec: LocaliseSpec, lidar: Lidar, place_map: PlaceMap, item: tuple[Scan, Array, Array]
) -> Answer:
    scans, odometry, _ = item
    count = jnp.int32(len(odometry))
    infos = run_steps(spec, lidar, place_map, init(spec, lidar), scans, odometry, count)[1]
    return Answer(infos.pose, infos.probability)


def _filter(
    spec: ParticleSpec, lidar: Lidar, place_map: PlaceMap, item: tuple[Scan, Array, Array]
) -> Answer:
    scans, odometry, seed = item
    found = run_drive(spec, lidar, place_map, scans, odometry, jax.random.key(seed))
    return Answer(found.pose, found.sure.astype(found.pose.dtype))


# One drive at a time on each device.
METHODS: dict[str, tuple[DeviceMap, Any]] = {
    JAXSLAM: (DeviceMap(_localise, size=1, static=2), SPEC),
    "2,000 particles": (DeviceMap(_filter, size=1, static=2), ParticleSpec(num_particles=2000)),
    "500 particles": (DeviceMap(_filter, size=1, static=2), ParticleSpec(num_particles=500)),
}


def run_kind(log: Log, kind: str, starts: int, seed: int, mapped: MappedLog) -> Numbers:
    """All drives of a kind in a log, by all methods."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    drives = make_drives(mapped, kind, starts, rng)
    if drives is None:
        return {}
    found: Numbers = {}
    with tqdm(total=len(METHODS) * starts, desc=f"{log.name}, {kind}", unit="drive") as bar:
        for method, (run, spec) in METHODS.items():
            answers = []
            for first in range(0, starts, CHUNK):
                some = slice(first, min(first + CHUNK, starts))
                seeds = np.arange(some.start, some.stop, dtype=np.int32)
                items = (*scans_of(mapped, drives, some), seeds)
                answers.append(run(spec, mapped.lidar, mapped.place_map, items))
                bar.update(some.stop - first)
            answer = jax.tree.map(lambda *x: np.concatenate(x), *answers)
            found[method] = numbers_of(tracks_of(mapped, drives, answer), kind, drives)
            found[method]["ms"] = _step_time(
                lambda items: run(spec, mapped.lidar, mapped.place_map, items),  # noqa: B023
                (
                    *scans_of(mapped, drives, slice(TIMED)),
                    np.arange(min(TIMED, starts), dtype=np.int32),
                ),
                drives.exists.shape[1],
            )
    return found


def tracks_of(mapped: MappedLog, drives: Drives, answer: Answer) -> Tracks:
    """Errors of the answers [B, T]."""
    truth = mapped.truth[drives.numbers]
    off = relative(truth, np.asarray(answer.pose, float))
    probability = np.asarray(answer.probability, float)
    return Tracks(
        np.hypot(off[..., 0], off[..., 1]),
        np.abs(off[..., 2]),
        probability,
        probability > SURE,
        np.cumsum(np.hypot(drives.odometry[..., 0], drives.odometry[..., 1]), axis=1),
        drives.exists & np.isfinite(truth[..., 0]),
        mapped.inside[drives.numbers],
    )


def numbers_of(tracks: Tracks, kind: str, drives: Drives) -> Numbers:
    """Numbers of the drives of a kind; in the own map before and after the robot was carried."""
    parts = {kind: tracks}
    if kind == OWN:
        parts = dict(zip((OWN, CARRIED), split(tracks, drives.carried_at), strict=True))
    found: Numbers = {name: summary(part) for name, part in parts.items()}
    return found | {"reliability": reliability(tracks)}


def _step_time(run: Callable[[Any], Any], items: Any, steps: int) -> float:
    """Time of a step [ms] of one core, all cores together."""
    run(items)
    start = time.process_time()
    run(items)
    return 1e3 * (time.process_time() - start) / (steps * len(items[-1]))


def run_log(log: Log, starts: int, seed: int, cache: common.ResultCache, name: str) -> Numbers:
    """All kinds of drives in a log: numbers by the part of the drives and the method."""
    found: Numbers = {}
    mapped: dict[str, MappedLog] = {}

    def map_for(kind: str) -> MappedLog:
        make = in_own_map if kind == OWN else in_first_half
        if make.__name__ not in mapped:
            mapped[make.__name__] = make(log)
        return mapped[make.__name__]

    for kind in KINDS:
        by_method = cache(
            f"{name}_{kind}", lambda kind=kind: run_kind(log, kind, starts, seed, map_for(kind))
        )
        for part in (kind, CARRIED) if kind == OWN else (kind,):
            if by_method:
                found[part] = {method: one[part] for method, one in by_method.items()}
                for method, one in by_method.items():
                    found[part][method] |= {"ms": one["ms"], "reliability": one["reliability"]}
    return found


def text_of(numbers: Numbers) -> str:
    """The results as text."""
    lines = []
    for name, log in numbers["logs"].items():
        for part, by_method in log.items():
            for method, one in by_method.items():
                lines.append(f"{name:14} {part:11} {method:15} {_line(part, one)}")
    lines += [
        f"probability from {row['from']:.2f}: {row['steps']:6} steps, "
        f"mean {row['probability']:.3f}, right {row['right']:.3f}"
        for row in numbers["reliability"]
        if row["steps"]
    ]
    batch = numbers["batch"]
    lines.append(
        f"{batch['robots']} robots in the office, {batch['devices']} devices: "
        f"{batch['batched_steps_per_s']:.0f} steps a second, one by one "
        f"{batch['single_steps_per_s']:.0f}: {batch['ratio']:.1f} times"
    )
    return "\n".join(lines)


def _line(part: str, one: Numbers) -> str:
    def of(values: list[float] | None, digits: int) -> str:
        if not values:
            return "-"
        return f"{values[20]:.{digits}f}, {values[38]:.{digits}f}"

    def metres(value: float | None) -> str:
        return "never" if value is None else f"{value:.1f}"

    low, high = one["wrong_but_sure_interval"]
    sure = (
        f"wrong but sure {one['wrong_but_sure']} of {one['sure']} steps ({low:.4f} to {high:.4f}),"
        f" in {one['drives_wrong_but_sure']} drives; {one['ms']:.2f} ms"
    )
    if part == OUTSIDE:
        return sure
    return (
        f"found within 5 m {one['found_within_5_m']:.3f}, sure {one['sure_within_5_m']:.3f}; "
        f"found after (50, 95 %) {metres(one['found_at_median_m'])}, "
        f"{metres(one['found_at_95_m'])} m; error (50, 95 %) {of(one['position_m'], 3)} m, "
        f"{of(one['heading_deg'], 2)} deg; {sure}"
    )


def total_reliability(numbers: Numbers, method: str) -> list[Numbers]:
    """Reliability of all drives of all logs together; each kind counts once."""
    tables = [
        by_method[method]["reliability"]
        for log in numbers["logs"].values()
        for part, by_method in log.items()
        if part in (OWN, HALF, OUTSIDE)
    ]
    rows = []
    for same in zip(*tables, strict=True):
        steps = sum(row["steps"] for row in same)
        row: Numbers = {"from": same[0]["from"], "steps": steps}
        for key in ("probability", "right"):
            total = sum(one["steps"] * one[key] for one in same if one["steps"])
            row[key] = total / steps if steps else None
        rows.append(row)
    return rows


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    args = common.parse(__doc__, argv, data="", starts=200, batch=256, own_truth=0)
    for flag in ("starts", "batch"):
        if getattr(args, flag) < 1:
            raise InputError(f"{getattr(args, flag)} is too small", field=f"--{flag}")
    use_cpu_devices()
    enable_caches()
    chosen = log_folder.with_reference(args.data, MAX_SCANS)
    if args.own_truth:
        chosen = {name: with_own_truth(log) for name, log in chosen.items()}
    keys = ("data", "starts", "seed", "batch", "own_truth")
    about = {key: getattr(args, key) for key in keys}
    cache = common.ResultCache(args.out / f"{NAME}_parts", about)
    found = {
        name: run_log(log, args.starts, args.seed, cache, name) for name, log in chosen.items()
    }
    batch = cache("batch", partial(localisation_batch.measure, args.batch, args.seed))
    numbers: Numbers = {"seed": args.seed, "starts": args.starts, "logs": found, "batch": batch}
    numbers["own_truth"] = bool(args.own_truth)
    numbers["reliability"] = total_reliability(numbers, JAXSLAM)
    print(text_of(numbers))
    common.save(args.out, NAME, numbers, localisation_picture.draw)
    cache.clear()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
