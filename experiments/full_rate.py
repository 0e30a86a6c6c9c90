"""The SLAM benchmark at full scan rate: errors of verified relations beside published ones.

Of logs with relations at whose times there are scans, so that no pose is interpolated. The part of
`real_logs` without ablations.
"""

from pathlib import Path

import numpy as np
from tqdm import tqdm

from experiments import common, log_folder
from experiments.common import Numbers
from experiments.log_folder import Log
from jaxslam.evaluation import log_errors
from jaxslam.pipeline import log_input
from jaxslam.pipeline.chunks import ChunkResult
from jaxslam.pipeline.online import SlamState

OWN, DEAD_RECKONING = "jaxslam", "dead reckoning"
KEYS = ("translation_mean_m", "translation_std_m", "rotation_mean_deg", "rotation_std_deg")
KUEMMERLE, TIPALDI, HESS = (
    "Kuemmerle et al. (2009), On measuring the accuracy of SLAM algorithms",
    "Tipaldi et al. (2014), as cited by Hess et al. (2016)",
    "Hess et al. (2016), Real-time loop closure in 2D LIDAR SLAM, tables II and III",
)
CARTOGRAPHER = "Cartographer"
SOURCES = {
    "scan matching": KUEMMERLE,
    "particle filter": KUEMMERLE,
    "graph mapping": KUEMMERLE,
    "Graph FLIRT": TIPALDI,
    CARTOGRAPHER: HESS,  # tuned for each log
}
PUBLISHED: dict[str, dict[str, tuple[float, float | None, float | None]]] = {
    "intel": {
        "scan matching": (0.220, None, None),
        "particle filter": (0.070, None, None),
        "graph mapping": (0.031, None, 1.3),
        "Graph FLIRT": (0.02, None, 0.3),
        CARTOGRAPHER: (0.0229, 0.0239, 0.45),
    },
    "aces": {
        "scan matching": (0.173, None, None),
        "particle filter": (0.060, None, None),
        "graph mapping": (0.044, None, 0.4),
        CARTOGRAPHER: (0.0375, 0.0426, 0.37),
    },
    "mit-csail": {
        "scan matching": (0.106, None, None),
        "particle filter": (0.049, None, None),
        "graph mapping": (0.004, None, None),
        CARTOGRAPHER: (0.0319, 0.0363, 0.37),
    },
}
"""Mean and standard deviation [m] of the translation, mean rotation [deg], where stated."""


def select(logs: list[Log]) -> list[Log]:
    """Of each name, the log with relations at the times of its scans that has most scans."""
    best: dict[str, Log] = {}
    for log in logs:
        pairs, times = log.relations, log.laser_log.times
        if pairs is not None and log_folder.has_scans_at(times, pairs):
            known = best.get(log.name)
            if known is None or len(times) > len(known.laser_log.times):
                best[log.name] = log
    return list(best.values())


def own_rows(log: Log) -> Numbers:
    """Rows of a log: of its run as `jaxslam run` does it, and of its odometry."""
    laser_log, pairs = log.laser_log, log.relations
    if pairs is None:
        raise ValueError(f"{log.name} has no relations")
    pairs = log_folder.at_scans(laser_log.times, pairs)
    given = log_input.from_laser_log(laser_log)
    with tqdm(total=len(laser_log.times), unit="scan", leave=False, desc=log.name) as bar:

        def show(_: SlamState, part: ChunkResult) -> None:
            bar.update(int(np.asarray(part.keyframes)[-1]) + 1 - bar.n)

        result = log_input.run(given, callback=show)
    found = result.consistency
    estimates = {OWN: result.poses, DEAD_RECKONING: given.odom_poses}
    rows = []
    for method, poses in estimates.items():
        row = {"log": log.name, "method": method, "scans": len(poses), "source": None}
        row |= log_errors.against_relations(laser_log, poses, pairs)["relations"]
        rows.append(row | {"warned": len(found.warnings) > 0 if method == OWN else None})
    return {"rows": rows}


def published_rows(name: str) -> list[Numbers]:
    """Rows of published figures for a log, with None for what is not stated."""
    rows = []
    for method, (translation, std, rotation) in PUBLISHED.get(name, {}).items():
        errors = dict(zip(KEYS, (translation, std, rotation, None), strict=True))
        errors |= {"translation_max_m": None, "used": None}
        about = {"log": name, "method": method, "scans": None, "source": SOURCES[method]}
        rows.append(about | errors | {"warned": None})
    return rows


def compute(logs: list[Log], cache: common.ResultCache) -> list[Numbers]:
    """Rows of all logs of the benchmark, each followed by those that are published."""
    rows: list[Numbers] = []
    for log in select(logs):
        size = len(log.laser_log.times)
        found = cache(f"full rate {log.name} {size}", lambda log=log: own_rows(log))["rows"]
        for row in found + published_rows(log.name):
            rows.append(row)
            print(line(row), flush=True)
    return rows


def line(row: Numbers) -> str:
    """A row as text."""
    text = f"{row['log']:14} {row['method']:16} {row['translation_mean_m']:8.4f}"
    std, largest = row["translation_std_m"], row["translation_max_m"]
    text += " m" if std is None else f" +- {std:.4f} m"
    text += "" if largest is None else f" (at most {largest:.3f})"
    text += "" if row["rotation_mean_deg"] is None else f", {row['rotation_mean_deg']:.2f} deg"
    return text + (" WARNING" if row["warned"] else "")


def draw(rows: list[Numbers], path: Path) -> None:
    """The mean error of each method, and one standard deviation more; a panel for each log."""
    names = list(dict.fromkeys(row["log"] for row in rows))
    methods = [OWN, *SOURCES, DEAD_RECKONING]
    figure, axes = common.canvas(2.0 + 3.2 * len(names), 3.2, 1, len(names))
    for k, (axis, name) in enumerate(zip(axes[0], names, strict=True)):
        for row in rows:
            if row["log"] == name:
                mean, std = row["translation_mean_m"], row["translation_std_m"]
                colour = common.BLUE if row["method"] == OWN else common.ORANGE
                at = methods.index(row["method"])
                axis.plot(mean, at, "o", color=colour)
                if std is not None:
                    axis.plot([mean, mean + std], [at, at], color=colour)
        axis.set(xscale="log", title=name, ylim=(len(methods) - 0.5, -0.5))
        axis.set_xlabel("relation error, mean and std [m]")
        axis.set_yticks(range(len(methods)), methods if k == 0 else [""] * len(methods))
        axis.grid(axis="y", alpha=0.3)
    figure.savefig(path)
