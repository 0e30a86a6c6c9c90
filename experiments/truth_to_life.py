"""Simulated robots against recorded ones: how true to life a simulation is.

Each of four logs in the folder `--data` has a counterpart: its map as the building, its estimated
poses as the true ones, its scanner, and wheels with the errors of its odometry. Both are mapped by
the same pipeline and measured alike: features and matches a scan, innovations, alignment of scans,
ranges against their own map. Rows have the measures of the counterpart by those of the log, for
three simulations:

    ideal      nothing goes wrong, and a scan takes no time
    scan time  the beams of a scan are measured one after the other while the robot moves
    typical    that, and `typical_life`, the same for all logs

`--left_out 1` also simulates each log with what the other three ask for, `left out`. What each log
asks for follows from `scan time` and `typical`: numbers of people and shares of black walls by
straight lines, the error that neighbouring beams share by its square.
"""

import sys
from pathlib import Path

import jax
import numpy as np

from experiments import common, counterparts, drive_measures, log_folder, real_logs
from experiments.common import Numbers
from experiments.counterparts import Counterpart
from experiments.log_folder import Log
from jaxslam.core.caches import enable_caches
from jaxslam.core.logs import LaserLog
from jaxslam.evaluation import log_errors, trajectory
from jaxslam.io.errors import InputError
from jaxslam.simulation import life_defaults
from jaxslam.simulation.life import Life, life_in
from jaxslam.simulation.life_defaults import typical_life

NAME = "truth_to_life"
LOGS = ("intel", "aces", "freiburg-101", "mit-csail")
VARIANTS = ("ideal", "scan time", "typical")
LEFT_OUT = "left out"
MAX_PEOPLE = 16  # slots: all variants run one program
TARGETS = ("matches", "nis", "residual_rms_m", "residual_median_m")
TOLERANCE = 0.25
ASKED = {"people_per_metre": ("short", 1), "black": ("missing_at_wall", 1)}
ASKED["shared_std"] = ("residual_median_m", 2)
"""What is estimated for each log: the measure that it changes, and the power of it."""


def measure(log: LaserLog) -> tuple[Numbers, np.ndarray, np.ndarray]:
    """Map a log; its measures, estimated poses (T, 3) and the walls (S, 4) [m] of its map."""
    config, scans, result = drive_measures.run(log)
    mapped = np.isfinite(result.poses).all(axis=1)
    numbers: Numbers = {"mapped": float(mapped.mean())}
    numbers |= drive_measures.feature_numbers(config, result)
    numbers |= drive_measures.alignment_numbers(log.lidar, scans, result)
    walls = counterparts.walls_of(log.lidar, result.poses, scans)
    own = jax.tree.map(lambda x: x[mapped], scans)
    numbers |= drive_measures.range_numbers(log.lidar, own, result.poses[mapped], walls)
    numbers["roughness_m"] = drive_measures.roughness(log.lidar, log.ranges)
    wheels = counterparts.fit_wheels(result.poses, log.odom_poses)
    numbers["turn_outliers"] = wheels.outliers
    return numbers, result.poses, walls


def life_of(counterpart: Counterpart, variant: str, asked: Numbers) -> Life:
    """What goes wrong in a variant, with what is asked for in place of the typical numbers."""
    path = counterparts.path_of(counterpart.poses)
    if variant in ("ideal", "scan time"):
        return life_in(counterpart.world, path, max_people=MAX_PEOPLE)
    own = {name: value for name, value in asked.items() if name != "people_per_metre"}
    ranges = life_defaults.RANGES._replace(**own)
    density = asked.get("people_per_metre", life_defaults.PEOPLE_PER_METRE)
    return typical_life(
        counterpart.world, path, people_per_metre=density, ranges=ranges, max_people=MAX_PEOPLE
    )


def simulate(key: jax.Array, counterpart: Counterpart, variant: str, asked: Numbers) -> Numbers:
    """Measures of a simulated drive of the counterpart."""
    robot = counterpart.robot
    if variant == "ideal" and robot.scanner is not None:
        scanner = robot.scanner._replace(turn_time=None, num_turns=1)
        robot = robot._replace(scanner=scanner)
    log = counterparts.simulate(
        key, counterpart._replace(robot=robot), life_of(counterpart, variant, asked)
    )
    numbers, poses, _ = measure(log)
    stamps = np.flatnonzero(np.isfinite(poses).all(axis=1))
    error = trajectory.ate(stamps, poses[stamps], stamps, counterpart.poses[stamps])["ate_rmse_m"]
    return numbers | {"ate_rmse_m": float(error)}


class Recorded:
    """A log and its counterpart, which is made when it is first needed."""

    def __init__(self, log: Log, cache: common.ResultCache):
        """The log; what was computed before is in the cache."""
        self.log, self._cache = log, cache
        self._counterpart: Counterpart | None = None

    def _map(self) -> Numbers:
        numbers, poses, walls = measure(self.log.laser_log)
        if not np.isfinite(poses).all():
            raise InputError("its scans are not all in one map", field=self.log.name)
        self._counterpart = counterparts.counterpart_of(
            self.log.name, self.log.laser_log, poses, walls
        )
        found = log_errors.errors_against(
            self.log.laser_log, poses, self.log.reference, self.log.relations
        )
        numbers["ate_rmse_m"] = found.get("ate_rmse_m")
        pairs = found.get("relations", {})
        return numbers | {"relations_translation_m": pairs.get("translation_mean_m")}

    def measures(self) -> Numbers:
        """Measures of the log."""
        return self._cache(f"{self.log.name} recorded", self._map)

    def counterpart(self) -> Counterpart:
        """The counterpart."""
        if self._counterpart is None:
            self._map()
        assert self._counterpart is not None
        return self._counterpart

    def simulated(self, seed: int, variant: str, asked: Numbers) -> Numbers:
        """Measures of the counterpart."""
        key = jax.random.key(seed)
        return self._cache(
            f"{self.log.name} {variant}",
            lambda: simulate(key, self.counterpart(), variant, asked),
        )


def asked_for(recorded: Numbers, base: Numbers, typical: Numbers) -> Numbers:
    """The numbers of life with which the counterpart would measure as the log, at least 0.

    Args:
        recorded: Measures of the log.
        base: Of the counterpart with the time of its scans.
        typical: Of the counterpart with typical life.
    """
    used = {
        "people_per_metre": life_defaults.PEOPLE_PER_METRE,
        "black": life_defaults.RANGES.black,
        "shared_std": life_defaults.RANGES.shared_std,
    }
    found: Numbers = {}
    for name, (measure, power) in ASKED.items():
        low, high, wanted = (x[measure] ** power for x in (base, typical, recorded))
        share = max((wanted - low) / (high - low), 0.0) if high > low else 1.0
        found[name] = used[name] * share ** (1 / power)
    return found


def ratios(simulated: Numbers, recorded: Numbers) -> Numbers:
    """Measures by those of the log; None where either is missing, or the log's is 0."""
    return {
        name: simulated[name] / recorded[name] if recorded[name] and simulated.get(name) else None
        for name in recorded
        if name in simulated
    }


def compute(logs: list[Log], seed: int, left_out: bool, cache: common.ResultCache) -> Numbers:
    """Measures of all logs and of their counterparts, ratios, and what each log asks for."""
    rows, asked = [], {}
    recordings = {log.name: Recorded(log, cache) for log in logs}
    for name, own in recordings.items():
        measures = own.measures()
        rows.append({"log": name, "variant": "recorded", "measures": measures})
        found = {}
        for variant in VARIANTS:
            found[variant] = own.simulated(seed, variant, {})
            row = {"log": name, "variant": variant, "measures": found[variant]}
            rows.append(row | {"ratios": ratios(found[variant], measures)})
            print(line(rows[-1]), flush=True)
        asked[name] = asked_for(measures, found["scan time"], found["typical"])
    others = {}
    for name in recordings if left_out and len(recordings) > 1 else ():
        rest = [values for other, values in asked.items() if other != name]
        others[name] = {key: float(np.median([x[key] for x in rest])) for key in ASKED}
        measures = recordings[name].measures()
        found = recordings[name].simulated(seed, LEFT_OUT, others[name])
        row = {"log": name, "variant": LEFT_OUT, "measures": found}
        rows.append(row | {"ratios": ratios(found, measures)})
        print(line(rows[-1]), flush=True)
    return {"rows": rows, "asked_for": asked, "by_the_others": others}


def line(row: Numbers) -> str:
    """A row as text: the targets, simulated by recorded."""
    text = "  ".join(f"{name} {row['ratios'][name]:.2f}" for name in TARGETS)
    return f"{row['log']:14} {row['variant']:10} {text}"


def draw(numbers: Numbers, path: Path) -> None:
    """All ratios by measure, a panel for each log, and the tolerance."""
    names = list(dict.fromkeys(row["log"] for row in numbers["rows"]))
    figure, axes = common.canvas(5 * len(names), 8, 1, len(names))
    styles = {
        "ideal": (common.RED, "x"),
        "scan time": (common.ORANGE, "+"),
        "typical": (common.BLUE, "o"),
        LEFT_OUT: (common.GREEN, "^"),
    }
    for axis, log in zip(axes[0], names, strict=True):
        own = [row for row in numbers["rows"] if row["log"] == log and "ratios" in row]
        measures = list(dict.fromkeys(name for row in own for name in row["ratios"]))
        axis.axvspan(1 - TOLERANCE, 1 + TOLERANCE, color="0.9")
        axis.axvline(1.0, color=common.BLACK, linewidth=0.8)
        for row in own:
            colour, marker = styles[row["variant"]]
            values = [row["ratios"].get(name) for name in measures]
            values = [np.nan if x is None else min(max(x, 0.05), 20.0) for x in values]
            axis.plot(values, measures, marker, color=colour, label=row["variant"])
        for label in axis.get_yticklabels():
            label.set_fontweight("bold" if label.get_text() in TARGETS else "normal")
        common.log_scale(axis, "x")
        axis.set(title=log, xlabel="simulated by recorded", xlim=(0.04, 25.0))
        axis.invert_yaxis()
    axes[0, 0].legend(fontsize="small")
    figure.savefig(path)


def chosen(folder: str) -> list[Log]:
    """The four logs of a folder, those of fewest scans of each name.

    Raises:
        InputError: There is no such folder, or none of the logs.
    """
    found = log_folder.find_logs(log_folder.checked_folder(folder), installed=False)
    logs = [log for log in real_logs.select(found) if log.name in LOGS]
    if not logs:
        raise InputError(
            f"none of the logs {', '.join(LOGS)}", advice="give --data FOLDER with one of them"
        )
    return sorted(logs, key=lambda log: LOGS.index(log.name))


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    args = common.parse(__doc__, argv, data="", left_out=1)
    enable_caches()
    cache = common.ResultCache(args.out / f"{NAME}_parts", {"data": args.data, "seed": args.seed})
    numbers = compute(chosen(args.data), args.seed, bool(args.left_out), cache)
    common.save(args.out, NAME, {"seed": args.seed} | numbers, draw)
    cache.clear()
    return 0


if __name__ == "__main__":
    sys.exit(main())
