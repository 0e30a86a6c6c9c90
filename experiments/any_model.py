"""An EKF of one's own functions: likelihood, time and memory beside dynamax, and tuning by others.

Value and gradient of the log-likelihood of many trials, on one core, after compilation: a pendulum,
and a robot among beacons. Then parameters from a wrong start, by this library, by dynamax with
Adam, kalman-py, Optuna and random search (`pip install '.[bench]' kalman-py`). A library that is
missing is left out. Memory is measured in processes of their own.
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import common, model_tasks
from experiments.model_tasks import MODELS, Task
from experiments.timing import pin

NAME = "any_model"
EXACT_TRIALS = 8  # whose likelihoods are compared in double precision
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def task(name: str, *, seed: int, num_trials: int, num_steps: int) -> Task:
    """Data of one of `MODELS`."""
    return model_tasks.task(MODELS[name], seed=seed, num_trials=num_trials, num_steps=num_steps)


def compiled(own: Task, library: str) -> Any:
    """Value and gradient of all trials, compiled."""
    likelihood = own.own if library == "jaxslam" else own.dynamax()
    batched = jax.jit(jax.vmap(jax.value_and_grad(likelihood), in_axes=(None, 0)))
    return batched.lower(own.params, own.data).compile()


def memory(own: Task, library: str) -> common.Numbers:
    """Bytes that the program plans, and by which its process grows while it runs."""
    call = compiled(own, library)
    planned = call.memory_analysis().temp_size_in_bytes
    if not CLEAR.exists():
        return {"planned": planned, "grown": None}
    before = _status("VmRSS")
    CLEAR.write_text("5")  # the peak counts from here
    jax.block_until_ready(call(own.params, own.data))
    return {"planned": planned, "grown": _status("VmHWM") - before}


def _status(field: str) -> int:
    """A size [bytes] of this process."""
    lines = STATUS.read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(field))


def exact(name: str, seed: int, num_steps: int) -> float:
    """Largest relative difference of the log-likelihoods, in double precision."""
    with jax.enable_x64(True):
        own = task(name, seed=seed, num_trials=EXACT_TRIALS, num_steps=num_steps)
        first, second = (
            jax.jit(jax.vmap(f, (None, 0)))(own.params, own.data) for f in own.likelihoods()
        )
        return float(jnp.max(jnp.abs(first / second - 1)))


def processor_seconds(calls: dict[str, tuple], repeats: int) -> dict[str, float]:
    """Least processor time of each call, taken in turns; other processes disturb it little."""
    taken = dict.fromkeys(calls, np.inf)
    for _ in range(repeats + 1):
        for name, (function, *given) in calls.items():
            begin = time.process_time()
            jax.block_until_ready(function(*given))
            taken[name] = min(taken[name], time.process_time() - begin)
    return taken


def against_dynamax(args: Any, name: str) -> common.Numbers:
    """Ratios to dynamax, below 1 where this library needs less."""
    sizes = {"num_trials": args.trials, "num_steps": args.steps}
    own = task(name, seed=args.seed, **sizes)
    calls = {k: (compiled(own, k), own.params, own.data) for k in ("jaxslam", "dynamax")}
    taken = processor_seconds(calls, args.repeats)
    used = {library: _in_process(args, f"{name} {library}") for library in calls}
    ratio: dict[str, Any] = {"seconds": taken["jaxslam"] / taken["dynamax"]}
    for kind in ("planned", "grown"):
        ours, theirs = used["jaxslam"][kind], used["dynamax"][kind]
        ratio[kind] = ours / theirs if ours is not None and theirs else None
    difference = exact(name, args.seed, args.steps)
    return {"seconds": taken, "bytes": used, "ratio": ratio, "likelihood_difference": difference}


def _in_process(args: Any, worker: str) -> common.Numbers:
    """What `memory` finds in a process of its own."""
    given = {"out": args.out, "seed": args.seed, "trials": args.trials, "steps": args.steps}
    options = [text for key, value in given.items() for text in (f"--{key}", str(value))]
    command = [sys.executable, "-m", "experiments.any_model", *options, "--worker", worker]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def compute(args: Any) -> common.Numbers:
    """All numbers."""
    try:
        speed = {name: against_dynamax(args, name) for name in MODELS}
    except ImportError:
        print("left out: dynamax, which is missing; pip install '.[bench]'")
        speed = {}
    pendulum = task("pendulum", seed=args.seed, num_trials=args.sequences, num_steps=args.steps)
    line = model_tasks.task(
        model_tasks.LINEAR, seed=args.seed, num_trials=1, num_steps=5 * args.steps
    )
    tuned = {
        "pendulum": model_tasks.tuned(pendulum, model_tasks.TUNERS, args.seed, args.updates),
        "linear": model_tasks.tuned(line, model_tasks.LINEAR_TUNERS, args.seed, args.updates),
    }
    sizes = {"trials": args.trials, "steps": args.steps, "sequences": args.sequences}
    return {"seed": args.seed, **sizes, "against_dynamax": speed, "tuned": tuned}


def draw(numbers: common.Numbers, path: Path) -> None:
    """Ratios to dynamax, and the errors of parameters over time of tuning."""
    figure, axes = common.canvas(11, 3.6, 1, 3)
    labels = {"seconds": "time", "planned": "memory, planned", "grown": "memory, process"}
    for k, (name, found) in enumerate(numbers["against_dynamax"].items()):
        values = [found["ratio"][key] or np.nan for key in labels]
        drawn = axes[0, 0].bar(np.arange(3) + 0.4 * k, values, 0.4, label=name)
        axes[0, 0].bar_label(drawn, fmt="%.2f", fontsize="small")
    axes[0, 0].axhline(1 / 3, color=common.BLACK, linewidth=0.8)
    axes[0, 0].set_xticks(np.arange(3) + 0.2, labels.values(), fontsize="small")
    axes[0, 0].set_title(f"value and gradient / dynamax's, {numbers['trials']} trials", fontsize=10)
    axes[0, 0].legend(fontsize="small")
    for axis, (name, rows) in zip(axes[0, 1:], numbers["tuned"].items(), strict=True):
        for row in rows:
            if row["method"] != "truth" and "loss" in row:
                axis.plot(row["seconds"], row["error"], "o", label=row["method"])
        axis.set(xlabel="seconds, with compiling", ylabel="largest |log error|")
        axis.set_title(f"{name}: parameters found", fontsize=10)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.legend(fontsize="x-small")
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the comparison."""
    pin()
    given = {"trials": 512, "steps": 200, "repeats": 10, "sequences": 16, "updates": 40}
    args = common.parse(__doc__, argv, **given, worker="")
    if args.worker:
        name, library = args.worker.split()
        own = task(name, seed=args.seed, num_trials=args.trials, num_steps=args.steps)
        print(json.dumps(memory(own, library)))
        return
    numbers = compute(args)
    common.save(args.out, NAME, numbers, draw)
    for name, found in numbers["against_dynamax"].items():
        ratio = {key: value and round(value, 3) for key, value in found["ratio"].items()}
        print(f"{name}: ratios {ratio}, likelihoods differ by {found['likelihood_difference']:.1e}")
    for name, rows in numbers["tuned"].items():
        for row in rows:
            shown = {k: v if isinstance(v, str | bool) else f"{v:.4g}" for k, v in row.items()}
            print(name, shown)


if __name__ == "__main__":
    main()
