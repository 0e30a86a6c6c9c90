"""Speed, memory and accuracy of the filter and of its gradient, beside C and other libraries.

The filter runs on `workload.rings`: 32 landmarks with a prior of half a metre, of which the nearest
8 are measured, with known data association. Tasks that need another number of cores, their own
memory or float64 run in a separate process: `python -m experiments.filter_benchmark TASK ARGUMENTS`
prints the figures. The C program is not part of the project; its figures are null where it or a
compiler is missing.
"""

import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from experiments import peer_automata, peer_filters, workload
from experiments.common import Numbers, drive_in
from experiments.timing import fastest, pin, seconds, unpin
from experiments.workload import BATCH, Drive, Steps
from jaxslam.core.batching import map_batches
from jaxslam.core.episode import Episode
from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement
from jaxslam.core.memory import peak_memory
from jaxslam.core.types import Array
from jaxslam.filtering import slam_filter
from jaxslam.filtering.config import init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import filter_episodes
from jaxslam.simulation import trial_episodes
from jaxslam.simulation.ray_casting import cast

C_SOURCE = peer_automata.C_SOURCE.with_name("ekf_limit.c")
ROOT = Path(__file__).resolve().parents[1]
TIMEOUT = 240.0  # [s] of a separate process
CALLS = 60  # steps and scans whose median is the latency
STD = np.array(peer_filters.STD, np.float32)  # the true noise
DEVICES = "--xla_force_host_platform_device_count"
# By default XLA splits operations among the threads of all devices.
NO_SPLIT = "--xla_disable_hlo_passes=cpu-parallel-task-assigner"


def with_noise(std: Array, trial: Drive) -> Drive:
    """The trial with other noise.

    Args:
        std: (5,) standard deviations: odometry x, y, heading; range, bearing.
        trial: The trial.
    """
    R = jnp.broadcast_to(jnp.diag(std[3:] ** 2), trial.measurement_cov.shape)
    return trial._replace(odometry_cov=jnp.diag(std[:3] ** 2), measurement_cov=R)


def positions(std: Array, trial: Drive) -> Array:
    """Estimated positions (T, 2) of one trial whose landmarks all have a prior."""
    steps = workload.filter_trial("standard", with_noise(std, trial), has_prior=True)
    return steps.pose[:, :2]


@jax.jit
def filter_drive(drive: Drive) -> Steps:
    """Filter B trials whose landmarks all have a prior, a few together."""
    filter_one = partial(workload.filter_trial, "standard", has_prior=True)
    return map_batches(filter_one, drive, batch_size=BATCH)


@jax.jit
def gradient(std: Array, drive: Drive) -> tuple[Array, Array]:
    """Mean squared position error () of B trials and its derivative (5,) by the noise.

    The derivative of one batch is complete before the next begins, so memory is that of a batch.
    B is a multiple of the batch size.
    """
    count = len(drive.odometry)
    size = min(BATCH, count)

    def batch_gradient(batch: Drive) -> tuple[Array, Array]:
        losses = jax.vmap(partial(peer_filters.loss, positions), in_axes=(None, 0))
        return jax.value_and_grad(lambda std: jnp.sum(losses(std, batch)))(std)

    fold = jax.tree.map(lambda x: x.reshape((-1, size) + x.shape[1:]), drive)
    return jax.tree.map(lambda x: jnp.sum(x, axis=0) / count, lax.map(batch_gradient, fold))


def speed(seed: int, num_trials: int, repeats: int) -> Numbers:
    """Microseconds of filter, gradient and the C program for a step of a trial, taken in turns."""
    drive = workload.as_floats(workload.rings(seed, num_trials))
    calls = {"filter": (filter_drive, drive), "gradient": (gradient, STD, drive)}
    for call in calls.values():
        seconds(*call)  # compiles
    own, c = dict.fromkeys(calls, np.inf), np.inf
    with tempfile.TemporaryDirectory() as folder:
        rival = peer_automata.compile_c(C_SOURCE, Path(folder), "-ffast-math", "-lm")
        for _ in range(2 * repeats):
            if rival.program:
                done = subprocess.run([rival.program], capture_output=True, text=True, check=True)
                c = min(c, float(re.search(r"([\d.]+) us per robot-step", done.stdout)[1]))
            own = {name: min(own[name], seconds(*call)) for name, call in calls.items()}
    us = {name: 1e6 * s / drive.landmark_ids[..., 0].size for name, s in own.items()}
    return {
        "runs": num_trials,
        "steps": drive.landmark_ids.shape[1],
        "together": BATCH,
        "filter_us": us["filter"],
        "gradient_us": us["gradient"],
        "c_us": c if rival.program else None,
        "filter_vs_c": us["filter"] / c if rival.program else None,
        "gradient_vs_filter": us["gradient"] / us["filter"],
        "note": "gcc -O3 -march=native -ffast-math, drives of its own"
        if c < np.inf
        else rival.note,
    }


def latency(seed: int, num_trials: int) -> tuple[Numbers, Episode]:
    """Milliseconds of one step and of one front end, late in a drive; episodes of B drives.

    The step has 64 landmark slots, of which the drive has filled some.
    """
    config = Config()
    world, robot, path, num_scans = drive_in()
    keys = trial_episodes.trial_keys(jax.random.key(seed), np.arange(num_trials))
    episodes = trial_episodes.simulate_drives(
        keys, config.frontend, robot, world, path, num_scans=num_scans
    )
    episode = jax.tree.map(lambda x: x[0], episodes)
    small = config.filter._replace(max_landmarks=64)
    params, belief = NoiseParams.for_simulated_robot(*robot[:2]), init(small, episode.truth[0])
    step, scan_at = jax.jit(slam_filter.step, static_argnums=0), jax.jit(cast, static_argnums=0)
    extract_features = jax.jit(extract.extract_features, static_argnums=0)
    step_seconds, frontend_seconds = [], []
    for k in range(num_scans):
        measurement = Measurement(episode.odometry, episode.features)
        measurement = jax.tree.map(lambda x, k=k: x[k], measurement)
        jax.block_until_ready((measurement, belief))
        if k >= num_scans - CALLS:
            lidar = config.frontend.lidar
            scan = jax.block_until_ready(scan_at(lidar, world, episode.truth[k]))
            seconds(extract_features, config.frontend, scan)  # the first call compiles
            frontend_seconds.append(seconds(extract_features, config.frontend, scan))
            step_seconds.append(seconds(step, small, params, belief, measurement))
        belief, _ = step(small, params, belief, measurement)
    return {
        "step_ms": 1e3 * statistics.median(step_seconds),
        "front_end_ms": 1e3 * statistics.median(frontend_seconds),
        "step_landmarks": int(np.count_nonzero(belief.num_seen)),
    }, episodes


def memory(seed: int, num_trials: int) -> Numbers:
    """Memory of the gradient: of this process, and of XLA's buffers alone."""
    pin()
    until = {"imports": peak_memory()}
    drive = workload.as_floats(workload.rings(seed, num_trials))
    until["workload"] = peak_memory()
    compiled = gradient.lower(STD, drive).compile()
    until["program"] = peak_memory()
    jax.block_until_ready(compiled(STD, drive))
    found = compiled.memory_analysis()
    sizes = found.argument_size_in_bytes, found.output_size_in_bytes, found.temp_size_in_bytes
    return {"peak_mb": peak_memory(), "until_mb": until, "buffers_mb": sum(sizes) / 2**20}


def gradient_memory(cache: str, seed: int, num_trials: int) -> Numbers:
    """Peak memory of a process that compiles the gradient, and of a next one that only runs it.

    All of a process counts: Python and JAX, the draws of the workload, the program.
    """
    arguments = {"seed": seed, "num_trials": num_trials}
    first, then = (run_task("memory", cache, arguments) for _ in range(2))
    if "peak_mb" not in then:
        return {"gradient_peak_mb": None, **then}
    return {
        "gradient_peak_mb": then["peak_mb"],
        "gradient_peak_mb_until": then["until_mb"],
        "gradient_peak_mb_with_compilation": first["peak_mb"],
        "gradient_buffers_mb": then["buffers_mb"],
    }


def sharded(drive: Drive) -> tuple[Any, Drive]:
    """The filter of B trials on all devices, each with a shard of them; and the sharded trials."""
    mesh, spec = Mesh(np.array(jax.devices()), ("trials",)), PartitionSpec("trials")
    own = jax.shard_map(filter_drive, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return jax.jit(own), jax.device_put(drive, NamedSharding(mesh, spec))


def devices(seed: int, num_trials: int, repeats: int, pinned: bool) -> Numbers:
    """Seconds of the filter on all devices of this process, and the last pose of each trial."""
    pin() if pinned else unpin()
    call, drive = sharded(workload.as_floats(workload.rings(seed, num_trials)))
    taken = fastest({"": (call, drive)}, repeats=repeats)[""]
    ends = np.asarray(call(drive).pose)[:, -1]
    return {"devices": jax.device_count(), "seconds": taken, "ends": ends.tolist()}


def two_devices(cache: str, seed: int, num_trials: int, repeats: int) -> Numbers:
    """How many times faster two devices on all cores are than one device on one core.

    Many short calls, of which some find both cores free.
    """
    arguments = {"seed": seed, "num_trials": min(num_trials, 64), "repeats": 10 * repeats}
    taken: dict[int, float] = {1: np.inf, 2: np.inf}
    for count in (1, 2, 1, 2):
        done = run_task("devices", cache, arguments | {"pinned": count == 1}, num_devices=count)
        if "seconds" not in done:
            return {"two_devices_vs_one": None, **done}
        taken[count] = min(taken[count], done["seconds"])
    return {"two_devices_vs_one": taken[1] / taken[2], "devices_s": list(taken.values())}


def largest_distance(a: Array, b: Array) -> float:
    """Largest distance of positions (..., 2 or more)."""
    offset = np.asarray(a, float)[..., :2] - np.asarray(b, float)[..., :2]
    return float(np.max(np.linalg.norm(offset, axis=-1)))


def precision(seed: int, num_trials: int, num_filterpy: int, episodes: str) -> Numbers:
    """Differences of float32, float64 and filterpy, which is float64.

    Args:
        seed: Of the draws.
        num_trials: Of the rings.
        num_filterpy: Trials that filterpy filters too.
        episodes: File with the arrays of the office episodes, whose features both are given.
    """
    pin()
    config, params = Config(), NoiseParams.for_simulated_robot()
    with np.load(episodes) as saved:
        truth, odometry, *features = (saved[name] for name in saved)
    office = Episode(truth, odometry, Features(*features))
    rings = workload.rings(seed, num_trials)
    single = filter_drive(workload.as_floats(rings)).pose
    single_office = filter_episodes(config, params, office)
    single, single_office, params = jax.tree.map(np.asarray, (single, single_office, params))
    jax.config.update("jax_enable_x64", True)
    double = filter_drive(workload.as_floats(rings, np.float64)).pose
    double_office = filter_episodes(config, *jax.tree.map(_as_float64, (params, office)))
    numbers = {
        "max_difference_f32_m": largest_distance(single, double),
        "max_difference_f32_office_m": largest_distance(
            single_office.estimate, double_office.estimate
        ),
        "max_difference_f64_m": None,
        "types": [str(x.dtype) for x in (single, double, double_office.estimate)],
    }
    try:
        theirs = [
            peer_filters.filterpy_positions(
                np.array(peer_filters.STD), Drive(*(x[k] for x in rings))
            )
            for k in range(num_filterpy)
        ]
    except ImportError:
        return numbers
    return numbers | {"max_difference_f64_m": largest_distance(theirs, double[:num_filterpy])}


def _as_float64(x: np.ndarray) -> Array:
    return jnp.asarray(x.astype(float) if np.issubdtype(x.dtype, np.floating) else x)


def others(seed: int) -> Numbers:
    """Figures of other libraries; NumPy's threads, too, are limited to the cores of the process."""
    drive = workload.first_steps(workload.rings(seed, peer_filters.BATCH), 25)
    return peer_filters.table(workload.as_floats(drive))


TASKS = {"memory": memory, "devices": devices, "precision": precision, "others": others}


def run_task(
    task: str,
    cache: str,
    arguments: dict[str, Any],
    *,
    num_devices: int = 1,
    module: str = "experiments.filter_benchmark",
    no_split: bool = False,
) -> Numbers:
    """Figures of a task in a separate process, or a note why there are none.

    Args:
        task: One of `TASKS`.
        cache: Folder for compiled programs.
        arguments: Of the task.
        num_devices: Number of JAX devices there.
        module: Module of the task.
        no_split: Whether XLA leaves operations whole; with several devices it always does.
    """
    flags = [f for f in os.environ.get("XLA_FLAGS", "").split() if not f.startswith(DEVICES)]
    if (no_split or num_devices > 1) and NO_SPLIT not in flags:
        flags.append(NO_SPLIT)
    env = os.environ | {"XLA_FLAGS": " ".join([*flags, f"{DEVICES}={num_devices}"])}
    env |= {"JAX_ENABLE_X64": "0", "JAX_COMPILATION_CACHE_DIR": cache}
    command = [sys.executable, "-m", module, task, json.dumps(arguments)]
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=env, timeout=TIMEOUT, capture_output=True, text=True
        )
    except subprocess.TimeoutExpired:
        return {f"{task}_note": f"it took longer than {TIMEOUT:.0f} s"}
    if done.returncode:
        return {f"{task}_note": f"it failed: {done.stderr.strip()[-200:]}"}
    return json.loads(done.stdout.splitlines()[-1])


def run_named_task(tasks: dict[str, Callable[..., Numbers]], argv: list[str]) -> None:
    """Print the figures of the task and arguments that `run_task` asks for."""
    name, arguments = argv
    print(json.dumps(tasks[name](**json.loads(arguments))))


def compute(seed: int, num_trials: int, repeats: int, office: int) -> Numbers:
    """All figures, on B trials of the rings, and on some of the office drive."""
    numbers = speed(seed, num_trials, repeats)
    of_step, episodes = latency(seed, office)
    with tempfile.TemporaryDirectory() as folder:
        np.savez(file := f"{folder}/episodes.npz", *jax.tree.leaves(episodes))
        numbers |= gradient_memory(folder, seed, num_trials)
        numbers |= two_devices(folder, seed, num_trials, repeats) | of_step
        arguments = {"seed": seed, "num_trials": num_trials, "num_filterpy": 4, "episodes": file}
        numbers |= run_task("precision", folder, arguments)
        return numbers | {"peers": run_task("others", folder, {"seed": seed})}


if __name__ == "__main__":
    run_named_task(TASKS, sys.argv[1:])
