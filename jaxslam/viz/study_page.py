"""Pictures of a study: success, errors and times of its variants, cost, and where trials fail."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, StrMethodFormatter

from jaxslam.core.types import AnyArray, Metrics
from jaxslam.viz.canvas import BLACK, BLUE, GREEN, GREY, ORANGE, PINK, RED, SKY

COLOURS = (BLUE, ORANGE, GREEN, PINK, SKY, RED, BLACK, GREY)
MAX_SHOWN = 40  # variants with a line of their own
MAX_LETTERS = 44  # of a name
SURROUNDINGS = 6  # squares around the drive that are shown


class StudyPage(NamedTuple):
    """What a page shows.

    Attributes:
        rows: (V,) of the variants, as `study.report` makes them.
        walls: (V,) of each the walls (S, 4) [m].
        mapped: Number of the variant whose failures are mapped.
        seconds: [s] that the longest trial lasts.
    """

    rows: Sequence[Metrics]
    walls: Sequence[AnyArray]
    mapped: int
    seconds: float


def study_page(page: StudyPage) -> Figure:
    """Draw the page of a study; of more than `MAX_SHOWN` variants the first ones."""
    shown = min(len(page.rows), MAX_SHOWN)
    rows = 1.6 + 0.24 * shown
    figure = Figure(figsize=(11, rows + 5.6), dpi=100, layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[rows, 5.0])
    success, errors = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
    names = [_short(row["name"]) for row in page.rows[:shown]]
    summaries = page.rows[:shown]
    _draw_success(success, names, summaries)
    _draw_quantiles(errors, summaries)
    _draw_survival(figure.add_subplot(grid[1, 0]), names, summaries, page.seconds)
    _draw_places(figure.add_subplot(grid[1, 1]), page, page.mapped)
    if shown < len(page.rows):
        figure.suptitle(f"the first {shown} of {len(page.rows)} variants", fontsize=9)
    return figure


def cost_picture(rows: Sequence[Metrics]) -> Figure | None:
    """Success of variants against their costs, joined where no other does better for less.

    None where costs are not known.
    """
    if not all("cost" in row for row in rows):
        return None
    figure = Figure(figsize=(8, 4.6), dpi=100, layout="constrained")
    axis = figure.subplots()
    cost = np.array([row["cost"] for row in rows], float)
    found = [row["success"] for row in rows]
    value, low, high = (np.array([one[key] for one in found]) for key in ("value", "low", "high"))
    spread = np.maximum([value - low, high - value], 0.0)
    axis.errorbar(cost, value, yerr=spread, fmt="o", color=BLUE, ecolor=GREY, capsize=2)
    front = pareto_front(cost, value)
    axis.step(cost[front], value[front], where="post", color=ORANGE, linewidth=1.2)
    for number in front:
        offset = (5, -11) if value[number] > 0.9 else (5, 5)
        axis.annotate(
            _short(rows[number]["name"]),
            (cost[number], value[number]),
            textcoords="offset points",
            xytext=offset,
            fontsize=8,
        )
    axis.set(xlabel="cost", ylabel="trials that succeed, with 95 % intervals", ylim=(-0.03, 1.05))
    axis.margins(x=0.15)
    axis.grid(alpha=0.3)
    return figure


def pareto_front(cost: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Numbers of those (K,) that no other beats for as little cost, cheapest first."""
    order = np.lexsort([-value, cost])
    best = np.maximum.accumulate(np.concatenate([[-np.inf], value[order]]))[:-1]
    return np.asarray(order[value[order] > best])


def maps_picture(page: StudyPage, numbers: Sequence[int]) -> Figure:
    """Where trials of some variants fail, each on a map of its own."""
    columns = min(3, len(numbers))
    lines = -(-len(numbers) // columns)
    figure = Figure(figsize=(4.4 * columns, 3.8 * lines), dpi=100, layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    tops = [_top(page.rows[number]) for number in numbers]
    for axis, number in zip(axes, numbers, strict=False):
        _draw_places(axis, page, number, max(tops))
    for axis in axes[len(numbers) :]:
        axis.set_axis_off()
    return figure


def _short(name: str) -> str:
    return name if len(name) <= MAX_LETTERS else name[: MAX_LETTERS - 1] + "\N{HORIZONTAL ELLIPSIS}"


def _draw_success(axis: Axes, names: Sequence[str], summaries: Sequence[Metrics]) -> None:
    """Shares of trials that succeed, with their intervals."""
    rows = np.arange(len(names))
    found = [one["success"] for one in summaries]
    value, low, high = (
        np.array([one[key] for one in found], float) for key in ("value", "low", "high")
    )
    spread = np.maximum([value - low, high - value], 0.0)
    axis.errorbar(value, rows, xerr=spread, fmt="o", color=BLUE, ecolor=GREY, capsize=2)
    axis.set(xlim=(-0.03, 1.03), xlabel="trials that succeed, with 95 % intervals")
    axis.set_yticks(rows, names, fontsize=7)
    axis.invert_yaxis()
    axis.grid(axis="x", alpha=0.3)


def _draw_quantiles(axis: Axes, summaries: Sequence[Metrics]) -> None:
    """Median and upper quantiles of the position RMSE of trials."""
    rows = np.arange(len(summaries))
    for key, colour, marker in (("p50", BLUE, "o"), ("p90", ORANGE, "s"), ("p99", RED, "^")):
        found = [one["position_rmse_m"][key] for one in summaries]
        value, low, high = (_numbers(found, k) for k in ("value", "low", "high"))
        axis.plot(value, rows, marker, color=colour, label=key, markersize=4.5)
        axis.hlines(rows, low, high, color=colour, alpha=0.4)
    axis.set(xlabel="position RMSE of a trial [m]: quantiles, with 95 % intervals")
    axis.set_yticks(rows, [])
    axis.invert_yaxis()
    if any(one["position_rmse_m"]["p50"]["value"] for one in summaries):
        axis.set_xscale("log")
        axis.xaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.xaxis.set_minor_formatter(StrMethodFormatter("{x:g}"))
    axis.grid(axis="x", alpha=0.3)
    axis.legend(fontsize=8)


def _numbers(found: Sequence[Any], key: str) -> np.ndarray:
    return np.array([np.nan if one[key] is None else one[key] for one in found], float)


def _draw_survival(
    axis: Axes, names: Sequence[str], summaries: Sequence[Metrics], seconds: float
) -> None:
    """Share of trials that have not failed by a time; those that fail most have a colour."""
    last = [([1.0] + one["time_to_failure_s"]["share_without_failure"])[-1] for one in summaries]
    worst = [k for k in np.argsort(last, kind="stable").tolist() if last[k] < 1.0][: len(COLOURS)]
    for number, (name, one) in enumerate(zip(names, summaries, strict=True)):
        found = one["time_to_failure_s"]
        times = np.concatenate([[0.0], found["times"], [seconds]])
        share = np.concatenate([[1.0], found["share_without_failure"]])
        share = np.append(share, share[-1])
        shown = number in worst
        colour = COLOURS[worst.index(number)] if shown else GREY
        order, label = (3, name) if shown else (1, None)
        axis.step(
            *(times, share), where="post", color=colour, label=label, linewidth=1.2, zorder=order
        )
    axis.set(ylim=(-0.03, 1.03), xlabel="time [s]", ylabel="trials that have not failed yet")
    axis.grid(alpha=0.3)
    if worst:
        axis.legend(fontsize=7, loc="lower left")


def _top(row: Metrics) -> float:
    """An error [m] that is exceeded in few places, so that these do not hide the rest."""
    found = [x for line in row["places"]["rmse_m"] for x in line if x is not None]
    return float(np.quantile(found, 0.98)) if found else 0.0


def _draw_places(axis: Axes, page: StudyPage, number: int, top: float | None = None) -> None:
    """Errors by place, up to `top` [m], and where trials fail, of one variant."""
    row = page.rows[number]
    places = row["places"]
    rmse = np.array([[np.nan if x is None else x for x in line] for line in places["rmse_m"]])
    failures = np.array(places["failures"])
    x, y = places["origin_m"]
    side = places["cell_m"]
    extent = (x, x + side * rmse.shape[0], y, y + side * rmse.shape[1])
    if np.isfinite(rmse).any():
        most = (_top(row) if top is None else top) or 1.0
        image = axis.imshow(
            rmse.T, origin="lower", extent=extent, cmap="viridis", vmin=0.0, vmax=most
        )
        axis.figure.colorbar(image, ax=axis, label="RMSE there [m]", shrink=0.8)
    segments = np.reshape(np.asarray(page.walls[number], float), (-1, 2, 2))
    axis.add_collection(LineCollection([*segments], colors=GREY, linewidths=0.7))
    i, j = np.nonzero(failures)
    if len(i):
        centre = x + side * (i + 0.5), y + side * (j + 0.5)
        size = 3 + 160 * failures[i, j] / failures.sum()
        axis.scatter(*centre, s=size, color=RED, alpha=0.9, label="trials fail here")
        axis.legend(fontsize=8)
    margin = side * SURROUNDINGS
    low, high = np.array(extent[::2]) - margin, np.array(extent[1::2]) + margin
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axis.set(xlabel="x [m]", ylabel="y [m]")
    axis.set_title(_short(row["name"]), fontsize=9)
