"""Shared by the commands: types and checks of options, timing."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Annotated, NamedTuple

import jax
import numpy as np
import tyro

from jaxslam.core.logs import LaserLog
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import noise_file, readers
from jaxslam.io.errors import InputError

MIN_BEAMS = 32  # of a scan, from which the front end works

OptionalFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
"""Option that names a file, or none."""

OptionalCount = Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")]
"""Option that is a whole number, or not given."""

OptionalTopic = Annotated[str | None, tyro.conf.arg(metavar="TOPIC", help_behavior_hint="")]
"""Option that names a topic of a bag, or none."""

OptionalFrame = Annotated[str | None, tyro.conf.arg(metavar="FRAME", help_behavior_hint="")]
"""Option that names a frame of a log, or none."""

Files = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
"""Option that names several files, or none."""

FileOfEach = Annotated[
    tyro.conf.UseAppendAction[tuple[Path, ...]],
    tyro.conf.arg(metavar="FILE", help_behavior_hint=""),
]
"""Option that names a file for each log, given once for each, or none."""

OutFolder = Annotated[Path, tyro.conf.arg(metavar="DIR")]
"""Option that names the folder of the results."""


class ScannerOptions(NamedTuple):
    """What the user says of the scanner and the frames of a log.

    Attributes:
        mount: Pose of the scanner on the robot [m m rad]; replaces the log's transforms.
        upside_down: The scanner is mounted upside down.
        scan_frame: Frame of the scans to read; by default the one with most scans.
        base_frame: Frame of the robot; by default that of the odometry.
        odom_frame: Frame of the odometry among the transforms of a bag; by default odom.
        angle_increment: Step between beams [deg]; by default that of the scans.
    """

    mount: Annotated[
        tuple[float, float, float] | None,
        tyro.conf.arg(metavar="X Y YAW", help_behavior_hint=""),
    ] = None
    upside_down: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    scan_frame: OptionalFrame = None
    base_frame: OptionalFrame = None
    odom_frame: OptionalFrame = None
    angle_increment: Annotated[
        float | None, tyro.conf.arg(metavar="DEG", help_behavior_hint="")
    ] = None

    def read_log(
        self, path: Path, *, scan_topic: str | None = None, odometry_topic: str | None = None
    ) -> LaserLog:
        """Read a log with these options; topics are those of a bag."""
        step = self.angle_increment
        return readers.read_log(
            path,
            scan_topic=scan_topic,
            odometry_topic=odometry_topic,
            mount=self.mount,
            upside_down=self.upside_down,
            scan_frame=self.scan_frame,
            base_frame=self.base_frame,
            odom_frame=self.odom_frame,
            angle_increment=None if step is None else float(np.radians(step)),
        )


Scanner = Annotated[ScannerOptions, tyro.conf.arg(name="")]
"""Options of the scanner, each under its own name."""


def require_odometry(path: Path, log: LaserLog) -> None:
    """Raise InputError if a log has no odometry, for what runs by odometry alone."""
    if not log.has_odometry:
        reason = next((note for note in log.notes if note.startswith("no odometry")), "no odometry")
        raise InputError(reason, path=path, advice="use --odometry scans-only")


def require_beams(path: Path, log: LaserLog) -> None:
    """Raise InputError if the scans of a log have too few beams to find walls in them."""
    if log.lidar.num_beams < MIN_BEAMS:
        problem = f"has {log.lidar.num_beams} beams a scan, of which {MIN_BEAMS} are needed"
        raise InputError(problem, path=path, advice="name a log of a laser scanner")


def check_range(option: str, value: float, low: float, high: float) -> None:
    """Raise InputError unless the value of an option is in [low, high]."""
    if not low <= value <= high:
        raise InputError(f"{value} is not between {low} and {high}", field=option)


def require_other_folder(out: Path, map_folder: Path) -> None:
    """Raise InputError if the output folder is that of the map that a command reads, or its file.

    Results would replace those of the map.
    """
    if map_folder.is_file():
        map_folder = map_folder.parent
    if out.exists() and map_folder.exists() and out.samefile(map_folder):
        problem = f"{out} is the folder of the map, whose results would be replaced"
        raise InputError(problem, field="--out", advice="name another folder")


@contextmanager
def name_errors(what: str) -> Iterator[None]:
    """Turn a ValueError of the block into an InputError that names the option or file."""
    try:
        yield
    except ValueError as error:
        raise InputError(str(error), field=what) from None


def read_params(path: Path | None, default: NoiseParams) -> NoiseParams:
    """Noise parameters (Q and R) of a file; the default if there is no path."""
    return default if path is None else noise_file.read(path, default)


@contextmanager
def stopwatch() -> Iterator[dict[str, float]]:
    """Measure the block: seconds in XLA's compiler (`compile`) and the rest (`run`)."""
    seconds = {"compile": 0.0, "run": 0.0}
    spans: list[tuple[float, float]] = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if running and event == "/jax/core/compile/backend_compile_duration":
            now = perf_counter()
            spans.append((now - duration_secs, now))

    jax.monitoring.register_event_duration_secs_listener(listen)
    start, running = perf_counter(), True
    yield seconds
    running = False
    seconds["compile"] = _covered(spans)
    seconds["run"] = perf_counter() - start - seconds["compile"]


def _covered(spans: Iterable[tuple[float, float]]) -> float:
    """Length of the union of intervals (start, stop): programs are compiled in parallel."""
    total, covered_until = 0.0, -np.inf
    for start, stop in sorted(spans):
        total += max(0.0, stop - max(start, covered_until))
        covered_until = max(covered_until, stop)
    return total
