"""Distribution of the errors of many drives, and their cost in time and memory.

The robot drives from S to F through the office, again and again with new noise. `p50_m`, `p95_m`
and `p99_m` are percentiles over the trials of each trial's position RMSE: one drive of a hundred is
worse than `p99_m`. Trials that end more than 1 m off, or are not finite, are counted separately and
listed by number; with `--replay NUMBER` one is driven alone.

The same command resumes where it was stopped: finished trials are kept in the folder `--out`. With
`--processes 2` two processes of this machine share the work; on several machines, start one on
each with `--coordinator_address HOST:PORT --num_processes N --process_id K`. The results are the
same bit for bit.
"""

import shutil
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TextIO

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import common, scaling
from experiments.monte_carlo_picture import SHOWN, draw
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.types import Key
from jaxslam.evaluation import consistency
from jaxslam.evaluation.summary import evaluate
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io.errors import InputError
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import TrialResult
from jaxslam.simulation import drives, path_following, trial_episodes, worlds
from jaxslam.simulation.robot import Robot
from jaxslam.study import kept_trials, processes, runner
from jaxslam.study.runner import Variant

NAME = "monte_carlo"
GROUP_FLAGS = "--coordinator_address", "--num_processes", "--process_id"
WORST = 5  # trials drawn one by one
BINS = 60


def office(num_scans: int | None = None) -> Variant:
    """The drive from S to F."""
    robot = Robot()
    path = path_following.densify(worlds.waypoints("office"))
    return Variant(
        "office",
        {},
        Config(),
        NoiseParams.for_simulated_robot(*robot[:2]),
        robot,
        worlds.named("office"),
        path,
        num_scans or drives.num_scans_of_drive(robot, path),
    )


def work(
    case: Variant, seed: int, num_trials: int, folder: Path | None, stream: TextIO | None = None
) -> common.Numbers:
    """Errors of B trials; called in all processes, of which process 0 keeps the results.

    Args:
        case: What is driven.
        seed: Of the noise.
        num_trials: B.
        folder: For finished trials, so that a next call resumes; None to keep nothing.
        stream: Of the progress bar.
    """
    with tqdm(total=num_trials, unit="trial", file=stream, desc="compiling") as bar:

        def show(done: int) -> None:
            if not bar.n:  # what earlier calls have done took no time
                bar.initial = bar.n = bar.last_print_n = done
                bar.unpause()
            bar.set_description("running" if done > bar.initial else "compiling", refresh=False)
            bar.update(done - bar.n)

        results, seconds, peak = kept_trials.collect(
            partial(runner.results_of, case, seed),
            TrialResult,
            num_trials,
            folder=folder,
            mark=runner.fingerprint(case, seed),
            callback=show,
        )
    if results is None:
        return {"peak_mb": peak}
    return {
        "seed": seed,
        "steps": case.num_scans,
        "seconds": seconds,
        "seconds_per_scan": seconds / results.num_updates.size,
        "devices": jax.device_count(),
        "processes": jax.process_count(),
        **summary(jax.random.key(seed), results),
        "walls": np.asarray(case.world.walls),
        "peak_mb": peak,
    }


def summary(key: Key, results: TrialResult) -> common.Numbers:
    """Distribution of the errors of B trials, and the worst of them."""
    error = np.asarray(
        consistency.pose_error(jnp.asarray(results.estimate), jnp.asarray(results.truth))
    )
    distance = np.linalg.norm(error[..., :2], axis=-1)  # (B, T)
    numbers = evaluate(results)
    numbers["diverged_keys"] = key_data(key, numbers["diverged_runs"])
    good = np.setdiff1d(np.arange(len(distance)), numbers["nonfinite_runs"])
    rmse = np.sqrt(np.mean(distance**2, axis=1))
    if good.size == 0:
        return numbers | {f"p{k}_m": None for k in SHOWN} | {"worst": []}
    worst = good[np.argsort(rmse[good], kind="stable")[::-1][:WORST]]
    low, high = rmse[good].min(), rmse[good].max()
    edges = np.geomspace(0.99 * low + 1e-9, 1.01 * high + 1e-9, BINS + 1)
    return {
        **numbers,
        **{f"p{k}_m": np.percentile(rmse[good], k) for k in SHOWN},
        "largest_m": distance[good].max(),
        "histogram": {"edges_m": edges, "runs": np.histogram(rmse[good], edges)[0]},
        "per_scan": {f"p{k}_m": np.percentile(distance[good], k, axis=0) for k in SHOWN},
        "worst": [
            {
                "run": int(trial),
                "key": own,
                "position_rmse_m": rmse[trial],
                "error_m": distance[trial],
                "truth": results.truth[trial, :, :2],
                "estimate": results.estimate[trial, :, :2],
            }
            for trial, own in zip(worst, key_data(key, worst), strict=True)
        ],
    }


def key_data(key: Key, numbers: Sequence[int] | np.ndarray) -> np.ndarray:
    """Data (K, 2) of the keys of the trials with these numbers (K,)."""
    keys = trial_episodes.trial_keys(key, jnp.asarray(numbers, jnp.int32))
    return np.asarray(jax.random.key_data(keys))


def replay(case: Variant, seed: int, number: int) -> common.Numbers:
    """Drive one trial of the experiment alone; its errors."""
    alone = episodes.concatenate_results(runner.results_of(case, seed, number + 1, number))
    return {"run": number} | summary(jax.random.key(seed), alone)


def compute(
    case: Variant, seed: int, num_trials: int, folder: Path, group: processes.Group | None = None
) -> common.Numbers | None:
    """Errors of B trials on all devices of a group of processes; None where process 0 is not."""
    if group is None:
        return work(case, seed, num_trials, folder, sys.stderr)
    results = processes.run_group(group, work, runner.in_numpy(case), seed, num_trials, folder)
    if 0 not in group.own:
        return None
    # The memory of all processes of this machine counts.
    return results[0] | {"peak_mb": sum(one["peak_mb"] for one in results)}


@common.report_errors(NAME, processes.LostProcessError)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    args = common.parse(
        __doc__,
        argv,
        runs=10_000,
        replay=-1,
        processes=1,
        coordinator_address="",
        num_processes=0,
        process_id=-1,
    )
    folder = args.out / f"{NAME}_runs"
    if args.runs < 1:
        raise InputError("is not positive", field="--runs")
    given = args.processes, args.coordinator_address, args.num_processes, args.process_id
    group = processes.group_of(*given, names=GROUP_FLAGS)
    if group is None:
        use_cpu_devices()  # before the first array, which fixes the devices
    case = office()
    if args.replay >= 0:
        found = replay(case, args.seed, args.replay)
        print(f"trial {found['run']}:", end=" ")
        print({key: found[key] for key in ("position_rmse_m", "diverged", "nonfinite")})
        return 0
    numbers = compute(case, args.seed, args.runs, folder, group)
    if numbers is None:
        print("done; process 0 has the results")
        return 0
    numbers |= {"scaling": scaling.compute(args.seed)}
    common.save(args.out, NAME, numbers, draw)
    shutil.rmtree(folder, ignore_errors=True)
    shown = "position_rmse_m", "p50_m", "p95_m", "p99_m", "diverged", "nonfinite", "peak_mb"
    print({key: numbers[key] for key in (*shown, "seconds", "seconds_per_scan", "devices")})
    return 0


if __name__ == "__main__":
    sys.exit(main())
