"""What the error of a robot depends on, and what to improve first.

A robot with a small scanner, which is not quite where its user thinks, drives through the paper's
room; a few beams do not return. `derivative` is that of the logarithm of the position RMSE of a
trial by the logarithm of a parameter (an elasticity), or by its unit where it is a pose, with its
standard error; `method` is how it was found. Gradients are compared with paired differences on the
same trials: `distance` is in standard errors of the difference, and where it is above 2 the
derivative is by the differences. `halved` is the effect of half the parameter, measured; of twice
the period of the scans.
"""

import sys
from pathlib import Path

import numpy as np

from experiments import common
from experiments.rare_failures import CONFIG, ENCODER_NOISE, WAYPOINTS
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.filtering.noise import NoiseParams
from jaxslam.simulation import path_following, worlds
from jaxslam.simulation.life import life_in
from jaxslam.simulation.range_errors import RangeErrors
from jaxslam.simulation.robot import Robot
from jaxslam.study.runner import Variant
from jaxslam.study.sensitivities import Sensitivity, describe, ranked, sensitivities
from jaxslam.study.trial_parameters import MOUNT, TrialErrors

NAME = "sensitivities"
NUM_SCANS = 12
MOUNT_ERROR = (0.02, 0.01, 0.01)  # [m, m, rad]
MISSING = 0.05
MAX_ERROR = 0.5  # [m] of a trial that has not diverged
PARAMETERS = (
    *("encoder_noise", "range_noise", "scan_period", *MOUNT),
    *("filter.odometry_coefficients", "filter.feature_std_scale", "filter.range_std"),
    "life.ranges.missing",
)


def drive() -> Variant:
    """Twelve scans in the paper's room."""
    world, path = worlds.named("fig07"), path_following.densify(np.array(WAYPOINTS))
    life = life_in(world, path, ranges=RangeErrors(missing=MISSING))
    robot = Robot(encoder_noise=ENCODER_NOISE, mount=MOUNT_ERROR)
    params = NoiseParams.for_simulated_robot(*robot[:2])
    return Variant("room", {}, CONFIG, params, robot, world, path, NUM_SCANS, life)


def numbers_of(one: Sensitivity) -> common.Numbers:
    """A sensitivity for JSON."""
    numbers = one._asdict() | {"parameter": one.parameter._asdict(), "line": describe(one)}
    for name in ("derivative", "paired", "gradient", "halved"):
        estimate = numbers[name]
        numbers[name] = None if estimate is None else estimate._asdict()
    return numbers


def draw(numbers: common.Numbers, path: Path) -> None:
    """Draw elasticities by both methods, and the effects of half of each parameter."""
    figure, axes = common.canvas(12, 4, 1, 2)
    axis, beside = axes[0]
    rows = [one for one in numbers["sensitivities"] if one["parameter"]["is_log"]][::-1]
    labels = [one["parameter"]["name"] for one in rows]
    styles = (("paired", 0.15, common.BLUE), ("gradient", -0.15, common.ORANGE))
    for method, shift, colour in styles:
        some = [(k + shift, one[method]) for k, one in enumerate(rows) if one[method]]
        axis.errorbar(
            [x["mean"] for _, x in some],
            [k for k, _ in some],
            xerr=[2 * x["standard_error"] for _, x in some],
            fmt="o",
            color=colour,
            label="paired differences" if method == "paired" else "gradient",
        )
    axis.axvline(0.0, color=common.BLACK, linewidth=0.5)
    axis.set_yticks(range(len(rows)), labels)
    axis.set(xlabel="d log(position RMSE) / d log(parameter)", title="with 2 standard errors")
    axis.legend(loc="upper left")
    order = numbers["improve_first"][::-1]
    own = {one["parameter"]["name"]: one for one in rows}
    for k, name in enumerate(order):
        effect = own[name]["halved"]
        beside.barh(k, 100 * (np.exp(effect["mean"]) - 1), color=common.SKY)
        error = 200 * effect["standard_error"] * np.exp(effect["mean"])
        beside.errorbar(100 * (np.exp(effect["mean"]) - 1), k, xerr=error, color=common.BLACK)
    texts = [f"{x}, {'doubled' if own[x]['parameter']['one_sided'] else 'halved'}" for x in order]
    beside.set_yticks(range(len(order)), texts)
    beside.axvline(0.0, color=common.BLACK, linewidth=0.5)
    beside.set(xlabel="change of the error [%]", title="what to improve first, at the top")
    figure.savefig(path)


@common.report_errors(NAME, ValueError)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment."""
    arguments = common.parse(__doc__, argv, trials=256)
    use_cpu_devices(1)
    enable_caches()
    errors = TrialErrors(drive(), PARAMETERS, num_trials=arguments.trials, seed=arguments.seed)
    found = sensitivities(
        errors.parameters, errors.log_errors, errors.gradients, max_error=MAX_ERROR
    )
    for one in found:
        print(describe(one))
    order = [one.parameter.name for one in ranked(found)]
    print("improve first:", ", ".join(order))
    rows = [numbers_of(one) for one in found]
    numbers = {"trials": arguments.trials, "scans": NUM_SCANS, "sensitivities": rows}
    common.save(arguments.out, NAME, numbers | {"improve_first": order}, draw)
    return 0


if __name__ == "__main__":
    sys.exit(main())
