"""Three scanners in three buildings, with 0, 5 and 20 people: how often SLAM succeeds.

The buildings are Willow Garage (`willow-full.yaml` in the folder --maps), the Intel lab as mapped
(--intel: the `map.yaml` that `jaxslam run` has written for the Intel log), and a random building.
The robot drives the first --metres of a patrol through all rooms; a trial succeeds if its position
is never more than --success metres off. Trial i of all variants has the same random numbers. The
same command resumes where it was stopped: finished trials are kept in the folder --out.
"""

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments import common
from jaxslam.core import polylines
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.io import world_files
from jaxslam.io.errors import InputError
from jaxslam.pipeline.config import Config
from jaxslam.simulation import drives, kinematics, named_worlds, scanner_presets
from jaxslam.simulation.life import life_in
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World
from jaxslam.study import reporting
from jaxslam.study.kept_trials import Collected
from jaxslam.study.progress import run_shown
from jaxslam.study.runner import Variant
from jaxslam.study.wording import findings

NAME = "study"
SCANNERS = ("LDS-01", "RPLidar A1", "UTM-30LX")
BUILDINGS = ("Willow Garage", "Intel", "random:7")
PEOPLE = (0, 5, 20)
SCAN_PERIOD = 0.5  # [s] of all scanners: the faster ones skip scans
COLOURS = (common.BLUE, common.ORANGE, common.RED)


def building_of(name: str, maps: Path | None, intel: Path | None) -> tuple[World, np.ndarray]:
    """World of a building, and the path (N, 2) [m] of a patrol through it.

    Raises:
        InputError: Its file is not given, or cannot be read.
    """
    if name.startswith("random:"):
        world, occupancy = named_worlds.named(name), None
    else:
        file = intel
        if name == BUILDINGS[0]:
            file = None if maps is None else maps / "willow-full.yaml"
        if file is None:
            flag = "--maps" if name == BUILDINGS[0] else "--intel"
            raise InputError("is missing", field=flag, advice=f"it has the map of {name}")
        read = world_files.read_world(file)
        world, occupancy = read.world, read.occupancy
    found = named_worlds.found_drive(world, "patrol", occupancy)
    return world, np.asarray(found.path, float)


def first_part(path: np.ndarray, metres: float) -> np.ndarray:
    """The first `metres` of a path (N, 2)."""
    along = polylines.cumulative_lengths(path)
    return path[: max(int(np.searchsorted(along, metres)), 8)]


def variants_of(maps: Path | None, intel: Path | None, metres: float) -> list[Variant]:
    """The 27 variants; those of a scanner and building run the same program."""
    found = []
    for name in BUILDINGS:
        world, path = building_of(name, maps, intel)
        path = first_part(path, metres)
        living = life_in(world, path, max_people=max(PEOPLE))
        for scanner_name in SCANNERS:
            scanner = scanner_presets.preset(scanner_name)
            robot = Robot(scanner=scanner, scan_period=SCAN_PERIOD)
            fixed = Config.for_lidar(scanner.lidar()), kinematics.noise_params(robot, world), robot
            scans = drives.num_scans_of_drive(robot, path)
            for people in PEOPLE:
                life = living._replace(
                    traffic=living.traffic._replace(people=jnp.array(people, float))
                )
                settings = {"building": name, "scanner": scanner_name, "people": people}
                title = f"{name}, {scanner_name}, {people} people"
                found.append(Variant(title, settings, *fixed, world, path, scans, life))
    return found


def compute(
    variants: list[Variant], num_trials: int, seed: int, success: float, folder: Path | None
) -> common.Numbers:
    """The numbers of the study, with what its figure needs."""
    found = run_shown(variants, num_trials=num_trials, seed=seed, folder=folder)
    return numbers_of(variants, found, seed, success)


def numbers_of(
    variants: list[Variant], found: list[Collected], seed: int, success: float
) -> common.Numbers:
    """The report, its findings, and walls and path of each building."""
    numbers = reporting.report(variants, found, seed=seed, success_distance=success)
    worlds = {
        one.settings["building"]: {"walls": np.asarray(one.world.walls), "path": one.path[::10]}
        for one in variants
    }
    return numbers | {"findings": findings(numbers), "worlds": worlds}


def draw(numbers: common.Numbers, path: Path) -> None:
    """Success and errors by scanner and people, and where trials fail, a column a building."""
    figure, axes = common.canvas(13, 11, 3, 3)
    for column, building in enumerate(BUILDINGS):
        rows = [one for one in numbers["variants"] if one["settings"]["building"] == building]
        _draw_shares(axes[0, column], rows)
        _draw_errors(axes[1, column], rows)
        _draw_map(axes[2, column], rows, numbers["worlds"][building])
        axes[0, column].set_title(building)
    axes[0, 0].set_ylabel(f"trials never {numbers['success_m']:g} m off, with 95 % intervals")
    axes[1, 0].set_ylabel("position RMSE of a trial [m]: median and 90 %")
    axes[0, 0].legend(title="people", fontsize=8)
    figure.savefig(path)


def _by_people(rows: list, axis: Any) -> Iterator[tuple[int, list, np.ndarray, str]]:
    """Rows of each number of people in the order of the scanners, where to draw them, colour."""
    for k, people in enumerate(PEOPLE):
        own = [one for one in rows if one["settings"]["people"] == people]
        own.sort(key=lambda one: SCANNERS.index(one["settings"]["scanner"]))
        yield people, own, np.arange(len(own)) + 0.22 * (k - 1), COLOURS[k]
    axis.set_xticks(range(3), SCANNERS)
    axis.grid(axis="y", alpha=0.3)


def _draw_shares(axis: Any, rows: list) -> None:
    for people, own, x, colour in _by_people(rows, axis):
        value, low, high = (
            np.array([one["success"][key] for one in own]) for key in ("value", "low", "high")
        )
        spread = np.maximum([value - low, high - value], 0.0)
        axis.errorbar(x, value, yerr=spread, fmt="o", color=colour, capsize=3, label=f"{people}")
    axis.set_ylim(-0.03, 1.03)


def _draw_errors(axis: Any, rows: list) -> None:
    for _, own, x, colour in _by_people(rows, axis):
        for key, marker in (("p50", "o"), ("p90", "^")):
            value = [one["position_rmse_m"][key]["value"] for one in own]
            axis.plot(x, [np.nan if v is None else v for v in value], marker, color=colour)
    common.log_scale(axis)


def _draw_map(axis: Any, rows: list, world: common.Numbers) -> None:
    """Walls, drive, and where trials of all variants begin to fail."""
    from matplotlib.collections import LineCollection

    segments = np.reshape(np.array(world["walls"]), (-1, 2, 2))
    axis.add_collection(LineCollection([*segments], colors="#999999", linewidths=0.6))
    axis.plot(*np.array(world["path"]).T, color=common.GREEN, linewidth=1)
    total: dict[tuple[float, float], int] = {}
    for one in rows:
        places = one["places"]
        x, y = (o + 0.5 * places["cell_m"] for o in places["origin_m"])
        for i, line in enumerate(places["failures"]):
            for j, count in enumerate(line):
                if count:
                    at = round(x + i * places["cell_m"], 3), round(y + j * places["cell_m"], 3)
                    total[at] = total.get(at, 0) + count
    if total:
        size = 300.0 * np.array([*total.values()]) / sum(total.values())
        axis.scatter(*np.array([*total]).T, s=6 + size, color=common.RED, alpha=0.7, zorder=3)
    low, high = np.array(world["path"]).min(axis=0) - 4, np.array(world["path"]).max(axis=0) + 4
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axis.set(xlabel="x [m]", ylabel="y [m]")
    axis.set_title(f"{sum(total.values())} failures of all variants (red)", fontsize=9)


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    args = common.parse(__doc__, argv, maps="", intel="", runs=40, metres=20.0, success=0.25)
    if args.runs < 1:
        raise InputError("is not positive", field="--runs")
    use_cpu_devices()
    enable_caches()
    maps, intel = (Path(x) if x else None for x in (args.maps, args.intel))
    variants = variants_of(maps, intel, args.metres)
    folder = args.out / f"{NAME}_trials"
    numbers = compute(variants, args.runs, args.seed, args.success, folder)
    common.save(args.out, NAME, numbers, draw)
    shutil.rmtree(folder, ignore_errors=True)
    for text in numbers["findings"]:
        print(f"- {text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
