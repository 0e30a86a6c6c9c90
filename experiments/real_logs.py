"""Recorded logs: ablation of scan matching, of landmark types and of tuned noise.

Every log in the folder `--data`, and MIT's Killian Court where `.[data]` is installed, with one set
of defaults. `NAME.reference.tum` and `NAME.relations` beside `NAME.clf` are the references; of logs
of one name, the ablation takes that with fewest scans. Logs with relations at the times of scans
are run as they are, too, and stand beside published figures (`full_rate`). `--ablation 0` and
`--full_rate 0` leave out either part.
Odometry is that of the wheels, or that of the wheels fused with scan matching. Tuned noise is tuned
on the other logs that have a reference, never on the one it is evaluated on. Errors are those of
the smoothed trajectory, which is the result of a run, and of the filter's online estimates; NEES is
the filter's, of errors since the first scan. The references are computed by other programs and are
themselves some centimetres off.
"""

import sys
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import common, full_rate, log_folder, timing
from experiments.log_folder import Log
from jaxslam.core.caches import enable_caches
from jaxslam.core.episode import Episode, measurements_of
from jaxslam.core.features import restrict_features
from jaxslam.core.se2_np import increments, relative
from jaxslam.core.time_series import match_times
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.evaluation import log_errors
from jaxslam.filtering import slam_filter
from jaxslam.filtering.config import confirmed, init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import lidar
from jaxslam.io.errors import InputError
from jaxslam.pipeline import episodes, offline, smoothing_stage
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.results import SlamResult
from jaxslam.tuning import fitting

NAME = "real_logs"
LANDMARKS = {
    "none": (),
    "nodes": (JUNCTION,),
    "nodes+corners": (JUNCTION, CORNER),
    "all": (JUNCTION, CORNER, WALL),
}
ODOMETRY = ("wheels", "scan")
NUM_UPDATES = 12  # of tuning
STYLES = {  # of trajectories: colour, dashes, width
    "reference": (common.BLACK, "--", 1.0),
    "estimate": (common.SKY, "-", 2.5),
    "wheels": (common.RED, ":", 0.8),
}


class Extracted(NamedTuple):
    """Filter input of a log.

    Attributes:
        config: For the scanner of the log, with a map of the size that it needed.
        episode: With scan matches; the ground truth is the reference since the first scan.
        ms: Milliseconds per scan on one core, from ranges to the smoothed map, by odometry.
    """

    config: Config
    episode: Episode
    ms: dict[str, float]


def select(logs: list[Log]) -> list[Log]:
    """Of each name, the log with fewest scans: that of keyframes, not the one at full rate."""
    fewest: dict[str, Log] = {}
    for log in sorted(logs, key=lambda log: len(log.laser_log.times)):
        fewest.setdefault(log.name, log)
    return [log for log in logs if fewest[log.name] is log]


def extract(log: Log) -> Extracted:
    """Features and scan matches of a log, and the time to map it on one core."""
    laser_log = log.laser_log
    config = Config.for_laser_log(laser_log.lidar)
    config = config._replace(keyframe_distance=None)  # the episode holds every scan
    odometry = increments(laser_log.odom_poses)
    truth, truth_mask = np.zeros(odometry.shape, np.float32), np.zeros(len(odometry), bool)
    if log.reference is not None:
        i, j = match_times(laser_log.times, log.reference[0]).T
        truth[i] = relative(log.reference[1][j[0]], log.reference[1][j])
        truth_mask[i] = True
    results: dict[str, SlamResult] = {}

    def run(source: str) -> None:
        match_scans = source == "scan"
        params = NoiseParams.for_laser_log(match_scans=match_scans)
        results[source] = offline.run_slam(
            config, params, odometry, laser_log.ranges, match_scans=match_scans, smooth=True
        )

    timing.pin()
    taken = timing.fastest({source: (run, source) for source in ODOMETRY}, repeats=1)
    timing.unpin()
    found = results["scan"]
    capacity = found.belief.num_seen.size  # what it grew to
    config = config._replace(filter=config.filter._replace(max_landmarks=capacity))
    episode = Episode(
        truth, odometry, found.features, truth_mask=truth_mask, scan_matches=found.scan_matches
    )
    ms = {source: 1e3 * s / len(odometry) for source, s in taken.items()}
    return Extracted(config, episodes.to_numpy_precision(episode), ms)


def restrict(episode: Episode, odometry: str, landmarks: str) -> Episode:
    """The episode with some landmark types, and with or without scan matches."""
    kinds = jnp.array(LANDMARKS[landmarks] or (-1,), jnp.int32)
    wanted = jnp.isin(jnp.asarray(episode.features.kind), kinds)
    features = jax.vmap(restrict_features)(episode.features, wanted)
    matches = episode.scan_matches if odometry == "scan" else None
    return episode._replace(features=jax.tree.map(np.asarray, features), scan_matches=matches)


def tune(others: Sequence[Extracted], odometry: str) -> common.Numbers:
    """Noise tuned on the logs that have a reference, `{"noise": None}` if there are none."""
    usable = [one for one in others if one.episode.truth_mask.any()]
    if not usable:
        return {"noise": None}
    train = episodes.stack_episodes([restrict(one.episode, odometry, "all") for one in usable])
    start = NoiseParams.for_laser_log(match_scans=odometry == "scan")
    with tqdm(total=NUM_UPDATES + 1, unit="update", leave=False, desc=f"tuning, {odometry}") as bar:
        # Of the scanner, the filter uses only the field of view.
        found = fitting.tune(
            usable[0].config,
            start,
            train,
            num_updates=NUM_UPDATES,
            callback=lambda _: bar.update(),
        )
    return {"noise": found.params._asdict()}


def row(
    log: Log, extracted: Extracted, odometry: str, landmarks: str, params: NoiseParams
) -> tuple[common.Numbers, np.ndarray]:
    """Errors of one variant, and the estimated positions (T, 2)."""
    config = extracted.config
    episode = restrict(extracted.episode, odometry, landmarks)
    measurements = measurements_of(episode)
    start = init(config.filter, jnp.zeros(3))
    belief, info = slam_filter.run_filter(config.filter, params, start, measurements)
    measurements, info = jax.tree.map(np.asarray, (measurements, info))
    filtered = np.asarray(info.pose, np.float64)
    scans = None
    if odometry == "scan" and LANDMARKS[landmarks]:  # scan matching alone closes no loops
        ranges = jnp.asarray(log.laser_log.ranges, float)
        scans = jax.tree.map(np.asarray, lidar.to_scan(config.frontend.lidar, ranges))
    poses, _, _ = smoothing_stage.smooth_result(
        config, params, jnp.zeros(3), measurements, info, belief, scans
    )
    numbers: common.Numbers = {"nees": None}
    numbers["landmarks_confirmed"] = int(np.sum(confirmed(config.filter, belief)))
    numbers["ms_per_scan"] = extracted.ms[odometry]
    for prefix, estimate in (("", poses), ("filter_", filtered)):
        found = log_errors.errors_against(log.laser_log, estimate, log.reference, log.relations)
        pairs = found.get("relations", {})
        numbers[f"{prefix}ate_rmse_m"] = found.get("ate_rmse_m")
        numbers[f"{prefix}relations_translation_m"] = pairs.get("translation_mean_m")
        numbers[f"{prefix}relations_rotation_deg"] = pairs.get("rotation_mean_deg")
    if log.reference is not None:
        error = log_errors.pose_errors(filtered, episode.truth)
        error = np.where(episode.truth_mask[:, None], error, np.nan)
        numbers["nees"] = log_errors.mean_nees_per_dof(error, info.pose_cov)
    return numbers, poses[:, :2]


def compute(logs: list[Log], with_tuning: bool, cache: common.ResultCache) -> common.Numbers:
    """Rows of the ablation on all logs, and the trajectories that are drawn."""
    extracted = [extract(log) for log in tqdm(logs, unit="log", desc="extracting features")]
    rows, trajectories = [], {}
    for k, (log, own) in enumerate(zip(logs, extracted, strict=True)):
        odom_poses = log.laser_log.odom_poses
        drawn = {"wheels": relative(odom_poses[0], odom_poses)[:, :2]}
        trajectories[log.name] = drawn
        if own.episode.truth_mask.any():
            drawn["reference"] = own.episode.truth[own.episode.truth_mask, :2]
        others = [*extracted[:k], *extracted[k + 1 :]]
        for odometry in ODOMETRY:
            noises = {"default": NoiseParams.for_laser_log(match_scans=odometry == "scan")}
            if with_tuning:
                found = cache(f"{log.name} {odometry}", partial(tune, others, odometry))["noise"]
                if found is not None:
                    values = (found[name] for name in NoiseParams._fields)
                    tuned = (x if x is None else jnp.asarray(x, float) for x in values)
                    noises["tuned"] = NoiseParams(*tuned)
            for landmarks, (name, params) in product(LANDMARKS, noises.items()):
                numbers, positions = row(log, own, odometry, landmarks, params)
                about = {"log": log.name, "odometry": odometry, "landmarks": landmarks}
                rows.append(about | {"noise": name} | numbers)
                print(line(rows[-1]), flush=True)
                if (odometry, landmarks, name) == ("scan", "all", "default"):
                    drawn["estimate"] = positions
    ms = {log.name: own.ms for log, own in zip(logs, extracted, strict=True)}
    return {"rows": rows, "ms_per_scan": ms, "ways": trajectories}


def line(row: common.Numbers) -> str:
    """A row as text."""
    text = f"{row['log']:14} {row['odometry']:7} {row['landmarks']:14} {row['noise']:8}"
    names = {"ate_rmse_m": "m ATE", "relations_translation_m": "m relations"}
    errors = [
        f"{row[key]:8.3f} {name} (filter {row[f'filter_{key}']:.3f})"
        for key, name in names.items()
        if row[key] is not None
    ]
    errors += [] if row["nees"] is None else [f"{row['nees']:8.3f} NEES per dof"]
    return f"{text}{'  '.join(errors)}  {row['ms_per_scan']:.1f} ms"


def draw(numbers: common.Numbers, path: Path) -> None:
    """The trajectories of each log, and the errors of all its rows; and the benchmark beside it."""
    logs, benchmark = numbers["ways"], numbers["full_rate"]
    if benchmark:
        beside = path.with_stem(f"{path.stem}_full_rate")
        full_rate.draw(benchmark, beside if logs else path)
    if not logs:
        return
    figure, axes = common.canvas(13, 4.6 * len(logs), len(logs), 2)
    for (left, right), (name, own) in zip(axes, logs.items(), strict=True):
        for what, (colour, dashes, width) in STYLES.items():
            if what in own:
                left.plot(
                    *np.array(own[what], float).T,
                    dashes,
                    color=colour,
                    linewidth=width,
                    zorder=3 if what == "reference" else 2,
                    label=what,
                )
        close = np.concatenate([np.array(own[what]) for what in own if what != "wheels"])
        low, high = close.min(axis=0) - 3.0, close.max(axis=0) + 3.0
        left.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        left.set(xlabel="x [m]", ylabel="y [m]", title=name)
        left.legend(fontsize="small")
        _draw_rows(right, [row for row in numbers["rows"] if row["log"] == name])
    figure.savefig(path)


def _draw_rows(axis: Any, rows: list[common.Numbers]) -> None:
    key = "ate_rmse_m" if rows[0]["ate_rmse_m"] is not None else "relations_translation_m"
    colours = {"wheels": common.RED, "scan": common.BLUE}
    for odometry, colour in colours.items():
        for noise, marker in (("default", "o"), ("tuned", "^")):
            some = [row for row in rows if (row["odometry"], row["noise"]) == (odometry, noise)]
            if some:
                names = [row["landmarks"] for row in some]
                axis.plot(
                    names,
                    [row[key] for row in some],
                    marker + "-",
                    color=colour,
                    fillstyle="full" if noise == "default" else "none",
                    label=f"{odometry}, {noise} noise",
                )
    axis.set(yscale="log", xlabel="landmarks")
    axis.set_ylabel("ATE RMSE [m]" if key == "ate_rmse_m" else "mean relation error [m]")
    common.log_scale(axis)
    axis.legend(fontsize="small")


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    args = common.parse(__doc__, argv, data="", tune=1, ablation=1, full_rate=1)
    enable_caches()
    cache = common.ResultCache(args.out / f"{NAME}_parts", {"data": args.data})
    logs = log_folder.find_logs(log_folder.checked_folder(args.data))
    if not args.ablation:
        logs = full_rate.select(logs)
    if not logs or not (args.ablation or args.full_rate):
        raise InputError("no log", advice="give --data FOLDER, or pip install '.[data]'")
    benchmark = full_rate.compute(logs, cache) if args.full_rate else []
    numbers: common.Numbers = {"rows": [], "ms_per_scan": {}, "ways": {}}
    if args.ablation:
        numbers = compute(select(logs), bool(args.tune), cache)
    numbers |= {"full_rate": benchmark}
    common.save(args.out, NAME, {"seed": args.seed} | numbers, draw)
    cache.clear()
    return 0


if __name__ == "__main__":
    sys.exit(main())
