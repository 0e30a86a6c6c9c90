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

import ctypes
import hashlib
import os
import shutil
import sys
import zipfile
from argparse import Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter
from typing import NamedTuple, TextIO

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from tqdm import tqdm

from experiments import common, processes, scaling
from experiments.filter_benchmark import peak_memory
from experiments.monte_carlo_picture import SHOWN, draw
from jaxslam.core import trace_cache
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.types import Key
from jaxslam.evaluation import consistency
from jaxslam.evaluation.summary import evaluate
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io.errors import InputError
from jaxslam.io.output import replace
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import TrialResult
from jaxslam.simulation import drives, path_following, trials, worlds
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World

NAME = "monte_carlo"
TRIALS_PER_FILE = 64
WORST = 5  # trials drawn one by one
BINS = 60


class Case(NamedTuple):
    """Robot, world, path and configuration of all trials.

    Attributes:
        seed: Of the noise.
        config: Of front end and filter.
        robot: The robot.
        walls: (S, 4) [m] of the world.
        path: (N, 2) [m] to drive along.
        num_scans: Of a trial; by default those to the end of the path.
    """

    seed: int
    config: Config
    robot: Robot
    walls: np.ndarray
    path: np.ndarray
    num_scans: int | None = None


def office(seed: int) -> Case:
    """The drive from S to F."""
    path = path_following.densify(worlds.waypoints("office"))
    return Case(seed, Config(), Robot(), np.asarray(worlds.named("office").walls), path)


class Trials:
    """The trials of a case on all devices, in order from any number on."""

    def __init__(self, case: Case):
        """Prepare key, world, path and noise parameters."""
        self.key = jax.random.key(case.seed)
        self.params = NoiseParams.for_simulated_robot(*case.robot[:2])
        self._case = case
        self._world = World(jnp.asarray(case.walls, float))
        self._path = jnp.asarray(case.path, float)
        self.num_scans = case.num_scans or drives.num_scans_of_drive(case.robot, self._path)

    def run(self, num_trials: int, first: int) -> Iterator[TrialResult]:
        """Results of trials `first` to `num_trials` - 1, some at a time."""
        return trials.run_trials(
            self.key,
            self._case.config,
            self.params,
            self._case.robot,
            self._world,
            self._path,
            num_trials=num_trials,
            num_scans=self.num_scans,
            first=first,
        )


def work(
    case: Case, num_trials: int, folder: Path | None, stream: TextIO | None = None
) -> common.Numbers:
    """Errors of B trials; called in all processes, of which process 0 keeps the results.

    Args:
        case: What is driven.
        num_trials: B.
        folder: For finished trials, so that a next call resumes; None to keep nothing.
        stream: Of the progress bar.
    """
    own = Trials(case)
    leads = jax.process_index() == 0
    folder = folder if leads else None
    mark = fingerprint(case._replace(num_scans=own.num_scans), own.params)
    done, seconds, peak = load(folder, mark)
    first = sum(len(part.finite) for part in done)
    if jax.process_count() > 1:
        first = int(multihost_utils.broadcast_one_to_all(np.int32(first)))
    with tqdm(
        total=num_trials,
        initial=min(first, num_trials),
        unit="trial",
        file=stream,
        desc="compiling",
    ) as bar:
        if first < num_trials:  # compiles, which is not timed
            next(own.run(first + 1, first))
            release_memory()
        bar.set_description("running")
        bar.unpause()
        begin, new = perf_counter(), []
        for part in own.run(num_trials, first):
            bar.update(len(part.finite))
            first += len(part.finite)
            if not leads:
                continue
            new.append(part)
            if sum(len(one.finite) for one in new) >= TRIALS_PER_FILE or first == num_trials:
                done.append(episodes.concatenate_results(new))
                now, new = perf_counter(), []
                seconds, begin = seconds + now - begin, now
                peak = max(peak, peak_memory())
                keep(folder, first, done[-1], mark, seconds, peak)
    if not leads:
        return {"peak_mb": peak_memory()}
    results = jax.tree.map(lambda x: x[:num_trials], episodes.concatenate_results(done))
    numbers = {
        "seed": case.seed,
        "steps": own.num_scans,
        "seconds": seconds,
        "seconds_per_scan": seconds / results.num_updates.size,
        "devices": jax.device_count(),
        "processes": jax.process_count(),
        **summary(own.key, results),
    }
    return numbers | {"walls": case.walls, "peak_mb": max(peak, peak_memory())}


def release_memory() -> None:
    """Return memory freed by the compiler to the system: two gigabytes that malloc would keep."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:  # glibc has it
        trim(0)


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
    keys = trials.trial_keys(key, jnp.asarray(numbers, jnp.int32))
    return np.asarray(jax.random.key_data(keys))


def fingerprint(case: Case, params: NoiseParams) -> str:
    """Text that is the same for trials of one experiment: it depends on case and program."""
    text = hashlib.sha256(repr((case._replace(walls=0, path=0), trace_cache.version())).encode())
    for x in (case.walls, case.path, *jax.tree.leaves(params)):
        text.update(np.asarray(x, float).tobytes())
    return f"{case.seed}, {text.hexdigest()[:16]}"


def keep(
    folder: Path | None, end: int, part: TrialResult, mark: str, seconds: float, peak: float
) -> None:
    """Write the trials before number `end` to a file, which appears whole or not at all."""
    if folder is None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", path=folder) from None
    with replace(folder / f"{end - len(part.finite):07d}.npz") as file:
        np.savez(file, mark=mark, seconds=seconds, peak_mb=peak, **part._asdict())


def load(folder: Path | None, mark: str) -> tuple[list[TrialResult], float, float]:
    """Kept trials, from number 0 without a gap; their seconds and peak memory [MB]."""
    parts, seconds, peak = [], 0.0, 0.0
    for first, file in _files(folder):
        if first != sum(len(part.finite) for part in parts):
            break
        try:
            with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as saved:
                other = str(saved["mark"])
                part = TrialResult(*(saved[name] for name in TrialResult._fields))
                seconds, peak = float(saved["seconds"]), float(saved["peak_mb"])
        except (OSError, KeyError, ValueError, zipfile.BadZipFile):
            raise InputError("is broken", path=file, advice="remove it") from None
        if other != mark:
            advice = f"finish those, or remove {folder}"
            raise InputError("has trials of another seed or program", path=file, advice=advice)
        parts.append(part)
    return parts, seconds, peak


def _files(folder: Path | None) -> Iterator[tuple[int, Path]]:
    """Number of the first trial and path of each file, in order."""
    for file in sorted([] if folder is None else folder.glob("*.npz")):
        yield int(file.stem), file


def replay(case: Case, number: int) -> common.Numbers:
    """Drive one trial of the experiment alone; its errors."""
    own = Trials(case)
    alone = episodes.concatenate_results(own.run(number + 1, number))
    return {"run": number} | summary(own.key, alone)


def group_of(args: Namespace) -> processes.Group | None:
    """The processes that the arguments ask for; None for this one alone.

    Raises:
        InputError: They do not fit together.
    """
    if not args.coordinator_address:
        if args.num_processes or args.process_id >= 0:
            raise InputError("is missing", field="--coordinator_address")
        return processes.local(args.processes) if args.processes > 1 else None
    if not 0 <= args.process_id < args.num_processes:
        raise InputError("is not below --num_processes", field="--process_id")
    return processes.Group(args.coordinator_address, args.num_processes, (args.process_id,))


def compute(
    case: Case, num_trials: int, folder: Path, group: processes.Group | None = None
) -> common.Numbers | None:
    """Errors of B trials on all devices of a group of processes; None where process 0 is not."""
    if group is None:
        use_cpu_devices()
        return work(case, num_trials, folder, sys.stderr)
    results = processes.run_group(group, work, case, num_trials, folder)
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
    case = office(args.seed)
    if args.replay >= 0:
        found = replay(case, args.replay)
        print(f"trial {found['run']}:", end=" ")
        print({key: found[key] for key in ("position_rmse_m", "diverged", "nonfinite")})
        return 0
    numbers = compute(case, args.runs, folder, group_of(args))
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
