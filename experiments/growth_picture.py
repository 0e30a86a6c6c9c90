"""The picture of `growth`: time by landmarks and scans, the map of the town, errors in it."""

from pathlib import Path

import numpy as np

from experiments import common
from experiments.common import Numbers
from experiments.growth_submaps import CAPACITY


def draw(numbers: Numbers, path: Path) -> None:
    """Time by landmarks, time by scans, the map of the town, errors along its drive."""
    figure, axes = common.canvas(12, 9, 2, 2)
    axis, in_submaps = axes[0, 0], numbers["town"]["progress"]
    for name, colour in (("dense", common.RED), ("deferred", common.ORANGE)):
        rows = [row for row in numbers[name] if "ms_per_scan" in row]
        slope = numbers["exponents"][f"{name}_time_by_landmarks"]
        label = f"one map, {name}" + ("" if slope is None else f": exponent {slope:.2f}")
        x, y = ([row[k] for row in rows] for k in ("landmarks", "ms_per_scan"))
        axis.plot(x, y, "o-", color=colour, label=label)
    x = [row["landmarks"] for row in in_submaps]
    y = [1e3 * row["seconds"] / row["scans"] for row in in_submaps]
    axis.plot(x, y, ".-", color=common.BLUE, label="submaps, mean since the start")
    axis.axhline(15.0, color=common.BLACK, linestyle=":", linewidth=1)
    axis.set(xscale="log", yscale="log", xlabel="landmarks", ylabel="processor time a scan [ms]")
    axis.legend(fontsize=8)

    axis = axes[0, 1]
    kinds = (("scans", common.GREEN), ("trials", common.PINK))
    for name, colour in kinds:
        rows = [row for row in numbers[name] if "seconds" in row]
        label = f"one map of {CAPACITY}, by scans" if name == "scans" else "trials of 200 scans"
        slope = numbers["exponents"][f"time_by_{name}"]
        label += "" if slope is None else f": exponent {slope:.2f}"
        x, y = ([row[k] for row in rows] for k in (name, "seconds"))
        axis.plot(x, y, "o-", color=colour, label=label)
    slope = numbers["exponents"]["submaps_time_by_scans"]
    label = "town by submaps" + ("" if slope is None else f": exponent {slope:.2f}")
    x, y = ([row[k] for row in in_submaps] for k in ("scans", "seconds"))
    axis.plot(x, y, ".-", color=common.BLUE, label=label)
    axis.set(xscale="log", yscale="log", xlabel="scans, or trials", ylabel="processor time [s]")
    axis.legend(fontsize=8)

    axis, where = axes[1, 0], numbers["town"]
    found, true = np.asarray(where["estimated_m"]), np.asarray(where["true_m"])
    axis.plot(*true.T, ".", color=common.BLACK, markersize=1.5, label="true")
    axis.plot(*found.T, ".", color=common.SKY, markersize=1.5, label="estimated")
    rmse = where["landmark_rmse_m"]
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axis.set_title(f"{where['landmarks']} landmarks, RMSE {rmse:.2f} m", fontsize=10)
    axis.legend(fontsize=8, loc="upper right", markerscale=5)

    axis = axes[1, 1]
    for name, colour, label in (
        ("online_error_by_scan_m", common.ORANGE, "at the time of the scan"),
        ("error_by_scan_m", common.BLUE, "by all submaps"),
    ):
        error = np.asarray(where[name])
        scan = np.linspace(0, where["scans"], len(error))
        axis.plot(scan, error, color=colour, linewidth=0.8, label=label)
    axis.set(xlabel="scan", ylabel="error of the position in the town [m]", ylim=(0, None))
    axis.legend(fontsize=8)
    figure.savefig(path)
