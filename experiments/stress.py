"""What `jaxslam run` makes of logs with one fault each, and whether it warns where it is lost.

Every log in the folder `--data`, and `--drives` simulated drives of which a fifth is driven
backwards, are run as they are and with each fault of `hurt_logs`, written as CARMEN logs and read
again. Faults that are random are drawn `--seeds` times. Errors are those of the smoothed
trajectory: RMSE of the positions after rigid alignment with the reference, by the order of the
scans, and mean errors of verified relative poses. A row is lost if the first, or without a
reference the second, exceeds 0.5 m, and silent if it is lost and there was no warning.
"""

import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from experiments import common, damaged_drives, hurt_logs, log_folder
from experiments.common import Numbers
from experiments.drive_records import DriveRecord, numbers_of, write
from experiments.hurt_logs import FAULTS
from experiments.log_folder import Log
from jaxslam.core.caches import enable_caches
from jaxslam.core.logs import LaserLog
from jaxslam.core.time_series import match_times
from jaxslam.evaluation import log_errors
from jaxslam.io import readers
from jaxslam.io.errors import InputError
from jaxslam.pipeline import log_input
from jaxslam.pipeline.log_input import OdometrySource

NAME = "stress"
SIMULATED = "simulated"
LOST_ERROR = 0.5  # [m]
SCANS_ONLY = "-scans-only"  # ending of a fault where scans alone are matched
HOWS = [*FAULTS, f"still{SCANS_ONLY}"]


class Source(NamedTuple):
    """A recording without fault, and what is known of its T scans.

    Attributes:
        name: Of the log or drive.
        recording: With numbers 0 to T - 1.
        truth: (T, 3) [m, m, rad] reference poses; NaN where there are none.
        log: The log, if it has relations.
    """

    name: str
    recording: DriveRecord
    truth: np.ndarray
    log: Log | None = None


def recorded(name: str, log: Log) -> Source:
    """The source of a recorded log."""
    truth = np.full(log.laser_log.odom_poses.shape, np.nan)
    if log.reference is not None:
        i, j = match_times(log.laser_log.times, log.reference[0]).T
        truth[i] = log.reference[1][j]
    has_relations = log.relations is not None
    return Source(name, DriveRecord.of_log(log.laser_log), truth, log if has_relations else None)


def simulated(seed: int, number: int) -> Source:
    """The source of a simulated drive with the odometry of wheels that drift."""
    drive = damaged_drives.simulate(1_000_000 * (seed + 1) + number, reversing=True)
    rng = np.random.default_rng([seed, number])
    return Source(f"{SIMULATED}-{number}", DriveRecord.of_drive(rng, drive), drive.poses)


def cases(seed: int, num_seeds: int) -> Iterator[tuple[str, int | None]]:
    """Faults and their seeds; None where a fault is not random."""
    for how in HOWS:
        seeds = range(seed, seed + num_seeds) if how in hurt_logs.RANDOM else (None,)
        yield from ((how, one) for one in seeds)


def run_case(source: Source, how: str, seed: int | None) -> Numbers:
    """The row of a fault: errors and warnings of the log that has it."""
    fault, scans_only, _ = how.partition(SCANS_ONLY)
    hurt = hurt_logs.hurt(fault, seed or 0, source.recording)
    row: Numbers = {"log": source.name, "how": how, "seed": seed, "scans": len(hurt.number)}
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "hurt.clf"
            write(path, hurt)
            log = readers.read_log(path)
        poses, warned, notes = run_log(log, "scans-only" if scans_only else "scan")
    except (InputError, ValueError) as error:
        text = str(error).rpartition("hurt.clf: ")[2]
        return row | errors(source, np.zeros(0, int), np.zeros((0, 3))) | refused(text)
    numbers = numbers_of(hurt, log)
    outcome = {"warned": warned, "notes": notes, "refused": None}
    return row | errors(source, numbers, poses) | outcome


def run_log(log: LaserLog, source: OdometrySource) -> tuple[np.ndarray, bool, list[str]]:
    """Run a log as `jaxslam run` does.

    Returns:
        Smoothed poses (T, 3), NaN for scans that are not in the largest map; whether the map
        contradicts itself, or there are several; and the notes on the log.
    """
    given = log_input.from_laser_log(log, source)
    result = log_input.run(given)
    warned = len(result.consistency.warnings) > 0 or len(result.other_parts) > 0
    return result.poses, warned, [*given.notes, *result.notes]


def errors(source: Source, numbers: np.ndarray, poses: np.ndarray) -> Numbers:
    """Errors of poses (K, 3) of the scans of these numbers (K,); None where there is no reference.

    Poses that are not finite are left out. Relations are taken between scans at their times where
    the log has these, else at the times extended by the undamaged odometry.
    """
    found: Numbers = dict.fromkeys(("ate_rmse_m", "relations_translation_m"))
    found["relations_rotation_deg"] = None
    mapped = np.isfinite(poses).all(axis=1)
    numbers, poses = numbers[mapped], poses[mapped]
    known = np.isfinite(source.truth[numbers]).all(axis=1)
    if known.sum() > 1:
        truth = source.truth[numbers][known]
        found["ate_rmse_m"] = damaged_drives.position_error(poses[known], truth)
    if source.log is not None and source.log.relations is not None and len(numbers):
        log, pairs = source.log.laser_log, source.log.relations
        part = log._replace(times=log.times[numbers])
        if log_folder.has_scans_at(log.times, pairs):
            pairs = log_folder.at_scans(part.times, pairs)
        if len(pairs.t1):
            own = log_errors.against_relations(part, poses, pairs)["relations"]
            found["relations_translation_m"] = own["translation_mean_m"]
            found["relations_rotation_deg"] = own["rotation_mean_deg"]
    return found


def refused(reason: str) -> Numbers:
    """The rest of the row of a log that cannot be run; that is no silent error."""
    return {"warned": False, "notes": [], "refused": reason}


def sources(folder: Path | None, seed: int, drives: int) -> list[tuple[str, Callable[[], Source]]]:
    """Names of the logs of a folder and of simulated drives, and functions that make them."""
    logs = log_folder.find_logs(folder, installed=False)
    names = log_folder.unique_names(logs)
    found: list[tuple[str, Callable[[], Source]]] = [
        (name, partial(recorded, name, log)) for name, log in zip(names, logs, strict=True)
    ]
    return found + [
        (f"{SIMULATED}-{number}", partial(simulated, seed, number)) for number in range(drives)
    ]


def compute(
    folder: Path | None, seed: int, drives: int, num_seeds: int, cache: common.ResultCache
) -> Numbers:
    """Rows of all logs and faults, and the table of them.

    Raises:
        InputError: There is no log and no drive, or a log cannot be read.
    """
    makers = sources(folder, seed, drives)
    if not makers:
        raise InputError("no log", advice="name a folder of logs, or ask for simulated drives")
    todo, rows = list(cases(seed, num_seeds)), []
    with tqdm(total=len(makers) * len(todo), unit="row") as bar:
        for name, make in makers:
            source: list[Source] = []  # made only if a row is not there yet

            def run(how: str, own: int | None, make=make, source=source) -> Numbers:
                if not source:
                    source.append(make())
                return run_case(source[0], how, own)

            for how, own in todo:
                bar.set_postfix_str(f"{name} {how}")
                rows.append(cache(f"{name} {how} {own}", partial(run, how, own)))
                bar.write(line(rows[-1]))
                bar.update()
    return {"seed": seed, "rows": rows, "table": table(rows)}


def error_of(row: Numbers) -> float | None:
    """The error [m] by which a row is lost or not."""
    ate = row["ate_rmse_m"]
    return row["relations_translation_m"] if ate is None else ate


def group_of(row: Numbers) -> str:
    """Column of the table that a row belongs to: its log, or all simulated drives."""
    return SIMULATED if row["log"].startswith(f"{SIMULATED}-") else row["log"]


def table(rows: list[Numbers]) -> Numbers:
    """By log and fault: number of rows, median and largest error, and how many were warned of."""
    found: Numbers = {}
    for row in rows:
        found.setdefault(group_of(row), {}).setdefault(row["how"], []).append(row)
    return {
        group: {how: _summary(some) for how, some in by_how.items()}
        for group, by_how in found.items()
    }


def _summary(rows: list[Numbers]) -> Numbers:
    known = [(error, row) for row in rows if (error := error_of(row)) is not None]
    values = [error for error, _ in known]
    lost = [row for error, row in known if error > LOST_ERROR]
    return {
        "rows": len(rows),
        "median_m": float(np.median(values)) if values else None,
        "worst_m": max(values, default=None),
        "warned": sum(row["warned"] for row in rows),
        "refused": sum(row["refused"] is not None for row in rows),
        "lost": len(lost),
        "silent": sum(not row["warned"] for row in lost),
    }


def line(row: Numbers) -> str:
    """A row as text."""
    seed = "" if row["seed"] is None else f" {row['seed']}"
    text = f"{row['log']:16} {row['how'] + seed:18}"
    if row["refused"]:
        return f"{text} refused: {row['refused']}"
    names = {"ate_rmse_m": "m ATE", "relations_translation_m": "m relations"}
    text += "".join(f" {row[key]:8.3f} {of}" for key, of in names.items() if row[key] is not None)
    return text + (" WARNING" if row["warned"] else "")


def table_text(numbers: Numbers) -> str:
    """The table as text: median and largest error, and how many of the rows were warned of."""
    groups = numbers["table"]
    lines = [" " * 18 + "".join(f"{group:>26}" for group in groups)]
    for how in HOWS:
        cells = [_cell(groups[group].get(how)) for group in groups]
        lines.append(f"{how:18}" + "".join(f"{cell:>26}" for cell in cells))
    total = {key: _total(numbers, key) for key in ("rows", "lost", "silent", "refused")}
    lines.append(f"{total['lost']} of {total['rows']} rows lost, {total['silent']} silently")
    if total["refused"]:
        lines[-1] += f"; {total['refused']} refused"
    return "\n".join(lines)


def _cell(one: Numbers | None) -> str:
    if one is None or one["median_m"] is None:
        return "-"
    worst = f" to {one['worst_m']:.3f}" if one["rows"] > 1 else ""
    return f"{one['median_m']:.3f}{worst} ({one['warned']}/{one['rows']})"


def _total(numbers: Numbers, key: str) -> int:
    return sum(one[key] for by_how in numbers["table"].values() for one in by_how.values())


def draw(numbers: Numbers, path: Path) -> None:
    """The errors of all rows by fault, a panel for each log; hollow if there was a warning."""
    groups = list(numbers["table"])
    figure, axes = common.canvas(3.2 + 2.8 * len(groups), 6.0, 1, len(groups))
    for k, (axis, group) in enumerate(zip(axes[0], groups, strict=True)):
        some = [row for row in numbers["rows"] if group_of(row) == group]
        for row in some:
            if (error := error_of(row)) is not None:
                colour = common.RED if error > LOST_ERROR else common.BLUE
                fill = "none" if row["warned"] else colour
                axis.plot(error, HOWS.index(row["how"]), "o", color=colour, markerfacecolor=fill)
        is_ate = any(row["ate_rmse_m"] is not None for row in some)
        axis.axvline(LOST_ERROR, color=common.BLACK, linewidth=0.8, linestyle=":")
        axis.set(xscale="log", title=group, ylim=(len(HOWS) - 0.5, -0.5))
        axis.set_xlabel("ATE RMSE [m]" if is_ate else "mean relation error [m]")
        axis.set_yticks(range(len(HOWS)), HOWS if k == 0 else [""] * len(HOWS))
        axis.grid(axis="y", alpha=0.3)
    for label, fill in (("no warning", common.BLACK), ("warning", "none")):
        axes[0, 0].plot([], [], "o", color=common.BLACK, markerfacecolor=fill, label=label)
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path)


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    args = common.parse(__doc__, argv, data="", drives=10, seeds=1)
    for name in ("drives", "seeds"):
        if (value := getattr(args, name)) < (name == "seeds"):
            raise InputError(f"{value} is too small", field=f"--{name}")
    folder = log_folder.checked_folder(args.data)
    enable_caches()
    cache = common.ResultCache(args.out / f"{NAME}_parts", {"data": args.data, "seed": args.seed})
    numbers = compute(folder, args.seed, args.drives, args.seeds, cache)
    print(table_text(numbers))
    common.save(args.out, NAME, numbers, draw)
    cache.clear()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
