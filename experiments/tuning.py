"""Who finds the best parameters, by gradient or otherwise, on the same data from the same start.

- Noise, on simulated drives through the office and, with `--mrclam FOLDER`, on the MRCLAM data set
  there (robots 1 to 3 are for training, 4 and 5 held out): by gradient, hand-set, by likelihood, by
  random search and by Bayesian optimisation. Each search goes on for ten times as long as the
  tuning by gradient. Hand-set and tuned noise also with online adaptation (`adaptation`).
- A pendulum and a linear model, tuned by other libraries (`model_tuners`).
- Calibration of a robot, beside the closed form of Censi et al. (`calibration_rows`).
- Whether tuning recovers known noise (`parameter_recovery`).

The same command resumes where it was stopped. Methods whose library is missing are left out, with a
line that says so.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import perf_counter

import jax
import numpy as np

from experiments import (
    adaptation,
    calibration_rows,
    common,
    model_tuners,
    noise_search,
    parameter_recovery,
)
from experiments.tuning_picture import draw
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import mrclam
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import trial_episodes
from jaxslam.tuning import fitting, parameters
from jaxslam.tuning.losses import Loss, innovation_nll, pose_nll

NAME = "tuning"
TRAIN, HELDOUT = (1, 2, 3), (4, 5)  # robots of MRCLAM
NUM_UPDATES = {"office": 25, "mrclam": 40}
TIMED_TRIALS = 256  # of the update that is timed
SEARCH_TIME = 10.0  # of a search, by the time of the gradient
LANDMARKS = 64  # capacity of the map of the office
MODEL_UPDATES = 40  # of the small models


def office(seed: int, num_trials: int, num_heldout: int) -> noise_search.Task:
    """Simulated drives; the hand-set noise is that for an unknown robot."""
    config = Config(filter=FilterConfig(max_landmarks=LANDMARKS))
    world, robot, path, num_scans = common.drive_in()
    total = num_trials + num_heldout
    key = jax.random.key(seed)
    drives = trial_episodes.simulate_episodes(
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


def adapting(
    data: str, task: noise_search.Task, own: common.Numbers, cache: common.ResultCache
) -> list[common.Numbers]:
    """Rows of hand-set noise and of that by gradient, whose trace is `own`, that adapts online."""
    rows, totals = [], {"hand": (0.0, 0), "gradient": (own["seconds"], own["evaluations"])}
    for method, point in (("hand", own["points"][0]), ("gradient", own["points"][-1])):
        params = parameters.unflatten_params(np.array(point["theta"]), task.hand)
        make = partial(adaptation.heldout, task.config.filter, params, task.test)
        found = cache(f"{data} {method} adapting", make)
        row = _row(data, f"{method}, adapting", found, *totals[method], own, found)
        rows.append(row | {key: found[key] for key in ("q_factor", "r_factor")})
    return rows


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


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    sizes = {"runs": 32, "heldout": 64, "starts": 20, "recovery_runs": 256}
    sizes |= {"sequences": 16, "steps": 200, "calibration_runs": 16}
    args = common.parse(__doc__, argv, mrclam="", **sizes)
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
        rows += more + adapting(data, task, traces[data]["gradient"], cache)
        if data == "office":
            update = cache("a step", partial(update_seconds, task))
    own = args.seed, args.sequences, args.steps, MODEL_UPDATES, cache
    models = model_tuners.compute(*own)
    calibrated = calibration_rows.compute(args.seed, args.calibration_runs, args.heldout, cache)
    found = parameter_recovery.compute(
        args.seed, args.starts, args.recovery_runs, args.heldout, cache
    )
    numbers = {"seed": args.seed, "rows": rows, "recovery": found, "step": update, "traces": traces}
    numbers |= {"models": models, "calibration": calibrated}
    common.save(args.out, NAME, numbers, draw)
    cache.clear()
    print_rows(numbers)
    return 0


def print_rows(numbers: common.Numbers) -> None:
    """Print a line for each row, and the summaries."""
    for row in numbers["rows"] + numbers["calibration"]:
        error, nees = 100 * (row["heldout_rmse_m"] or np.nan), row["nees"] or np.nan
        name = f"{row['data']:11} {row['method']:30}"
        print(f"{name} {error:8.2f} cm  NEES per dof {nees:7.2f}  {row['seconds']:7.1f} s")
    for name, rows in numbers["models"].items():
        for row in rows:
            text = f"{name:11} {row['method']:30} {row['error']:8.3f} of a logarithm  "
            print(f"{text}loss {row['loss']:8.5f}  {row['seconds']:7.1f} s")
    update, found = numbers["step"], numbers["recovery"]
    print(
        f"an update over {update['runs']} trials of {update['scans']} scans: "
        f"{update['seconds']:.1f} s"
    )
    print({key: found[key] for key in ("starts", "within_3_se", "worst_heldout_ratio")})


if __name__ == "__main__":
    sys.exit(main())
