"""Place recognition: where in a map one scan was taken, without a guess; beside two other methods.

Each log of the folder `--data` that has a reference is run as by `jaxslam run`; its keyframes at
their smoothed poses are the map. Every `--every`th of them is then looked for in a map without it
("other scans"), and in one without all keyframes that are less than 10 m of driving away ("other
visits": many of these places were visited only once, and must not be found). A place is right
within 0.5 m and 10 degrees of the reference, to which the trajectory is aligned. Recall is the
share of the places with a keyframe of about the same view in the map that were accepted and right.

The same queries are answered by the methods of `place_peers`; landmark pairs give a keyframe, not a
pose, which is right within 1.5 m. These have no rule of acceptance, so all methods are compared by
their recall at 99 % precision, with the threshold that is best in hindsight. `floor_plan_places`
then varies what makes it hard, one thing at a time, in `--plans` random floor plans.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import common, floor_plan_places, log_folder, place_peers, place_picture
from experiments.common import Numbers
from experiments.log_folder import Log
from experiments.map_warnings import wilson_interval
from experiments.place_curves import METHODS, PRECISION, curve, recall_at
from jaxslam.core.caches import enable_caches
from jaxslam.core.features import Features
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2_np import compose, relative
from jaxslam.core.time_series import match_times
from jaxslam.core.types import AnyArray
from jaxslam.evaluation.trajectory import align_trajectory
from jaxslam.io.errors import InputError
from jaxslam.matching.place_fit import PlaceQuery
from jaxslam.matching.place_index import PlaceSpec, build_index
from jaxslam.matching.place_recognition import find_places, make_query
from jaxslam.pipeline import log_input

NAME = "place_recognition"
RIGHT = (0.5, np.radians(10.0))  # [m], [rad] from the reference
SAME_VIEW = (1.5, 0.7)  # [m], [rad] between two keyframes
MIN_PATH = 10.0  # [m] of driving to another visit
PROTOCOLS = ("other scans", "other visits")
MAX_KEYFRAMES = 1000  # of a log; each query has a map of its own
SHARES = (0.125, 0.25, 0.5, 1.0)  # of the keyframes in the maps that time is taken with
PLAN_QUERIES = 40  # for each value of each factor in a floor plan
SPEC = PlaceSpec()
_make_query = jax.jit(make_query, static_argnums=(0, 1))


class Keyframes(NamedTuple):
    """Keyframes of a run: smoothed poses (K, 3), and those of the reference in the same frame."""

    lidar: Lidar
    scans: Scan
    poses: np.ndarray
    truth: np.ndarray
    features: Features


def keyframes_of(log: Log) -> Keyframes:
    """Run a log, and take its keyframes that the reference has a pose for."""
    assert log.reference is not None
    given = log_input.from_laser_log(log.laser_log)
    result = log_input.run(given)
    pairs = match_times(log.laser_log.times[result.keyframes], log.reference[0])
    chosen, poses = result.keyframes[pairs[:, 0]], log.reference[1][pairs[:, 1]]
    scans = jax.tree.map(lambda x: np.asarray(x)[chosen], given.scans)
    frame = align_trajectory(poses[:, :2], result.poses[chosen, :2])
    truth = compose(frame, poses)
    features = jax.tree.map(lambda x: np.asarray(x)[pairs[:, 0]], result.features)
    return Keyframes(given.config.frontend.lidar, scans, result.poses[chosen], truth, features)


def query_all(keyframes: Keyframes, protocol: str, every: int, bar: tqdm) -> list[Numbers]:
    """A row for each query."""
    lidar, scans, poses, truth, features = keyframes
    histograms = place_peers.histograms(features)
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    rows = []
    for number in range(0, len(poses), every):
        others = np.arange(len(poses)) != number
        if protocol == PROTOCOLS[1]:
            others = np.abs(driven - driven[number]) > MIN_PATH
        index = build_index(SPEC, lidar, poses[others], _take(scans, others))
        query = _query_of(lidar, scans, number)
        found = find_places(SPEC, index, query)
        search = place_peers.search_everywhere(SPEC, index, query)
        alike = place_peers.similarities(histograms[number], histograms[others])
        nearest = poses[others][alike.argmax()]
        off = np.hypot(*(nearest - truth[number])[:2])
        rows.append(
            {
                "keyframe": number,
                "in_map": bool(_within(poses[number], poses[others], SAME_VIEW).any()),
                "score": float(found.score[0]),
                "margin": float(found.margin),
                "places": {
                    "right": _is_right(truth[number], found.poses[0]),
                    "confidence": float(found.certainty),
                },
                "search": {
                    "right": _is_right(truth[number], search.pose),
                    "confidence": float(
                        search.score + SPEC.margin_weight * min(search.margin, SPEC.max_margin)
                    ),
                },
                "pairs": {
                    "right": bool(off < SAME_VIEW[0]),
                    "confidence": float(alike.max()),
                },
            }
        )
        bar.update()
    return rows


def _is_right(truth: np.ndarray, found: AnyArray) -> bool:
    return bool(_within(truth, np.asarray(found, float), RIGHT))


def _within(pose: np.ndarray, others: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Whether other poses (..., 3) are within [m] and [rad] of a pose (3,)."""
    off = relative(pose, others)
    near = np.hypot(off[..., 0], off[..., 1]) < limits[0]
    return near & (np.abs(off[..., 2]) < limits[1])


def _take(records: Any, chosen: np.ndarray | list[int]) -> Any:
    return jax.tree.map(lambda x: x[chosen], records)


def _query_of(lidar: Lidar, scans: Scan, number: int) -> PlaceQuery:
    scan = jax.tree.map(jnp.asarray, _take(scans, [number]))
    return _make_query(SPEC, lidar, scan, jnp.zeros((1, 3)))


def summary(rows: list[Numbers]) -> Numbers:
    """Precision with its 95 % Wilson interval, and recall, of the queries that are accepted."""
    taken = [
        row
        for row in rows
        if row["places"]["confidence"] >= SPEC.min_certainty and row["margin"] >= SPEC.min_margin
    ]
    right, in_map = sum(row["places"]["right"] for row in taken), sum(row["in_map"] for row in rows)
    known = sum(row["places"]["right"] and row["in_map"] for row in taken)
    low, high = wilson_interval(right, len(taken))
    return {
        "queries": len(rows),
        "in_map": in_map,
        "accepted": len(taken),
        "precision": right / len(taken) if taken else None,
        "precision_low": low,
        "precision_high": high,
        "recall": known / in_map if in_map else None,
    }


def _process_time(repeats: int, call: Callable[[], Any]) -> float:
    """Median time [ms] of a call, of all cores together, once it is compiled."""
    jax.block_until_ready(call())
    times = []
    for _ in range(repeats):
        start = time.process_time()
        jax.block_until_ready(call())
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times))


def timing(keyframes: Keyframes, repeats: int = 20) -> list[Numbers]:
    """Time of a query against the size of the map: its first keyframes."""
    rows = []
    for share in SHARES:
        some = slice(0, max(int(share * len(keyframes.poses)), 1))
        scans = _take(keyframes.scans, np.arange(len(keyframes.poses))[some])
        build = partial(build_index, SPEC, keyframes.lidar, keyframes.poses[some], scans)
        build()  # compiles
        start = time.perf_counter()
        index = build()
        built = time.perf_counter() - start
        query = _query_of(keyframes.lidar, scans, 0)
        histograms = place_peers.histograms(_take(keyframes.features, np.arange(len(scans.ranges))))
        calls = {
            "query_ms": partial(find_places, SPEC, index, query),
            "search_ms": partial(place_peers.search_everywhere, SPEC, index, query),
            "pairs_ms": partial(place_peers.similarities, histograms[0], histograms),
        }
        times = {name: _process_time(repeats, call) for name, call in calls.items()}
        rows.append(
            {
                "keyframes": len(scans.ranges),
                "positions": int(index.valid.sum()),
                "build_s": built,
            }
            | times
        )
    return rows


def run_log(log: Log, every: int) -> Numbers:
    """All queries of a log, and the time of one."""
    keyframes = keyframes_of(log)
    found: Numbers = {"keyframes": len(keyframes.poses), "rows": {}, "summary": {}, "methods": {}}
    total = len(PROTOCOLS) * len(range(0, len(keyframes.poses), every))
    with tqdm(total=total, desc=log.name, unit="query") as bar:
        for protocol in PROTOCOLS:
            found["rows"][protocol] = query_all(keyframes, protocol, every, bar)
            rows = found["rows"][protocol]
            found["summary"][protocol] = summary(rows)
            found["methods"][protocol] = {
                method: recall_at(curve(rows, method)) for method in METHODS
            }
    return found | {"timing": timing(keyframes)}


def text_of(numbers: Numbers) -> str:
    """The results as text."""
    lines = []
    for name, log in numbers["logs"].items():
        for protocol, one in log["summary"].items():
            precision = "-" if one["precision"] is None else f"{one['precision']:.3f}"
            recall = "-" if one["recall"] is None else f"{one['recall']:.2f}"
            lines.append(
                f"{name:18} {protocol:13} {one['queries']:4} queries, {one['in_map']:4} in the map,"
                f" {one['accepted']:4} accepted: precision {precision}"
                f" ({one['precision_low']:.3f} to {one['precision_high']:.3f}), recall {recall}"
            )
            lines.append(
                f"{name:18} {protocol:13} recall at {PRECISION:.0%} precision, in hindsight: "
                + ", ".join(
                    f"{METHODS[method]} {recall:.2f}"
                    for method, recall in log["methods"][protocol].items()
                )
            )
        lines += [
            f"{name:18} map of {row['keyframes']:4} keyframes: {row['query_ms']:.1f} ms a query "
            f"(search {row['search_ms']:.0f}, pairs {row['pairs_ms']:.0f}), "
            f"index in {row['build_s']:.2f} s"
            for row in log["timing"]
        ]
    for row in numbers["floor_plans"]["summary"]:
        precision = "-" if row["precision"] is None else f"{row['precision']:.3f}"
        lines.append(
            f"floor plans, {row['factor']:9} {row['value']:5.2f}: {row['queries']} queries, "
            f"precision {precision}, recall {row['recall']:.2f}"
        )
    return "\n".join(lines)


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    args = common.parse(__doc__, argv, data="", every=4, plans=8)
    if args.every < 1:
        raise InputError(f"{args.every} is too small", field="--every")
    if args.plans < 1:
        raise InputError(f"{args.plans} is too small", field="--plans")
    enable_caches()
    chosen = log_folder.with_reference(args.data, MAX_KEYFRAMES)
    about = {"data": args.data, "every": args.every, "seed": args.seed, "plans": args.plans}
    cache = common.ResultCache(args.out / f"{NAME}_parts", about)
    found = {name: cache(name, partial(run_log, log, args.every)) for name, log in chosen.items()}
    plans = cache("floor_plans", lambda: floor_plan_places.run(args.seed, args.plans, PLAN_QUERIES))
    numbers = {"seed": args.seed, "every": args.every, "logs": found, "floor_plans": plans}
    print(text_of(numbers))
    common.save(args.out, NAME, numbers, place_picture.draw)
    cache.clear()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
