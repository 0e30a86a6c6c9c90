"""The picture of `place_recognition`, drawn from its JSON file."""

import math
from pathlib import Path

from experiments import common
from experiments.common import Numbers
from experiments.place_curves import METHODS, curve

FACTORS = {
    "range_std": "range noise [m]",
    "offset": "offset of the viewpoint [m]",
    "heading": "heading to the drive [deg]",
    "missing": "share of beams missing",
    "people": "people within 3 m",
}
COLOURS = (common.BLUE, common.RED, common.GREEN, common.ORANGE, common.PINK, common.SKY)
STYLES = dict(zip(METHODS, ("-", "--", ":"), strict=True))


def draw(numbers: Numbers, path: Path) -> None:
    """Precision and recall on logs, time of a query, and the factors of the floor plans."""
    figure, axes = common.canvas(15.0, 7.0, 2, 4)
    _draw_logs(axes[0], numbers["logs"])
    for axis, (factor, label) in zip(axes.ravel()[3:], FACTORS.items(), strict=True):
        _draw_factor(axis, numbers["floor_plans"]["summary"], factor, label)
    figure.savefig(path)


def _draw_logs(axes, logs: Numbers) -> None:
    for k, (name, log) in enumerate(logs.items()):
        colour = COLOURS[k % len(COLOURS)]
        for axis, (protocol, rows) in zip(axes, log["rows"].items(), strict=False):
            for method, style in STYLES.items():
                points = curve(rows, method)[4:]  # a precision of fewer says nothing
                axis.plot(*zip(*points, strict=True), style, color=colour)
            axis.set(title=f"logs, {protocol}", xlabel="recall", ylabel="precision")
            axis.set(xlim=(0, 1.02), ylim=(0.5, 1.02))
        times = log["timing"]
        sizes = [row["keyframes"] for row in times]
        axes[1].plot([], [], color=colour, label=name)
        axes[2].plot(sizes, [row["query_ms"] for row in times], "o-", color=colour)
        axes[2].plot(sizes, [row["search_ms"] for row in times], "o--", color=colour)
        axes[2].plot(sizes, [row["pairs_ms"] for row in times], "o:", color=colour)
    for method, style in STYLES.items():
        axes[0].plot([], [], style, color=common.BLACK, label=METHODS[method])
        axes[2].plot([], [], style, color=common.BLACK, label=METHODS[method])
    axes[0].legend(edgecolor="none", framealpha=1.0, fontsize=8, loc="lower left")
    axes[2].set(title="time", xlabel="keyframes of the map", ylabel="a query, one core [ms]")
    common.log_scale(axes[2])
    axes[1].legend(edgecolor="none", framealpha=1.0, fontsize=8, loc="lower left")
    axes[2].legend(frameon=False, fontsize=8)
    axes[2].set(ylim=(0.5, 500))


def _draw_factor(axis, summary: list[Numbers], factor: str, label: str) -> None:
    rows = [row for row in summary if row["factor"] == factor]
    scale = 180 / math.pi if factor == "heading" else 1.0
    values = [scale * row["value"] for row in rows]
    known = [row for row in rows if row["precision"] is not None]
    at = [scale * row["value"] for row in known]
    precision = [row["precision"] for row in known]
    low = [max(row["precision"] - row["precision_low"], 0.0) for row in known]
    high = [max(row["precision_high"] - row["precision"], 0.0) for row in known]
    axis.errorbar(
        at, precision, [low, high], fmt="o-", color=common.BLUE, capsize=3, label="precision"
    )
    axis.plot(values, [row["recall"] for row in rows], "s-", color=common.RED, label="recall")
    axis.plot(
        values, [row["best_right"] for row in rows], "^:", color=common.BLACK, label="best is right"
    )
    axis.set(title="floor plans, look-alike rooms", xlabel=label, ylim=(0, 1.04))
    if factor == next(iter(FACTORS)):
        axis.legend(frameon=False, fontsize=8, loc="lower left")
