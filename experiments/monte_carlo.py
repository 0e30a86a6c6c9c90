"""How large the errors of many drives are, and what many drives cost in time and memory.

The robot drives from S to F through the office, again and again with new noise. `p50_m`, `p95_m`
and `p99_m` are percentiles over the runs of each run's position RMSE: one drive of a hundred is
worse than `p99_m`. Runs that end more than 1 m off, or in no number, are counted apart with their
numbers; with `--replay RUN` one is driven alone.

The same command goes on where it was stopped: what is done is kept in the folder `--out`. With
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
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple, TextIO

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from tqdm import tqdm

from experiments import common, processes, scaling
from experiments.estimator import peak
from experiments.monte_carlo_picture import SHOWN, draw
from jaxslam.core import trace_cache
from jaxslam.core.devices import use_cpu_devices
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
KEPT = 64  # runs of a file of those that are done
WORST = 5  # runs drawn one by one
BINS = 60


class Case(NamedTuple):
    """What is driven, in what and how."""

    seed: int
    config: Config
    robot: Robot
    walls: np.ndarray  # (S, 4)
    path: np.ndarray  # (N, 2)
    steps: int | None = None  # scans of a run; those to the end of the path by default


def office(seed: int) -> Case:
    """The drive from S to F."""
    path = path_following.densify(worlds.waypoints("office"))
    return Case(seed, Config(), Robot(), np.asarray(worlds.named("office").walls), path)


def work(case: Case, runs: int, folder: Path | None, say: TextIO | None = None) -> common.Numbers:
    """Errors of B runs; called in all processes, and process 0 keeps what is done.

    Args:
        case: What is driven.
        runs: B.
        folder: For what is done, so that a next call goes on; None to keep nothing.
        say: Stream of the progress bar.
    """
    key, robot = jax.random.key(case.seed), case.robot
    place, path = World(jnp.asarray(case.max_walls, float)), jnp.asarray(case.path, float)
    steps = case.frontend.automaton_steps or drives.num_scans_of_drive(robot, path)
    noise = NoiseParams.for_simulated_robot(*robot)
    given = key, case.config, noise, place, robot, path
    leads = jax.process_index() == 0
    folder = folder if leads else None
    mark = fingerprint(case._replace(steps=steps), noise)
    done, seconds, most = load(folder, mark)
    first = sum(len(part.finite) for part in done)
    if jax.process_count() > 1:
        first = int(multihost_utils.broadcast_one_to_all(np.int32(first)))
    with tqdm(total=runs, initial=min(first, runs), unit="run", file=say, desc="compiling") as bar:
        if first < runs:  # compiles, which is not timed
            next(trials.run_trials(*given, num_trials=first + 1, num_scans=steps, first=first))
            give_back()
        bar.set_description("running")
        bar.unpause()
        begin, new = perf_counter(), []
        for part in trials.run_trials(*given, num_trials=runs, num_scans=steps, first=first):
            bar.update(len(part.finite))
            first += len(part.finite)
            if not leads:
                continue
            new.append(part)
            if sum(len(one.finite) for one in new) >= KEPT or first == runs:
                done.append(episodes.concatenate_results(new))
                now, new = perf_counter(), []
                seconds, begin = seconds + now - begin, now
                most = max(most, peak())
                keep(folder, first, done[-1], mark, seconds, most)
    if not leads:
        return {"peak_mb": peak()}
    tracks = jax.tree.map(lambda x: x[:runs], episodes.concatenate_results(done))
    numbers = {
        "seed": case.seed,
        "steps": steps,
        "seconds": seconds,
        "seconds_per_scan": seconds / tracks.num_updates.size,
        "devices": jax.device_count(),
        "processes": jax.process_count(),
        **summary(key, tracks),
    }
    return numbers | {"walls": case.max_walls, "peak_mb": max(most, peak())}


def give_back() -> None:
    """Return to the system what the compiler has freed: two gigabytes that malloc would keep."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:  # glibc has it
        trim(0)


def summary(key: Any, tracks: TrialResult) -> common.Numbers:
    """Distribution of the errors of B runs, and the worst of them."""
    error = np.asarray(
        consistency.pose_error(jnp.asarray(tracks.estimate), jnp.asarray(tracks.truth))
    )
    off = np.linalg.norm(error[..., :2], axis=-1)  # (B, T)
    told = evaluate(tracks)
    keys_of = lambda runs: np.asarray(
        jax.random.key_data(trials.trial_keys(key, jnp.asarray(runs, jnp.int32)))
    )
    told["diverged_keys"] = keys_of(told["diverged_runs"])
    good = np.setdiff1d(np.arange(len(off)), told["nonfinite_runs"])
    rmse = np.sqrt(np.mean(off**2, axis=1))
    if good.size == 0:
        return told | {f"p{k}_m": None for k in SHOWN} | {"worst": []}
    worst = good[np.argsort(rmse[good], kind="stable")[::-1][:WORST]]
    low, high = rmse[good].min(), rmse[good].max()
    edges = np.geomspace(0.99 * low + 1e-9, 1.01 * high + 1e-9, BINS + 1)
    return {
        **told,
        **{f"p{k}_m": np.percentile(rmse[good], k) for k in SHOWN},
        "largest_m": off[good].max(),
        "histogram": {"edges_m": edges, "runs": np.histogram(rmse[good], edges)[0]},
        "per_scan": {f"p{k}_m": np.percentile(off[good], k, axis=0) for k in SHOWN},
        "worst": [
            {
                "run": int(run),
                "key": own,
                "position_rmse_m": rmse[run],
                "error_m": off[run],
                "truth": tracks.truth[run, :, :2],
                "estimate": tracks.estimate[run, :, :2],
            }
            for run, own in zip(worst, keys_of(worst), strict=True)
        ],
    }


def fingerprint(case: Case, noise: NoiseParams) -> str:
    """What must be the same for runs to be of one experiment: the case and the program."""
    text = hashlib.sha256(repr((case._replace(walls=0, path=0), trace_cache.version())).encode())
    for x in (case.max_walls, case.path, *jax.tree.leaves(noise)):
        text.update(np.asarray(x, float).tobytes())
    return f"{case.seed}, {text.hexdigest()[:16]}"


def keep(
    folder: Path | None, end: int, part: TrialResult, mark: str, seconds: float, most: float
) -> None:
    """Write the runs before number `end` to a file, which appears whole or not at all."""
    if folder is None:
        return
    told = {"mark": np.array(mark), "seconds": np.array(seconds), "peak_mb": np.array(most)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", path=folder) from None
    with replace(folder / f"{end - len(part.finite):07d}.npz") as file:
        np.savez(file, **part._asdict(), **told)


def load(folder: Path | None, mark: str) -> tuple[list[TrialResult], float, float]:
    """Runs that were kept, from number 0 without a gap; their seconds and memory [MB]."""
    parts, seconds, most = [], 0.0, 0.0
    for first, file in _files(folder):
        if first != sum(len(part.finite) for part in parts):
            break
        try:
            with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as kept:
                other = str(kept["mark"])
                part = TrialResult(**{name: kept[name] for name in TrialResult._fields})
                seconds, most = float(kept["seconds"]), float(kept["peak_mb"])
        except (OSError, KeyError, ValueError, zipfile.BadZipFile):
            raise InputError("is broken", path=file, advice="remove it") from None
        if other != mark:
            advice = f"finish those, or remove {folder}"
            raise InputError("has runs of another seed or program", path=file, advice=advice)
        parts.append(part)
    return parts, seconds, most


def _files(folder: Path | None) -> Iterator[tuple[int, Path]]:
    """Number of the first run and file of all that is kept, in order."""
    for file in sorted([] if folder is None else folder.glob("*.npz")):
        yield int(file.stem), file


def replay(case: Case, run: int) -> common.Numbers:
    """Drive one run of the experiment alone; its errors."""
    path, robot = jnp.asarray(case.path, float), case.robot
    place = World(jnp.asarray(case.max_walls, float))
    steps = case.frontend.automaton_steps or drives.num_scans_of_drive(robot, path)
    key, noise = jax.random.key(case.seed), NoiseParams.for_simulated_robot(*robot)
    given = key, case.config, noise, place, robot, path
    alone = trials.run_trials(*given, num_trials=run + 1, num_scans=steps, first=run)
    return {"run": run} | summary(key, episodes.concatenate_results(alone))


def together(given: Any) -> processes.Group | None:
    """The processes that the arguments ask for; None for this one alone.

    Raises:
        InputError: They do not fit together.
    """
    if not given.coordinator_address:
        if given.num_processes or given.process_id >= 0:
            raise InputError("is missing", field="--coordinator_address")
        return processes.local(given.processes) if given.processes > 1 else None
    if not 0 <= given.process_id < given.num_processes:
        raise InputError("is not below --num_processes", field="--process_id")
    return processes.Group(given.coordinator_address, given.num_processes, (given.process_id,))


def compute(
    case: Case, runs: int, folder: Path, group: processes.Group | None = None
) -> common.Numbers | None:
    """Errors of B runs on all devices of a group of processes; None where process 0 is not."""
    if group is None:
        use_cpu_devices()
        return work(case, runs, folder, sys.stderr)
    results = processes.run(group, work, case, runs, folder)
    if 0 not in group.own:
        return None
    # The memory of all processes of this machine counts.
    return results[0] | {"peak_mb": sum(one["peak_mb"] for one in results)}


@common.ended(NAME, processes.Lost)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for what cannot be done, 130 for Ctrl-C."""
    flags = {"processes": 1, "coordinator_address": "", "num_processes": 0, "process_id": -1}
    given = common.parse(__doc__, argv, runs=10_000, replay=-1, **flags)
    folder = given.out / f"{NAME}_runs"
    if given.frontend.segments < 1:
        raise InputError("is not positive", field="--runs")
    case = office(given.seed)
    if given.replay >= 0:
        told = replay(case, given.replay)
        print({key: told[key] for key in ("run", "position_rmse_m", "diverged", "nonfinite")})
        return 0
    numbers = compute(case, given.frontend.segments, folder, together(given))
    if numbers is None:
        print("done; process 0 has the results")
        return 0
    numbers |= {"scaling": scaling.compute(given.seed)}
    common.save(given.out, NAME, numbers, draw)
    shutil.rmtree(folder, ignore_errors=True)
    shown = "position_rmse_m", "p50_m", "p95_m", "p99_m", "diverged", "nonfinite", "peak_mb"
    print({key: numbers[key] for key in (*shown, "seconds", "seconds_per_scan", "devices")})
    return 0


if __name__ == "__main__":
    sys.exit(main())
