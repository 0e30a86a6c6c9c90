"""The picture of `experiments.monte_carlo`."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments import common, scaling

SHOWN = (50, 95, 99)  # percentiles
WORDS = {"runs": "trials", "steps": "scans", "landmarks": "landmarks"}
EXAGGERATION = 30.0  # of the drawn error of the worst trial, unless it has diverged


def draw(numbers: common.Numbers, path: Path) -> None:
    """Distribution of the errors, errors over the scans, the worst trial, time and memory."""
    figure, axes = common.canvas(12, 11, 3, 2)
    _draw_distribution(axes[0, 0], numbers)
    _draw_worst(axes[0, 1], numbers)
    _draw_trajectory(axes[1, 0], numbers)
    _draw_devices(axes[1, 1], numbers["scaling"])
    for axis, key, label in zip(
        axes[2], ("ms_per_scan", "peak_mb"), ("ms per scan", "peak memory [MB]"), strict=True
    ):
        _draw_scaling(axis, numbers["scaling"], key, label)
    figure.savefig(path)


def _draw_distribution(axis: Any, numbers: common.Numbers) -> None:
    if not numbers["worst"]:
        return
    edges = np.array(numbers["histogram"]["edges_m"])
    axis.stairs(numbers["histogram"]["runs"], edges, fill=True, color=common.SKY)
    for k, style in zip(SHOWN, ("-", "--", ":"), strict=True):
        value = numbers[f"p{k}_m"]
        label = f"{k} % below {100 * value:.2f} cm"
        axis.axvline(value, color=common.BLACK, linestyle=style, label=label)
    axis.set(xscale="log", xlabel="position RMSE of a trial [m]", ylabel="trials")
    title = f"{numbers['runs']} trials, {numbers['diverged']} diverged"
    axis.set_title(f"{title}, {numbers['nonfinite']} not finite")
    axis.legend()


def _draw_worst(axis: Any, numbers: common.Numbers) -> None:
    if not numbers["worst"]:
        return
    for k, style in zip(SHOWN, ("-", "--", ":"), strict=True):
        shown = numbers["per_scan"][f"p{k}_m"]
        axis.plot(shown, color=common.BLACK, linestyle=style, label=f"{k} % of trials below")
    colours = (common.RED, common.ORANGE, common.GREEN, common.BLUE, common.PINK)
    for one, colour in zip(numbers["worst"], colours, strict=False):
        axis.plot(one["error_m"], color=colour, linewidth=0.8, label=f"trial {one['run']}")
    axis.set(xlabel="scan", ylabel="position error [m]", yscale="log", ylim=(1e-4, None))
    axis.set_title("the worst trials")
    axis.legend(ncols=2, fontsize="small")


def _draw_trajectory(axis: Any, numbers: common.Numbers) -> None:
    for x1, y1, x2, y2 in numbers["walls"]:
        axis.plot([x1, x2], [y1, y2], color=common.BLACK, linewidth=1)
    for one in numbers["worst"][:1]:
        truth, estimate = np.array(one["truth"]), np.array(one["estimate"])
        larger = EXAGGERATION if max(one["error_m"]) < 1.0 / EXAGGERATION else 1.0
        shown = truth + larger * (estimate - truth)
        axis.plot(*truth.T, color=common.GREEN, linestyle="--", label="true path")
        label = "estimate" if larger == 1.0 else f"estimate, error {larger:.0f} times as large"
        axis.plot(*shown.T, color=common.RED, linewidth=1, label=label)
        axis.set_title(f"the worst trial, {one['run']}")
        axis.legend()
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")


def _draw_devices(axis: Any, measured: common.Numbers) -> None:
    rows = measured["devices"]["rows"] if measured else []
    if not rows:
        return
    names = [f"{row['devices']} device{'s' * (row['devices'] > 1)}" for row in rows]
    bars = axis.bar(names, [1e3 / row["ms_per_scan"] for row in rows], color=common.SKY)
    axis.bar_label(bars, fmt="%.0f")
    axis.margins(y=0.15)
    axis.set(ylabel="scans per second")
    axis.set_title(f"two devices: {measured['devices']['two_vs_one']:.2f} times as fast")


def _draw_scaling(axis: Any, measured: common.Numbers, key: str, label: str) -> None:
    styles = zip((common.BLUE, common.RED, common.GREEN), ("o-", "s--", "^:"), strict=True)
    for name, (colour, style) in zip(scaling.VARIED, styles, strict=True):
        rows = [row for row in measured.get(name, []) if key in row]
        found = [row[name] for row in rows], [row[key] for row in rows]
        axis.plot(*found, style, color=colour, label=f"number of {WORDS[name]}")
    highest = max((y for line in axis.lines for y in line.get_ydata()), default=1.0)
    axis.set(xscale="log", ylabel=label, ylim=(0, 1.4 * highest))
    others = f"{scaling.RUNS} trials, {scaling.STEPS} scans, {scaling.LANDMARKS} landmarks"
    axis.set_xlabel(f"one of them varied, else {others}")
    axis.legend()
