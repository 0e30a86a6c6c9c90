"""Noise by gradient, hand-set, by likelihood, by random search and by Bayesian optimisation.

On simulated drives through the office and, with `--mrclam FOLDER`, on the MRCLAM data set there:
robots 1 to 3 are for training, 4 and 5 held out. Each search goes on for ten times as long as the
tuning by gradient. After that, whether tuning recovers known noise (`parameter_recovery`). The same
command resumes where it was stopped.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np

from experiments import common, noise_search, parameter_recovery
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import mrclam
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import trials
from jaxslam.tuning import fitting
from jaxslam.tuning.losses import Loss, innovation_nll, pose_nll

NAME = "tuning"
TRAIN, HELDOUT = (1, 2, 3), (4, 5)  # robots of MRCLAM
NUM_UPDATES = {"office": 25, "mrclam": 40}
TIMED_TRIALS = 256  # of the update that is timed
SEARCH_TIME = 10.0  # of a search, by the time of the gradient
LANDMARKS = 64  # capacity of the map of the office
DATA = {"office": "office", "mrclam": "MRCLAM"}
STYLES = {
    "hand": (common.BLACK, ":"),
    "gradient": (common.GREEN, "-"),
    "likelihood": (common.PINK, "-."),
    "random": (common.ORANGE, "--"),
    "bayesian": (common.BLUE, "--"),
}


def office(seed: int, num_trials: int, num_heldout: int) -> noise_search.Task:
    """Simulated drives; the hand-set noise is that for an unknown robot."""
    config = Config(filter=FilterConfig(max_landmarks=LANDMARKS))
    world, robot, path, num_scans = common.drive_in()
    total = num_trials + num_heldout
    key = jax.random.key(seed)
    drives = trials.simulate_episodes(
        key, config, robot, world, path, num_trials=total, num_scans=num_scans
    )
    train = common.take(drives, slice(num_trials))
    test = common.take(drives, slice(num_trials, total))
    return noise_search.Task(config, NoiseParams.for_laser_log(), train, test)


def recorded(folder: Path) -> noise_search.Task:
    """Drives of MRCLAM; hand-set noise: range 0.15 m, bearing 0.03 rad, odometry 10 %."""
    logs = [mrclam.read(folder, robot) for robot in TRAIN + HELDOUT]
    drives = [episodes.episode_from_landmark_log(log) for log in logs]
    return noise_search.Task(
        episodes.landmark_log_config(logs),
        NoiseParams.for_landmark_sensor(),
        episodes.stack_episodes(drives[: len(TRAIN)]),
        episodes.stack_episodes(drives[len(TRAIN) :]),
        frozen=("wall_angle_std",),  # there are no walls
    )


def compare(
    data: str, task: noise_search.Task, seed: int, num_updates: int, cache: common.ResultCache
) -> tuple[list[common.Numbers], common.Numbers]:
    """A row for each method, and the traces that they are taken from."""
    traces, compiled = {}, set()

    def run(method: str, loss: Loss, search: Callable[[], common.Numbers]) -> None:
        def timed() -> common.Numbers:
            if loss not in compiled:
                noise_search.compile_all(task, loss)
                compiled.add(loss)
            return search()

        traces[method] = cache(f"{data} {method}", timed)

    for method, loss in (("gradient", pose_nll), ("likelihood", innovation_nll)):
        run(method, loss, partial(noise_search.by_gradient, task, loss, num_updates))
    own = traces["gradient"]
    limits = SEARCH_TIME * own["seconds"], own["evaluations"]
    for method in noise_search.available_methods():
        run(method, pose_nll, partial(noise_search.by_search, task, method, seed, *limits))
    first = own["points"][0]
    rows = [_row(data, "hand", first, 0.0, 0, own, first)]
    for method, trace in traces.items():
        last, total = trace["points"][-1], (trace["seconds"], trace["evaluations"])
        within = noise_search.last_within(trace, "evaluations", own["evaluations"])
        rows.append(_row(data, method, last, *total, own, within, trace))
    return rows, traces


def update_seconds(task: noise_search.Task) -> common.Numbers:
    """Seconds of one update over many trials, compiled; the training drives are repeated."""
    count = len(task.train.odometry)
    drives = common.take(task.train, np.arange(TIMED_TRIALS) % count)
    taken = []
    for _ in range(3):
        begin = perf_counter()
        fitting.gradients(task.config, task.hand, drives)
        taken.append(perf_counter() - begin)
    num_scans = drives.odometry.shape[1]
    return {"runs": TIMED_TRIALS, "scans": num_scans, "seconds": sorted(taken)[1]}


def _row(
    data: str,
    method: str,
    last: common.Numbers,
    seconds: float,
    evaluations: int,
    own: common.Numbers,
    within: common.Numbers,
    trace: common.Numbers | None = None,
) -> common.Numbers:
    """Results of a method, also within the time and the evaluations of the gradient `own`."""
    row = {
        "data": data,
        "method": method,
        "heldout_rmse_m": last["heldout_rmse_m"],
        "nees": last["nees"],
        "seconds": seconds,
        "evaluations": evaluations,
        "heldout_rmse_at_equal_evaluations_m": within["heldout_rmse_m"],
    }
    if trace is None:
        return row
    early = noise_search.last_within(trace, "seconds", own["seconds"])
    best = min(point["heldout_rmse_m"] for point in trace["points"])
    return row | {
        "heldout_rmse_at_equal_seconds_m": early["heldout_rmse_m"],
        "best_heldout_rmse_m": best,
        "seconds_to_best": noise_search.time_to(trace, best),
        "gradient_seconds_to_that": noise_search.time_to(own, best),
    }


def draw(numbers: common.Numbers, path: Path) -> None:
    """Held-out error over time and over evaluations; results of parameter recovery."""
    shown = list(numbers["traces"])
    figure, axes = common.canvas(12, 4.2 * len(shown) + 4.2, len(shown) + 1, 2)
    for (left, right), data in zip(axes, shown, strict=False):
        _draw_traces(left, numbers, data, "seconds")
        _draw_traces(right, numbers, data, "evaluations")
    for axis in axes[-1]:
        axis.remove()
    wide = figure.add_subplot(axes[-1, 0].get_gridspec()[len(shown), :])
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


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    args = common.parse(__doc__, argv, mrclam="", runs=32, heldout=64, starts=20, recovery_runs=256)
    use_cpu_devices()
    enable_caches()
    about = {key: str(value) for key, value in vars(args).items() if key != "out"}
    cache = common.ResultCache(args.out / f"{NAME}_parts", about)
    robots = recorded(Path(args.mrclam)) if args.mrclam else None  # first, as it may be refused
    tasks = {"office": office(args.seed, args.runs, args.heldout)}
    if robots is not None:
        tasks["mrclam"] = robots
    rows, traces = [], {}
    for data, task in tasks.items():
        more, traces[data] = compare(data, task, args.seed, NUM_UPDATES[data], cache)
        rows += more
        if data == "office":
            update = cache("a step", partial(update_seconds, task))
    found = parameter_recovery.compute(
        args.seed, args.starts, args.recovery_runs, args.heldout, cache
    )
    numbers = {"seed": args.seed, "rows": rows, "recovery": found, "step": update, "traces": traces}
    common.save(args.out, NAME, numbers, draw)
    cache.clear()
    for row in rows:
        error, nees = 100 * (row["heldout_rmse_m"] or np.nan), row["nees"] or np.nan
        name = f"{row['data']:7} {row['method']:11}"
        print(f"{name} {error:8.2f} cm  NEES per dof {nees:7.2f}  {row['seconds']:6.0f} s")
    print(
        f"an update over {update['runs']} trials of {update['scans']} scans: "
        f"{update['seconds']:.1f} s"
    )
    print({key: found[key] for key in ("starts", "within_3_se", "worst_heldout_ratio")})
    return 0


if __name__ == "__main__":
    sys.exit(main())
