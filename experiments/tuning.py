"""Noise by gradient, by hand, by likelihood, at random and by Bayesian optimisation.

On simulated drives through the office and, with `--mrclam FOLDER`, on the MRCLAM data set there:
robots 1 to 3 train, 4 and 5 judge. Each search goes on for ten times as long as the tuning by
gradient. After that, whether tuning finds a noise that is known (`recovery`). The same command
goes on where it was stopped.
"""

import sys
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np

from experiments import common, recovery, search
from jaxslam.cli.options import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import mrclam
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import trials
from jaxslam.tuning import fitting
from jaxslam.tuning.losses import innovation_nll, pose_nll

NAME = "tuning"
TRAIN, JUDGE = (1, 2, 3), (4, 5)  # robots of MRCLAM
STEPS = {"office": 25, "mrclam": 40}
STEP_RUNS = 256  # of the step that is timed
LONGER = 10.0  # times as long as the gradient that the others search
LANDMARKS = 64  # of the map of the office
DATA = {"office": "office", "mrclam": "MRCLAM"}
STYLES = {
    "hand": (common.BLACK, ":"),
    "gradient": (common.GREEN, "-"),
    "likelihood": (common.PINK, "-."),
    "random": (common.ORANGE, "--"),
    "bayesian": (common.BLUE, "--"),
}


def office(seed: int, runs: int, heldout: int) -> search.Task:
    """Simulated drives; by hand: the noise for a robot that nothing is known of."""
    config = Config(
        filter=FilterConfig(
            max_landmarks=LANDMARKS,
        ),
    )
    place, robot, path, scans = common.scene()
    total = runs + heldout
    logs = trials.simulate_episodes(
        jax.random.key(seed), config, robot, place, path, num_trials=total, num_scans=scans
    )
    train, test = (common.part(logs, part) for part in (slice(runs), slice(runs, total)))
    return search.Task(config, NoiseParams.for_laser_log(), train, test)


def recorded(folder: Path) -> search.Task:
    """Drives of MRCLAM; by hand: range 0.15 m, bearing 0.03 rad, odometry 10 %."""
    every = [mrclam.read(folder, robot) for robot in TRAIN + JUDGE]
    logs = [episodes.episode_from_landmark_log(one) for one in every]
    parts = logs[: len(TRAIN)], logs[len(TRAIN) :]
    train, test = (episodes.stack_episodes(part) for part in parts)
    # There are no walls.
    return search.Task(
        episodes.landmark_log_config(every),
        NoiseParams.for_landmark_sensor(),
        train,
        test,
        ("wall",),
    )


def compare(
    data: str, task: search.Task, seed: int, steps: int, kept: common.Kept
) -> tuple[list[common.Numbers], common.Numbers]:
    """A row for each method, and the traces that they were read off."""
    traces = {}
    compiled = set()

    def run(method: str, loss: Any, make: Any) -> None:
        def timed() -> common.Numbers:
            if loss not in compiled:
                search.compile_all(task, loss)
                compiled.add(loss)
            return make()

        traces[method] = kept(f"{data} {method}", timed)

    for method, loss in (("gradient", pose_nll), ("likelihood", innovation_nll)):
        run(method, loss, lambda loss=loss: search.by_gradient(task, loss, steps))
    own = traces["gradient"]
    limits = LONGER * own["seconds"], own["evaluations"]
    for method in search.methods():
        run(method, pose_nll, lambda m=method: search.by_search(task, m, seed, *limits))
    first = own["points"][0]
    rows = [_row(data, "hand", first, 0.0, 0, own, first)]
    for method, trace in traces.items():
        last, total = trace["points"][-1], (trace["seconds"], trace["evaluations"])
        within = search.best_by(trace, evaluations=own["evaluations"])
        rows.append(_row(data, method, last, *total, own, within, trace))
    return rows, traces


def step_seconds(task: search.Task) -> common.Numbers:
    """Seconds of one step of tuning over many runs, compiled; the training runs again and again."""
    runs = len(task.train.odometry)
    logs = common.part(task.train, np.arange(STEP_RUNS) % runs)
    taken = []
    for _ in range(3):
        begin = perf_counter()
        fitting.gradients(task.config, task.hand, logs)
        taken.append(perf_counter() - begin)
    return {"runs": STEP_RUNS, "scans": logs.odometry.shape[1], "seconds": sorted(taken)[1]}


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
    """What a method found, also in the time and the evaluations of the gradient `own`."""
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
    early = search.best_by(trace, seconds=own["seconds"])
    best = min(point["heldout_rmse_m"] for point in trace["points"])
    return row | {
        "heldout_rmse_at_equal_seconds_m": early["heldout_rmse_m"],
        "best_heldout_rmse_m": best,
        "seconds_to_best": search.time_to(trace, best),
        "gradient_seconds_to_that": search.time_to(own, best),
    }


def draw(numbers: common.Numbers, path: Path) -> None:
    """Held-out error over time and over evaluations; where recovery ended."""
    shown = list(numbers["traces"])
    figure, axes = common.canvas(12, 4.2 * len(shown) + 4.2, len(shown) + 1, 2)
    for (left, right), data in zip(axes, shown, strict=False):
        _draw_traces(left, numbers, data, "seconds")
        _draw_traces(right, numbers, data, "evaluations")
    for axis in axes[-1]:
        axis.remove()
    wide = figure.add_subplot(axes[-1, 0].get_gridspec()[len(shown), :])
    recovery.draw(wide, numbers["recovery"])
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
    common.plain_log(axis)
    runs = "training runs, values and gradients alike" if over == "evaluations" else ""
    axis.set_xlabel("time [s]" if over == "seconds" else f"evaluations of all {runs}")
    axis.set_title(DATA[data])
    axis.legend(fontsize="small")


@common.ended(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for what cannot be done, 130 for Ctrl-C."""
    sizes = {"runs": 32, "heldout": 64, "starts": 20, "recovery_runs": 256}
    given = common.parse(__doc__, argv, mrclam="", **sizes)
    use_cpu_devices()
    enable_caches()
    about = {key: str(value) for key, value in vars(given).items() if key != "out"}
    kept = common.Kept(given.out / f"{NAME}_parts", about)
    rows, traces = [], {}
    tasks = {"office": lambda: office(given.seed, given.frontend.segments, given.heldout)}
    if given.mrclam:
        robots = recorded(Path(given.mrclam))
        tasks["mrclam"] = lambda: robots
    for data, make in tasks.items():
        task = make()
        more, traces[data] = compare(data, task, given.seed, STEPS[data], kept)
        rows += more
        if data == "office":
            step = kept("a step", lambda task=task: step_seconds(task))
    sizes = given.starts, given.recovery_runs, given.heldout
    told = recovery.compute(given.seed, *sizes, kept)
    numbers = {"seed": given.seed, "rows": rows, "recovery": told, "step": step, "traces": traces}
    common.save(given.out, NAME, numbers, draw)
    kept.clear()
    for row in rows:
        error, nees = 100 * (row["heldout_rmse_m"] or np.nan), row["nees"] or np.nan
        name = f"{row['data']:7} {row['method']:11}"
        print(f"{name} {error:8.2f} cm  NEES {nees:7.2f}  {row['seconds']:6.0f} s")
    print(f"a step over {step['runs']} runs of {step['scans']} scans: {step['seconds']:.1f} s")
    print({key: told[key] for key in ("starts", "within_3_se", "worst_heldout_ratio")})
    return 0


if __name__ == "__main__":
    sys.exit(main())
