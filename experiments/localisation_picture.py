"""The picture of `localisation`, drawn from its JSON file."""

from pathlib import Path

import numpy as np

from experiments import common
from experiments.common import Numbers

COLOURS = {
    "own map": common.BLUE,
    "carried": common.RED,
    "second half": common.GREEN,
    "outside": common.BLACK,
}
STYLES = ("-", "--", ":")  # of the methods
LONGEST = 15.0  # [m]


def draw(numbers: Numbers, path: Path) -> None:
    """Success against metres driven for each log; reliability, errors, wrong but sure."""
    logs = numbers["logs"]
    figure, axes = common.canvas(5.0 * max(len(logs), 3), 9.0, 2, max(len(logs), 3))
    for axis in axes[0, len(logs) :]:
        axis.axis("off")
    for axis, (name, log) in zip(axes[0], logs.items(), strict=False):
        _draw_found(axis, name, log)
    axes[0, 0].legend(
        frameon=False, fontsize=8, ncols=2, loc="upper right", bbox_to_anchor=(1.0, 0.95)
    )
    _draw_reliability(axes[1, 0], numbers["reliability"])
    _draw_errors(axes[1, 1], logs)
    _draw_wrong(axes[1, 2], logs)
    for axis in axes[1, 3:]:
        axis.axis("off")
    figure.savefig(path)


def _draw_found(axis, name: str, log: Numbers) -> None:
    methods: dict[str, str] = {}
    for part, by_method in log.items():
        if part == "outside":
            continue
        for style, (method, one) in zip(STYLES, by_method.items(), strict=False):
            methods[method] = style
            metres = np.array([np.inf if x is None else x for x in one["found_at_m"]])
            x = np.linspace(0.0, LONGEST, 151)
            y = (metres[None] <= x[:, None]).mean(axis=1)
            axis.plot(x, y, style, color=COLOURS[part])
        axis.plot([], [], color=COLOURS[part], label=part)
    for method, style in methods.items():
        axis.plot([], [], style, color=common.BLACK, label=method)
    axis.axvline(5.0, color="0.8", zorder=0)
    axis.set(title=name, xlabel="driven [m]", ylabel="share of the starts that are found")
    axis.set(xlim=(0, LONGEST), ylim=(0, 1.02))


def _draw_reliability(axis, rows: list[Numbers]) -> None:
    some = [row for row in rows if row["steps"]]
    x, y = ([row[key] for row in some] for key in ("probability", "right"))
    axis.plot([0, 1], [0, 1], color="0.8")
    axis.plot(x, y, "o-", color=common.BLUE)
    for k, row in enumerate(some):
        at, beside = (row["probability"], row["right"]), ((5, -11), (-12, 6))[k % 2]
        axis.annotate(f"{row['steps']:,}", at, beside, textcoords="offset points", fontsize=7)
    axis.set(title="jaxslam, all logs and drives; number of steps")
    axis.set(xlabel="probability that the pose is right", ylabel="share that is right")


def _draw_errors(axis, logs: Numbers) -> None:
    for style, (name, log) in zip((*STYLES, "-."), logs.items(), strict=False):
        for part in ("own map", "second half"):
            errors = log.get(part, {}).get("jaxslam", {}).get("position_m")
            if errors:
                axis.plot(
                    errors,
                    np.linspace(0, 1, len(errors)),
                    style,
                    color=COLOURS[part],
                    label=f"{name}, {part}",
                )
    axis.axvline(0.1, color="0.8", zorder=0)
    axis.set(title="jaxslam, poses that are sure and right", xlim=(0, 0.25), ylim=(0, 1.02))
    axis.set(xlabel="position error [m]", ylabel="share of the steps")
    axis.legend(frameon=False, fontsize=8, loc="lower right")


def _draw_wrong(axis, logs: Numbers) -> None:
    labels = []
    markers = dict(zip(("jaxslam", "2,000 particles", "500 particles"), "os^", strict=True))
    for name, log in logs.items():
        for part, by_method in log.items():
            for k, (method, one) in enumerate(by_method.items()):
                low, high = (100 * x for x in one["wrong_but_sure_interval"])
                at = len(labels) + 0.2 * (k - 1)
                axis.plot([low, high], [at, at], color=COLOURS[part])
                share = 100 * (one["wrong_but_sure_share"] or 0.0)
                axis.plot(share, at, markers[method], color=COLOURS[part], markersize=5)
            labels.append(f"{name}, {part}")
    for method, marker in markers.items():
        axis.plot([], [], marker, color=common.BLACK, label=method)
    axis.axvline(0.5, color="0.8", zorder=0)
    axis.set_yticks(range(len(labels)), labels, fontsize=8)
    axis.set_xscale("symlog", linthresh=0.1)
    axis.set_xticks([0, 0.1, 0.5, 1, 5, 20, 100], ["0", "0.1", "0.5", "1", "5", "20", "100"])
    axis.set(xlim=(-0.05, 130), ylim=(len(labels) + 0.8, -0.6))
    axis.set(title="wrong but sure, 95 % intervals", xlabel="of the steps that are sure [%]")
    axis.legend(frameon=False, fontsize=8, loc="lower center", ncols=3)
