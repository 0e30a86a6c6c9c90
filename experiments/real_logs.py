"""Recorded logs: what aligned scans, each kind of landmark and tuned noise are worth.

Every log in the folder `--data`, and MIT's Killian Court where `.[data]` is installed, by one set
of defaults. `NAME.reference.tum` and `NAME.relations` beside `NAME.clf` are what it is judged by.
Odometry is that of the wheels, or of scans aligned to those before and fused with the wheels. Tuned
noise is tuned on the other logs that have a reference, never on the one it is judged on. Errors are
those of the smoothed way, which is what a run leaves, and of the filter's, which was known as the
robot went; NEES is the filter's, of errors since the first scan. References are made by other
programs: some centimetres of an error are theirs.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import common, one_core
from jaxslam.cli.options import enable_caches
from jaxslam.core import episode
from jaxslam.core.episode import Episode
from jaxslam.core.features import restrict_features
from jaxslam.core.logs import LaserLog, Relations
from jaxslam.core.se2_np import relative
from jaxslam.core.time_series import match_times
from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.evaluation import log_errors
from jaxslam.evaluation.log_errors import Trajectory
from jaxslam.filtering import slam_filter
from jaxslam.filtering.config import confirmed, init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import lidar
from jaxslam.io import readers, tum
from jaxslam.io.errors import InputError
from jaxslam.io.relations import read
from jaxslam.pipeline import episodes, offline
from jaxslam.pipeline.config import MAX_LANDMARKS, Config
from jaxslam.pipeline.offline import SlamResult
from jaxslam.tuning import fitting

NAME = "real_logs"
SUFFIXES = (".clf", ".log", ".gz", ".g2o", ".zip", ".bag", ".npz")
LANDMARKS = {
    "none": (),
    "nodes": (JUNCTION,),
    "nodes+corners": (JUNCTION, CORNER),
    "all": (JUNCTION, CORNER, WALL),
}
ODOMETRY = ("wheels", "scan")
STEPS = 12  # of tuning


class Known(NamedTuple):
    """A log, and what is known of the way of its robot."""

    name: str
    recording: LaserLog
    reference: Trajectory | None
    relations: Relations | None


class Seen(NamedTuple):
    """What the filter is given of a log."""

    config: Config
    log: Episode  # with its motions aligned; the truth is the reference since the first scan
    ms: dict[str, float]  # a scan, one core, from ranges to the smoothed map, by odometry


def find(folder: Path | None) -> list[Known]:
    """The logs of a folder, and those that packages bring."""
    files = sorted(folder.rglob("*")) if folder else []
    paths = {
        path.name.split(".")[0]: path
        for path in files
        if path.suffix in SUFFIXES or (path / "metadata.yaml").is_file()
    }
    for name in readers.NAMED_LOGS:
        try:
            paths[name] = readers.find(name)
        except InputError as error:
            print(f"left out: {error}")

    def beside(name: str, ending: str) -> Path | None:
        own = [file for file in files if file.name.endswith(f"{name}{ending}")]
        return own[0] if own else None

    found = []
    for name, path in paths.items():
        reference, pairs = beside(name, ".reference.tum"), beside(name, ".relations")
        one = Known(
            name,
            readers.read(path),
            None if reference is None else tum.read(reference),
            None if pairs is None else read(pairs),
        )
        found.append(one)
    return found


def look(known: Known) -> Seen:
    """Features and aligned motions of a log, and what mapping it costs on one core."""
    recording = known.recording
    config = episodes.laser_log_config([recording])._replace(
        filter=episodes.laser_log_config([recording]).filter._replace(
            max_landmarks=MAX_LANDMARKS,
        ),
    )
    motion = episodes.odometry_increments(recording.odom_poses)
    scans = lidar.to_scan(config.frontend.lidar, jnp.asarray(recording.ranges, float))
    truth, judged = np.zeros(motion.shape, np.float32), np.zeros(len(motion), bool)
    if known.reference is not None:
        i, j = match_times(recording.times, known.reference[0]).T
        truth[i] = relative(known.reference[1][j[0]], known.reference[1][j])
        judged[i] = True
    surveys: dict[str, SlamResult] = {}

    def survey(odometry: str) -> None:
        by_scans = odometry == "scan"
        given = config, NoiseParams.for_laser_log(match_scans=by_scans), jnp.zeros(3), motion, scans
        surveys[odometry] = offline.run_slam(*given, match_scans=by_scans, smooth=True)

    one_core.pin()
    taken = one_core.least({name: (survey, name) for name in ODOMETRY}, repeats=1)
    one_core.unpin()
    found = surveys["scan"]
    config = config._replace(
        filter=config.filter._replace(
            max_landmarks=found.belief.num_seen.size,
        ),
    )  # as many as it grew to
    log = Episode(truth, motion, found.nodes, None, judged, scan_matches=found.aligned)
    return Seen(
        config,
        episodes.to_numpy_precision(log),
        {name: 1e3 * s / len(motion) for name, s in taken.items()},
    )


def given(log: Episode, odometry: str, landmarks: str) -> Episode:
    """The log with some kinds of landmarks, and with its motions aligned or not."""
    kinds = jnp.array(LANDMARKS[landmarks] or (-1,), jnp.int32)
    some = jax.vmap(restrict_features)(log.features, jnp.isin(log.features.kind, kinds))
    aligned = log.scan_matches if odometry == "scan" else None
    return log._replace(features=jax.tree.map(np.asarray, some), scan_matches=aligned)


def tuned(others: Sequence[Seen], odometry: str) -> dict[str, Any] | None:
    """Noise tuned on the logs that have a reference; None if there are none."""
    some = [one for one in others if one.log.truth_mask.any()]
    if not some:
        return None
    together = episodes.stack_episodes([given(one.log, odometry, "all") for one in some])
    with tqdm(total=STEPS + 1, unit="step", leave=False, desc=f"tuning, {odometry}") as bar:
        start = NoiseParams.for_laser_log(match_scans=odometry == "scan")
        report = lambda _: bar.update()
        # The filter asks of the scanner no more than its field of view.
        found = fitting.tune(some[0].config, start, together, num_updates=STEPS, callback=report)
    return found.params._asdict()


def row(
    known: Known, seen: Seen, odometry: str, landmarks: str, noise: NoiseParams
) -> tuple[common.Numbers, np.ndarray]:
    """Errors of one way to do it, and the estimated positions (T, 2)."""
    log = given(seen.log, odometry, landmarks)
    start = init(seen.config.filter, jnp.zeros(3))
    inputs = episode.measurements_of(log)
    belief, info = slam_filter.run_filter(seen.config.filter, noise, start, inputs)
    inputs, info = jax.tree.map(np.asarray, (inputs, info))
    filtered = np.asarray(info.pose, np.float64)
    scans = None
    if odometry == "scan" and LANDMARKS[landmarks]:  # scans alone are odometry, no loop is closed
        scans = lidar.to_scan(
            seen.config.frontend.lidar, jnp.asarray(known.recording.ranges, float)
        )
    poses, _, _ = offline.smooth_result(
        seen.config, noise, jnp.zeros(3), inputs, info, belief, jax.tree.map(np.asarray, scans)
    )
    numbers: common.Numbers = {"nees": None}
    numbers["landmarks_confirmed"] = int(np.sum(confirmed(seen.config.filter, belief)))
    numbers["ms_per_scan"] = seen.ms[odometry]
    for prefix, way in (("", poses), ("filter_", filtered)):
        told = log_errors.errors_against(known.recording, way, known.reference, known.relations)
        pairs = told.get("relations", {})
        numbers[f"{prefix}ate_rmse_m"] = told.get("ate_rmse_m")
        numbers[f"{prefix}relations_translation_m"] = pairs.get("translation_mean_m")
        numbers[f"{prefix}relations_rotation_deg"] = pairs.get("rotation_mean_deg")
    if known.reference is not None:
        error = np.where(
            log.truth_mask[:, None], log_errors.pose_errors(filtered, log.truth), np.nan
        )
        numbers["nees"] = log_errors.mean_nees_per_dof(error, info.pose_cov)
    return numbers, poses[:, :2]


def compute(folder: Path | None, tune: bool, kept: common.Kept) -> common.Numbers:
    """Rows of all logs, and the ways that are drawn.

    Raises:
        InputError: There is no log, or one cannot be read.
    """
    known = find(folder)
    if not known:
        raise InputError("no log", advice="give --data FOLDER, or pip install '.[data]'")
    seen = [look(one) for one in tqdm(known, unit="log", desc="looking")]
    rows, ways = [], {}
    for k, (one, own) in enumerate(zip(known, seen, strict=True)):
        wheels = relative(one.recording.odom_poses[0], one.recording.odom_poses)
        ways[one.name] = {"wheels": wheels[:, :2]}
        if own.log.truth_mask.any():
            ways[one.name]["reference"] = own.log.truth[own.log.truth_mask, :2]
        for odometry in ODOMETRY:
            noises = {"default": NoiseParams.for_laser_log(match_scans=odometry == "scan")}
            others = [*seen[:k], *seen[k + 1 :]]
            make = lambda others=others, odometry=odometry: {"noise": tuned(others, odometry)}
            found = kept(f"{one.name} {odometry}", make)["noise"] if tune else None
            if found is not None:
                values = {name: x and jnp.asarray(x, float) for name, x in found.items()}
                noises["tuned"] = NoiseParams(**values)
            for landmarks in LANDMARKS:
                for name, noise in noises.items():
                    numbers, way = row(one, own, odometry, landmarks, noise)
                    about = {"log": one.name, "odometry": odometry, "landmarks": landmarks}
                    rows.append(about | {"noise": name} | numbers)
                    print(line(rows[-1]), flush=True)
                    if (odometry, landmarks, name) == ("scan", "all", "default"):
                        ways[one.name]["estimate"] = way
    ms = {one.name: own.ms for one, own in zip(known, seen, strict=True)}
    return {"rows": rows, "ms_per_scan": ms, "ways": ways}


def line(row: common.Numbers) -> str:
    """A row as text."""
    text = f"{row['log']:14} {row['odometry']:7} {row['landmarks']:14} {row['noise']:8}"
    names = {"ate_rmse_m": "m ATE", "relations_translation_m": "m relations"}
    told = [
        f"{row[key]:8.3f} {name} (filter {row[f'filter_{key}']:.3f})"
        for key, name in names.items()
        if row[key] is not None
    ]
    told += [] if row["nees"] is None else [f"{row['nees']:8.3f} NEES"]
    return f"{text}{'  '.join(told)}  {row['ms_per_scan']:.1f} ms"


def draw(numbers: common.Numbers, path: Path) -> None:
    """The way of each log, and the errors of all its rows."""
    ways = numbers["ways"]
    figure, axes = common.canvas(13, 4.6 * len(ways), len(ways), 2)
    styles = {
        "reference": {"color": common.BLACK, "linestyle": "--", "linewidth": 1.0, "zorder": 3},
        "estimate": {"color": common.SKY, "linewidth": 2.5},
        "wheels": {"color": common.RED, "linestyle": ":", "linewidth": 0.8},
    }
    for (left, right), (name, own) in zip(axes, ways.items(), strict=True):
        for what, style in styles.items():
            if what in own:
                left.plot(*np.array(own[what], float).T, label=what, **style)
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
                style = {"color": colour, "fillstyle": "full" if noise == "default" else "none"}
                label = f"{odometry}, {noise} noise"
                axis.plot(names, [row[key] for row in some], marker + "-", label=label, **style)
    axis.set(yscale="log", xlabel="landmarks")
    axis.set_ylabel("ATE RMSE [m]" if key == "ate_rmse_m" else "mean error of relations [m]")
    common.plain_log(axis)
    axis.legend(fontsize="small")


@common.ended(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for what cannot be done, 130 for Ctrl-C."""
    options = common.parse(__doc__, argv, data="", tune=1)
    enable_caches()
    kept = common.Kept(options.out / f"{NAME}_parts", {"data": options.data})
    folder = Path(options.data) if options.data else None
    if folder is not None and not folder.is_dir():
        raise InputError("is no folder", path=folder, advice="name the folder of the logs")
    numbers = compute(folder, bool(options.tune), kept)
    common.save(options.out, NAME, {"seed": options.seed} | numbers, draw)
    kept.clear()
    return 0


if __name__ == "__main__":
    sys.exit(main())
