"""Picture of `experiments.tuning`: errors over time, and what each method finds at last."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments import common, parameter_recovery

DATA = {"office": "office", "mrclam": "MRCLAM"}
STYLES = {
    "hand": (common.BLACK, ":"),
    "gradient": (common.GREEN, "-"),
    "likelihood": (common.PINK, "-."),
    "random": (common.ORANGE, "--"),
    "bayesian": (common.BLUE, "--"),
}
ADAPTED = ("hand", "hand, adapting", "gradient", "gradient, adapting")
OWN = ("jaxslam", "gradient")  # what this library finds is green


def draw(numbers: common.Numbers, path: Path) -> None:
    """Errors over time and evaluations; models, calibration, adaptation; parameter recovery."""
    shown = list(numbers["traces"])
    models, calibrated = numbers["models"], numbers["calibration"]
    count = len(shown) + 3
    figure, axes = common.canvas(12, 4.2 * len(shown) + 10.5, count, 2)
    axes[0, 0].get_gridspec().set_height_ratios([4] * len(shown) + [3, 3, 4.5])
    for (left, right), data in zip(axes, shown, strict=False):
        _draw_traces(left, numbers, data, "seconds")
        _draw_traces(right, numbers, data, "evaluations")
    for axis, (name, rows) in zip(axes[-3], models.items(), strict=True):
        found = [row for row in rows if row["method"] != "truth"]
        _draw_found(axis, found, "error")
        axis.set(xlabel="largest error of a logarithm", title=f"{name}: parameters found")
    _draw_found(axes[-2, 0], calibrated, "heldout_rmse_m", 100.0)
    axes[-2, 0].set(xlabel="held-out position RMSE [cm]", title="calibration of a robot")
    _draw_adapted(axes[-2, 1], numbers["rows"], shown)
    for axis in axes[-1]:
        axis.remove()
    wide = figure.add_subplot(axes[-1, 0].get_gridspec()[count - 1, :])
    parameter_recovery.draw(wide, numbers["recovery"])
    figure.savefig(path)


def _draw_traces(axis: Any, numbers: common.Numbers, data: str, over: str) -> None:
    traces = numbers["traces"][data]
    for method, trace in traces.items():
        colour, style = STYLES[method]
        points = trace["points"]
        x = [max(point[over], 1.0) for point in points] + [trace[over]]
        y = [100 * point["heldout_rmse_m"] for point in points]
        axis.step(x, y + y[-1:], style, where="post", color=colour, label=method)
        axis.plot(x[-1], y[-1], "o", color=colour, markersize=4)
    hand = 100 * traces["gradient"]["points"][0]["heldout_rmse_m"]
    axis.axhline(hand, color=common.BLACK, linestyle=":", label="hand")
    axis.set(xscale="log", ylabel="held-out position RMSE [cm]")
    common.log_scale(axis)
    what = "evaluations of all training drives, values and gradients alike"
    axis.set_xlabel("time [s]" if over == "seconds" else what)
    axis.set_title(DATA[data])
    axis.legend(fontsize="small")


def _draw_found(axis: Any, rows: list[common.Numbers], key: str, unit: float = 1.0) -> None:
    """A point for each method; beside it, NEES or loss, and seconds if there are any."""
    values = unit * np.array([row[key] for row in rows], float)  # NaN where nothing was finite
    low, high = np.nanmin(values) / 1.5, max(np.nanmax(values), 3 * np.nanmin(values))
    for place, (value, row) in enumerate(zip(values, rows, strict=True)):
        colour = common.GREEN if row["method"] in OWN else common.BLUE
        axis.plot([low, value], [place, place], color=colour, linewidth=0.8)
        axis.plot(value, place, "o", color=colour)
        text = f"   {value:.3g}"
        text += f"; NEES {row['nees']:.3g}" if row.get("nees") else ""
        text += f"; loss {row['loss']:.4f}" if "loss" in row else ""
        text += f"; {row['seconds']:.2g} s" if row["seconds"] else ""
        axis.text(value, place, text, va="center", fontsize="small")
    common.log_scale(axis, "x")
    axis.set(xlim=(low, high * (high / low) ** 1.2))  # what stands beside a point
    names = [row["method"].replace(", noise", ",\nnoise") for row in rows]
    axis.set_yticks(np.arange(len(rows)), names, fontsize="small")
    axis.set(ylim=(len(rows) - 0.5, -0.5))


def _draw_adapted(axis: Any, rows: list[common.Numbers], shown: list[str]) -> None:
    """Held-out NEES and errors without and with online adaptation."""
    found = {(row["data"], row["method"]): row for row in rows}
    place = np.arange(len(ADAPTED))
    markers = zip(shown, ("o", "s"), (common.GREEN, common.ORANGE), strict=False)
    for k, (data, marker, colour) in enumerate(markers):
        own = [found[data, method] for method in ADAPTED]
        nees = np.array([row["nees"] or np.nan for row in own])
        side = place + 0.2 * (k - 0.5 * (len(shown) - 1))
        axis.plot(side, nees, marker, color=colour, label=DATA[data])
        for x, y, row in zip(side, nees, own, strict=True):
            text = f" {100 * row['heldout_rmse_m']:.2g} cm"
            axis.text(x + 0.05, y, text, va="center", fontsize="small")
    axis.axhline(1.0, color=common.BLACK, linewidth=0.8)
    axis.set_xticks(place, [name.replace(", ", ",\n") for name in ADAPTED])
    axis.set(xlim=(-0.5, len(ADAPTED)), ylabel="held-out NEES per dof")
    axis.set_title("online adaptation of Q and R; beside the points: RMSE")
    common.log_scale(axis)
    axis.margins(y=0.2)
    axis.legend(fontsize="small")
