"""Speed, memory and accuracy of the filter and of its gradient, beside C and other libraries.

The filter runs on `workload.rings`: 32 landmarks, all known beforehand to half a metre, the
nearest 8 seen, told apart. What needs another number of cores, its own memory or float64 runs in a
process of its own: `python -m experiments.estimator TASK ARGUMENTS`, which prints its figures. The
C program is a yardstick that is no part of the project; its figures are null where it or a compiler
is not there.
"""

import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from experiments import filters, peers, workload
from experiments.common import Numbers, scene
from experiments.one_core import least, pin, seconds, unpin
from experiments.workload import TOGETHER, Drive, Steps
from jaxslam.core.batching import map_batches
from jaxslam.core.episode import Episode
from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import Array
from jaxslam.filtering import slam_filter
from jaxslam.filtering.config import init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import extract
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import trials
from jaxslam.simulation.ray_casting import cast

YARDSTICK = peers.YARDSTICK.with_name("ekf_limit.c")
ROOT = Path(__file__).resolve().parents[1]
LIMIT = 240.0  # [s] for a process of its own
CALLS = 60  # steps and scans of which latency is the median
STD = np.array(filters.STD, np.float32)  # the true noise
DEVICES = "--xla_force_host_platform_device_count"
# XLA splits operations among the threads of all devices, which each is to leave to the others.
WHOLE = "--xla_disable_hlo_passes=cpu-parallel-task-assigner"


def assumed(std: Array, run: Drive) -> Drive:
    """The run, with noise of standard deviations (5,): odometry x, y, heading; range, bearing."""
    r = jnp.broadcast_to(jnp.diag(std[3:] ** 2), run.r.shape)
    return run._replace(odometry_cov=jnp.diag(std[:3] ** 2), measurement_cov=r)


def track(std: Array, run: Drive) -> Array:
    """Positions (T, 2) of one run whose landmarks are all known."""
    return workload.filter_one("standard", assumed(std, run), grows=False).last_pose[:, :2]


@jax.jit
def filtered(drive: Drive) -> Steps:
    """Filter B runs whose landmarks are all known, a few together."""
    one = partial(workload.filter_one, "standard", grows=False)
    return map_batches(one, drive, batch_size=TOGETHER)


@jax.jit
def gradient(std: Array, drive: Drive) -> tuple[Array, Array]:
    """Mean squared position error () of B runs and its derivative (5,) by the noise.

    The derivative of a few runs is complete before the next are looked at, so that memory is that
    of a few. B is a multiple of these few.
    """
    count = len(drive.motion)
    size = min(TOGETHER, count)

    def part(some: Drive) -> tuple[Array, Array]:
        own = jax.vmap(partial(filters.loss, track), in_axes=(None, 0))
        return jax.value_and_grad(lambda std: jnp.sum(own(std, some)))(std)

    fold = jax.tree.map(lambda x: x.reshape((-1, size) + x.shape[1:]), drive)
    return jax.tree.map(lambda x: jnp.sum(x, axis=0) / count, lax.map(part, fold))


def speed(seed: int, runs: int, repeats: int) -> Numbers:
    """Microseconds a robot-step of filter, gradient and the C program, taken in turns."""
    drive = workload.as_floats(workload.rings(seed, runs))
    calls = {"filter": (filtered, drive), "gradient": (gradient, STD, drive)}
    for call in calls.values():
        seconds(*call)  # compiles
    own, c = dict.fromkeys(calls, np.inf), np.inf
    with tempfile.TemporaryDirectory() as folder:
        rival = peers.compiled(YARDSTICK, Path(folder), "-ffast-math", "-lm")
        for _ in range(2 * repeats):
            if rival.program:
                told = subprocess.run([rival.program], capture_output=True, text=True, check=True)
                c = min(c, float(re.search(r"([\d.]+) us per robot-step", told.stdout)[1]))
            own = {name: min(own[name], seconds(*call)) for name, call in calls.items()}
    us = {name: 1e6 * s / drive.who[..., 0].size for name, s in own.items()}
    return {
        "runs": runs,
        "steps": drive.who.shape[1],
        "together": TOGETHER,
        "filter_us": us["filter"],
        "gradient_us": us["gradient"],
        "c_us": c if rival.program else None,
        "filter_vs_c": us["filter"] / c if rival.program else None,
        "gradient_vs_filter": us["gradient"] / us["filter"],
        "note": "gcc -O3 -march=native -ffast-math, drives of its own"
        if c < np.inf
        else rival.note,
    }


def latency(seed: int, runs: int) -> tuple[Numbers, Episode]:
    """Milliseconds of one step and of one front end at a time, late in a drive; logs of B drives.

    The step has 64 slots for landmarks, whatever of them the drive has filled so far.
    """
    config = Config()
    place, robot, path, steps = scene()
    keys = trials.trial_keys(jax.random.key(seed), np.arange(runs))
    logs = trials.simulate_keys(keys, config, robot, place, path, num_scans=steps)
    log = jax.tree.map(lambda x: x[0], logs)
    small = config._replace(
        filter=config.filter._replace(
            max_landmarks=64,
        ),
    )
    known, belief = NoiseParams.for_simulated_robot(*robot), init(small.filter, log.truth[0])
    step, see = jax.jit(slam_filter.step, static_argnums=0), jax.jit(cast, static_argnums=2)
    look = jax.jit(extract.extract_features, static_argnums=0)
    first, of_step, of_look = steps - CALLS, [], []
    for k in range(steps):
        now = jax.tree.map(lambda x, k=k: x[k], Measurement(log.odometry, log.features))
        jax.block_until_ready((now, belief))
        if k >= first:
            scan = jax.block_until_ready(see(place, log.truth[k], config.frontend.lidar))
            seconds(look, config, scan)  # the first call compiles
            of_look.append(seconds(look, config, scan))
            of_step.append(seconds(step, small, known, belief, now))
        belief, _ = step(small, known, belief, now)
    return {
        "step_ms": 1e3 * statistics.median(of_step),
        "front_end_ms": 1e3 * statistics.median(of_look),
        "step_landmarks": int(np.count_nonzero(belief.num_seen)),
    }, logs


def peak() -> float:
    """Most memory [MB] that this process has held, of which `resource` also tells its parent's."""
    status = Path("/proc/self/status")
    if status.is_file():
        return int(re.search(r"VmHWM:\s+(\d+)", status.read_text())[1]) / 1024
    import resource

    unit = 2**20 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def memory(seed: int, runs: int) -> Numbers:
    """Memory of the gradient: of this process, and of XLA's buffers alone."""
    pin()
    told = {"imports": peak()}
    drive = workload.as_floats(workload.rings(seed, runs))
    told["workload"] = peak()
    compiled = gradient.lower(STD, drive).compile()
    told["program"] = peak()
    jax.block_until_ready(compiled(STD, drive))
    of = compiled.memory_analysis()
    parts = of.argument_size_in_bytes, of.output_size_in_bytes, of.temp_size_in_bytes
    return {"peak_mb": peak(), "until_mb": told, "buffers_mb": sum(parts) / 2**20}


def gradient_memory(kept: str, seed: int, runs: int) -> Numbers:
    """Peak memory of a process that compiles the gradient, and of a next one that only runs it.

    All of a process counts: Python and JAX, the draws of the workload, the program.
    """
    first, then = (apart("memory", kept, seed=seed, runs=runs) for _ in range(2))
    if "peak_mb" not in then:
        return {"gradient_peak_mb": None, **then}
    return {
        "gradient_peak_mb": then["peak_mb"],
        "gradient_peak_mb_until": then["until_mb"],
        "gradient_peak_mb_with_compilation": first["peak_mb"],
        "gradient_buffers_mb": then["buffers_mb"],
    }


def sharded(drive: Drive) -> tuple[Any, Drive]:
    """The filter of B runs on all devices, each a share of them; and the runs, shared out."""
    mesh, runs = Mesh(np.array(jax.devices()), ("runs",)), PartitionSpec("runs")
    own = jax.shard_map(filtered, mesh=mesh, in_specs=runs, out_specs=runs, check_vma=False)
    return jax.jit(own), jax.device_put(drive, NamedSharding(mesh, runs))


def devices(seed: int, runs: int, repeats: int, pinned: bool) -> Numbers:
    """Seconds of the filter on all devices of this process, and where the first run ends."""
    pin() if pinned else unpin()
    call, drive = sharded(workload.as_floats(workload.rings(seed, runs)))
    taken = least({"": (call, drive)}, repeats=repeats)[""]
    ends = np.asarray(call(drive).last_pose)[:, -1]
    return {"devices": jax.device_count(), "seconds": taken, "ends": ends.tolist()}


def two_devices(kept: str, seed: int, runs: int, repeats: int) -> Numbers:
    """How many times faster two devices on all cores are than one device on one core.

    Many short calls, of which some find both cores free.
    """
    arguments = {"seed": seed, "runs": min(runs, 64), "repeats": 10 * repeats}
    taken: dict[int, float] = {1: np.inf, 2: np.inf}
    for count in (1, 2, 1, 2):
        done = apart("devices", kept, devices=count, pinned=count == 1, **arguments)
        if "seconds" not in done:
            return {"two_devices_vs_one": None, **done}
        taken[count] = min(taken[count], done["seconds"])
    return {"two_devices_vs_one": taken[1] / taken[2], "devices_s": list(taken.values())}


def farthest(a: Array, b: Array) -> float:
    """Largest distance of positions (..., 2 or more)."""
    off = np.asarray(a, float)[..., :2] - np.asarray(b, float)[..., :2]
    return float(np.max(np.linalg.norm(off, axis=-1)))


def precision(seed: int, runs: int, beside: int, logs: str) -> Numbers:
    """Differences of float32, float64 and filterpy, which is float64.

    Args:
        seed: Of the draws.
        runs: Of the rings.
        beside: Runs on which filterpy is asked too.
        logs: File with the arrays of the office's logs, whose features both are given.
    """
    pin()
    config, known = Config(), NoiseParams.for_simulated_robot()
    with np.load(logs) as kept:
        truth, motion, *nodes = (kept[name] for name in kept)
    logs = Episode(truth, motion, Features(*nodes))
    rings = workload.rings(seed, runs)
    single = filtered(workload.as_floats(rings)).last_pose
    single_office = episodes.filter_episodes(config, known, logs)
    single, single_office, known = jax.tree.map(np.asarray, (single, single_office, known))
    jax.config.update("jax_enable_x64", True)
    double = filtered(workload.as_floats(rings, np.float64)).last_pose
    wide = lambda x: jnp.asarray(x.astype(float) if np.issubdtype(x.dtype, np.floating) else x)
    double_office = episodes.filter_episodes(config, *jax.tree.map(wide, (known, logs)))
    told = {
        "max_difference_f32_m": farthest(single, double),
        "max_difference_f32_office_m": farthest(single_office.estimate, double_office.estimate),
        "max_difference_f64_m": None,
        "types": [str(x.dtype) for x in (single, double, double_office.estimate)],
    }
    try:
        theirs = [
            filters.filterpy_track(np.array(filters.STD), Drive(*(x[k] for x in rings)))
            for k in range(beside)
        ]
    except ImportError:
        return told
    return told | {"max_difference_f64_m": farthest(theirs, double[:beside])}


def others(seed: int) -> Numbers:
    """Figures of other libraries; NumPy's threads, too, are to be as many as there are cores."""
    some = workload.rings(seed, filters.BATCH)
    short = {k: getattr(some, k)[:, :25] for k in ("truth", "motion", "polar", "who", "r")}
    return filters.table(workload.as_floats(some._replace(**short)))


TASKS = {"memory": memory, "devices": devices, "precision": precision, "others": others}


def apart(
    task: str,
    kept: str,
    *,
    devices: int = 1,
    module: str = "experiments.estimator",
    whole: bool = False,
    **arguments: Any,
) -> Numbers:
    """Figures of a task in a process of its own, or a note why there are none.

    Args:
        task: One of `TASKS`.
        kept: Folder for what is compiled.
        devices: That JAX is to see there.
        module: That has the task.
        whole: Whether operations stay whole; several devices always leave them so.
        arguments: Of the task.
    """
    flags = [f for f in os.environ.get("XLA_FLAGS", "").split() if not f.startswith(DEVICES)]
    if (whole or devices > 1) and WHOLE not in flags:
        flags.append(WHOLE)
    own = os.environ | {"XLA_FLAGS": " ".join([*flags, f"{DEVICES}={devices}"])}
    own |= {"JAX_ENABLE_X64": "0", "JAX_COMPILATION_CACHE_DIR": kept}
    command = [sys.executable, "-m", module, task, json.dumps(arguments)]
    run = partial(subprocess.run, cwd=ROOT, capture_output=True, text=True)
    try:
        done = run(command, env=own, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return {f"{task}_note": f"it took longer than {LIMIT:.0f} s"}
    if done.returncode:
        return {f"{task}_note": f"it failed: {done.stderr.strip()[-200:]}"}
    return json.loads(done.stdout.splitlines()[-1])


def compute(seed: int, runs: int, repeats: int, office: int) -> Numbers:
    """All figures, on B runs of the rings, and on some of the office drive."""
    numbers = speed(seed, runs, repeats)
    of_step, logs = latency(seed, office)
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "logs.npz")
        np.savez(file, *jax.tree.leaves(logs))
        numbers |= gradient_memory(folder, seed, runs) | two_devices(folder, seed, runs, repeats)
        numbers |= of_step | apart("precision", folder, seed=seed, runs=runs, beside=4, logs=file)
        return numbers | {"peers": apart("others", folder, seed=seed)}


if __name__ == "__main__":
    print(json.dumps(TASKS[sys.argv[1]](**json.loads(sys.argv[2]))))
