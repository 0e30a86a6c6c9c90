"""Shared by all experiments: arguments, the two files they write, and pictures of cells."""

import argparse
import json
import shutil
import sys
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxslam.core import trace_cache
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import Key
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract, voronoi
from jaxslam.frontend.automaton import Diagram
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.grid import GridSpec, centres
from jaxslam.io.errors import InputError
from jaxslam.io.output import plain, write_json
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import TrialResult
from jaxslam.simulation import drives, path_following, trials, worlds
from jaxslam.simulation.ray_casting import cast
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PINK = (
    *("#000000", "#E69F00", "#56B4E9", "#009E73"),
    *("#F0E442", "#0072B2", "#D55E00", "#CC79A7"),
)
"""The colours of Okabe and Ito, which colour-blind people can distinguish."""

EMPTY, BRANCH = ".", "*"
NAMES = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJ"  # of the labels, in the order of their bits

LABEL_KEYS = {"segments": "runs", "codes": "codes"}
"""How JSON files spell the modes of `FrontendConfig.labels`, as they always did."""

Numbers = dict[str, Any]
"""Results of an experiment: dicts, lists, numbers and strings."""

GRID = GridSpec(x_max=7.95, x_min=-0.25, y_half=8.05)
"""Grid whose cells have their centres on multiples of 0.1 m, where the worlds have their walls."""

Window = tuple[float, float, float, float]
"""Window of the base_link frame: x from, x to, y from, y to [m]."""


def parse(description: str | None, argv: list[str] | None = None, **extra: Any):
    """Arguments of an experiment: --out, --seed and a flag for each of `extra`.

    Args:
        description: Docstring of the experiment.
        argv: Arguments instead of those of the command line.
        extra: Name and default of further flags.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--out", type=Path, required=True, help="folder for the two files")
    parser.add_argument("--seed", type=int, default=0, help="of all that is random")
    for name, default in extra.items():
        parser.add_argument(f"--{name}", type=type(default), default=default)
    return parser.parse_args(argv)


Main = Callable[[list[str] | None], int]


def report_errors(name: str, *errors: type[Exception]) -> Callable[[Main], Main]:
    """Decorator of a `main` that returns its exit code: bad input is one line and exit code 2.

    Args:
        name: Of the experiment.
        errors: Errors that are printed likewise, beside InputError; Ctrl-C returns 130.
    """

    def decorate(main: Main) -> Main:
        @wraps(main)
        def run(argv: list[str] | None = None) -> int:
            try:
                return main(argv)
            except (InputError, *errors) as error:
                print(f"{name}: error: {error}", file=sys.stderr)
                return 2
            except KeyboardInterrupt:
                print(f"{name}: interrupted; the same command resumes", file=sys.stderr)
                return 130

        return run

    return decorate


class ResultCache:
    """Partial results of an experiment, kept as files until it is done, so that it can resume."""

    def __init__(self, folder: Path, about: Any):
        """Keep results in `folder`.

        Args:
            folder: Where the files are.
            about: What the results depend on; those of another program or `about` are computed
                again.
        """
        self._folder = folder
        self._about = f"{about!r}, {trace_cache.version()}"

    def __call__(self, name: str, make: Callable[[], Numbers]) -> Numbers:
        """The result of `make` as JSON holds it: computed now, or by an earlier call."""
        file = self._folder / f"{name.replace(' ', '_')}.json"
        if file.is_file():
            try:
                found = json.loads(file.read_text(encoding="utf-8"))
                if found["about"] == self._about:
                    return found["numbers"]
            except (ValueError, KeyError, TypeError):
                pass  # computed again
        numbers = plain(make())
        self._folder.mkdir(parents=True, exist_ok=True)
        write_json(file, {"about": self._about, "numbers": numbers})
        return numbers

    def clear(self) -> None:
        """Remove all files."""
        shutil.rmtree(self._folder, ignore_errors=True)


def save(out: Path, name: str, numbers: Numbers, draw: Callable[[Numbers, Path], None]) -> None:
    """Write `name`.json, and `name`.png as drawn from what stands in it."""
    numbers = plain(numbers)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / f"{name}.json", numbers)
    draw(numbers, out / f"{name}.png")
    print(f"wrote {out / name}.json and .png")


def canvas(width: float, height: float, rows: int, columns: int, widths: list[int] | None = None):
    """Figure of the given size [inch] and its axes (rows, columns), of relative `widths`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, width_ratios=widths)


def log_scale(axis, of: str = "y") -> None:
    """Make an axis, "x" or "y", logarithmic, with plain numbers at 1, 2, 5 times powers of ten."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set(**{f"{of}scale": "log"})
    ticks = getattr(axis, f"{of}axis")
    ticks.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ticks.set_major_formatter("{x:g}")
    ticks.set_minor_formatter(NullFormatter())


def scan_of(name: str, lidar: Lidar) -> Scan:
    """Noise-free scan of the world `name` from its origin."""
    walls = jnp.asarray(worlds.named(name).walls, float)
    return cast(lidar, World(walls), jnp.zeros(3))


@partial(jax.jit, static_argnums=0)
def _diagram(config: Config, scan: Scan) -> tuple[Diagram, jnp.ndarray]:
    """Diagram and source cells of a scan; its features are not even compiled."""
    return extract.extract_diagram(config.frontend, scan)[1:]


def local_diagram(name: str, labels: str) -> tuple[Diagram, np.ndarray]:
    """Diagram of the world `name` as seen from its origin, and its source cells (H, W)."""
    config = Config(frontend=FrontendConfig(labels=labels, grid=GRID))
    diagram, sources = _diagram(config, scan_of(name, config.frontend.lidar))
    return diagram, np.asarray(sources)


def cut(cells: np.ndarray, window: Window) -> np.ndarray:
    """Cells (H, W) whose centres lie in the window."""
    x, y = np.moveaxis(np.asarray(centres(GRID)), -1, 0)
    rows, columns = x[:, 0], y[0]
    rows = (window[0] < rows) & (rows < window[1])
    columns = (window[2] < columns) & (columns < window[3])
    return np.asarray(cells)[np.ix_(rows, columns)]


def text_of(labels: np.ndarray, branch: np.ndarray) -> list[str]:
    """A line of text for each row of cells: its label's name, `*` for a branch, `.` for none."""

    def letter(label: int, is_branch: bool) -> str:
        if is_branch:
            return BRANCH
        return NAMES[label.bit_length() - 1] if label else EMPTY

    return [
        "".join(letter(*cell) for cell in zip(*row, strict=True))
        for row in zip(labels.tolist(), branch.tolist(), strict=True)
    ]


def picture(diagram: Diagram, sources: np.ndarray, window: Window) -> Numbers:
    """Regions, branches and sources of a diagram as lines of text, x and y ascending."""
    labels, branch = np.asarray(diagram.labels), np.asarray(voronoi.branch_cells(diagram, sources))
    regions, none = np.where(sources, 0, labels), np.zeros_like(sources)
    seeds = np.where(sources, labels, 0)
    return {
        "window_m": window,
        "diagram": text_of(cut(regions, window), cut(branch, window)),
        "sources": text_of(cut(seeds, window), cut(none, window)),
    }


def colour(name: str, order: str) -> str:
    """Colour of a label, by its position among the labels of the picture."""
    return (SKY, ORANGE, GREEN, PINK, YELLOW, BLUE, RED)[order.index(name) % 7]


def draw_picture(axis, drawn: Numbers) -> None:
    """Draw what `picture` returns, as the robot sees it: x up, y to the left."""
    from matplotlib.colors import to_rgb

    lines, sources = drawn["diagram"], drawn["sources"]
    order = "".join(sorted(set("".join(lines + sources)) - {EMPTY, BRANCH}))
    image = np.ones((len(lines), len(lines[0]), 3))
    for i, j in np.ndindex(*image.shape[:2]):
        region, source = lines[i][j], sources[i][j]
        if source != EMPTY:
            image[i, j] = 0.75 * np.array(to_rgb(colour(source, order)))
        elif region == BRANCH:
            image[i, j] = to_rgb(BLACK)
        elif region != EMPTY:
            image[i, j] = 0.3 * np.array(to_rgb(colour(region, order))) + 0.7
    low, high, right, left = drawn["window_m"]
    axis.imshow(image, origin="lower", extent=(right, left, low, high), interpolation="none")
    axis.plot(0, 0, "^", color=RED, markersize=8, clip_on=False)
    axis.set(xlim=(left, right), ylim=(low, high), aspect="equal")
    axis.set(xlabel="y, to the left [m]", ylabel="x, ahead [m]")


def drive_in(name: str = "office") -> tuple[World, Robot, jnp.ndarray, int]:
    """World, robot, path (N, 2) and number of scans of the drive in a world."""
    robot, path = Robot(), jnp.asarray(path_following.densify(worlds.waypoints(name)), float)
    world = World(jnp.asarray(worlds.named(name).walls, float))
    return world, robot, path, drives.num_scans_of_drive(robot, path)


def take(records: Any, index: Any) -> Any:
    """Some items of records that lead with their number, as NumPy arrays."""
    return jax.tree.map(lambda x: np.asarray(x)[index], records)


def filter_trials(
    key: Key, config: Config, params: NoiseParams, num_trials: int, name: str = "office"
) -> TrialResult:
    """Simulate and filter B trials of the drive in a world, with a progress bar."""
    world, robot, path, num_scans = drive_in(name)
    parts = []
    with tqdm(total=num_trials, unit="trial", leave=False) as bar:
        for part in trials.run_trials(
            key, config, params, robot, world, path, num_trials=num_trials, num_scans=num_scans
        ):
            parts.append(part)
            bar.update(len(part.finite))
    return episodes.concatenate_results(parts)
