"""An EKF of one's own functions: likelihood, time and memory beside dynamax.

Value and gradient of the log-likelihood of many trials, on one core, after compilation: a pendulum,
and a robot among beacons. Memory is measured in processes of their own. What others find who tune
such models is in `experiments.tuning`.
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
from jaxslam.io.errors import InputError

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


def draw(numbers: common.Numbers, path: Path) -> None:
    """Ratios to dynamax."""
    figure, axes = common.canvas(7, 3.6, 1, 1)
    axis = axes[0, 0]
    labels = {"seconds": "time", "planned": "memory,\nplanned", "grown": "memory,\nby the process"}
    colours = (common.SKY, common.ORANGE)
    found = numbers["against_dynamax"]
    for k, ((name, row), colour) in enumerate(zip(found.items(), colours, strict=False)):
        values = [row["ratio"][key] or np.nan for key in labels]
        drawn = axis.bar(np.arange(3) + 0.4 * k, values, 0.38, label=name, color=colour)
        axis.bar_label(drawn, fmt="%.2f", fontsize="small", padding=2)
    axis.axhline(1 / 3, color=common.BLACK, linewidth=0.8, linestyle="--", label="a third")
    axis.set_xticks(np.arange(3) + 0.2, labels.values())
    axis.margins(y=0.15)
    axis.set(ylabel="jaxslam / dynamax")
    axis.set_title(f"likelihood and its gradient, {numbers['trials']} trials", fontsize=10)
    axis.legend(fontsize="small", loc="upper right", bbox_to_anchor=(1.0, 0.86))
    figure.savefig(path)


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the comparison; returns the exit code, 2 without dynamax, 130 for Ctrl-C."""
    pin()
    args = common.parse(__doc__, argv, trials=512, steps=200, repeats=10, worker="")
    if args.worker:
        name, library = args.worker.split()
        own = task(name, seed=args.seed, num_trials=args.trials, num_steps=args.steps)
        print(json.dumps(memory(own, library)))
        return 0
    try:
        found = {name: against_dynamax(args, name) for name in MODELS}
    except ImportError as error:
        raise InputError("dynamax is missing; pip install '.[bench]'") from error
    numbers = {"seed": args.seed, "trials": args.trials, "steps": args.steps}
    common.save(args.out, NAME, numbers | {"against_dynamax": found}, draw)
    for name, row in found.items():
        ratio = {key: value and round(value, 3) for key, value in row["ratio"].items()}
        print(f"{name}: ratios {ratio}, likelihoods differ by {row['likelihood_difference']:.1e}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
