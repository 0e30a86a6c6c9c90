"""Picture of `experiments.calibration`: errors of all starts, and held-out errors beside others."""

from typing import Any

import numpy as np

from experiments import common

NOISE_NUMBERS = 8  # of the parameters, before those of the calibration


def draw(numbers: common.Numbers, path: Any) -> None:
    """Results of all starts in standard errors, and held-out errors."""
    figure, axes = common.canvas(13, 4.6, 1, 2, [3, 2])
    left, right = axes[0]
    styles = ((common.GREEN, -0.15), (common.PINK, 0.15))
    for row, (colour, side) in zip(numbers["rows"], styles, strict=False):
        z = np.array([one["theta"] for one in row["rows"]]) - np.array(row["truth"])
        z = z / np.array([np.nan if x is None else x for x in row["standard_errors"]])
        for i in range(NOISE_NUMBERS, z.shape[1]):
            left.plot(np.full(len(z), i + side), z[:, i], "D", color=colour, markersize=4)
        left.plot([], [], "D", color=colour, label=row["loss"])
    left.axhspan(-3, 3, color=common.BLACK, alpha=0.1, label="3 standard errors")
    names = [name.removeprefix("calibration.") for name in numbers["rows"][0]["names"]]
    ticks = range(NOISE_NUMBERS, len(names))
    left.set_xticks(ticks, names[NOISE_NUMBERS:], rotation=20, ha="right")
    left.set(ylabel="error [standard errors]", title="all starts")
    left.legend(fontsize="small")
    bars = {
        "no calibration": numbers["peers"]["uncalibrated_rmse_m"],
        "noise tuned alone": numbers["peers"]["noise_alone_rmse_m"],
        "closed form": numbers["peers"]["closed_form_rmse_m"],
        "true calibration and noise": numbers["peers"]["all_true_rmse_m"],
    }
    for row in numbers["rows"]:
        reference = row["known_calibration_rmse_m"]
        bars["true calibration, " + row["loss"]] = reference
        bars["tuned, " + row["loss"]] = row["heldout_ratio"][1] * reference
    values = 100 * np.array(list(bars.values()))
    right.barh(list(bars), values, color=common.SKY)
    for place, value in enumerate(values):
        right.text(value, place, f" {value:.2f}", va="center")
    right.set(xlabel="held-out position RMSE [cm], of the worst start", xscale="log")
    right.set_xlim(values.min() / 2, values.max() * 3)  # what stands beside a bar
    figure.savefig(path)
