"""Timing of calls, on one core."""

import gc
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax

from jaxslam.core import quick_compilation

THREADS = Path("/proc/self/task")


def pin() -> None:
    """Keep this process on one core, where the system can; call it before JAX starts."""
    if hasattr(os, "sched_getaffinity"):
        _set_affinity({min(os.sched_getaffinity(0))})


def unpin() -> None:
    """Let this process use all cores again, whatever its parent has set."""
    _set_affinity(set(range(os.cpu_count() or 1)))


def _set_affinity(cores: set[int]) -> None:
    if hasattr(os, "sched_setaffinity") and THREADS.is_dir():
        for thread in THREADS.iterdir():
            os.sched_setaffinity(int(thread.name), cores)


@contextmanager
def as_long_work() -> Iterator[None]:
    """Compile for speed whatever is called here, though it is short (`quick_compilation`)."""
    kept, quick_compilation.SHORT_WORK = quick_compilation.SHORT_WORK, 0
    try:
        yield
    finally:
        quick_compilation.SHORT_WORK = kept


def seconds(function: Callable, *arguments: Any) -> float:
    """Seconds of one call, until its result is complete."""
    begin = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - begin


def fastest(calls: Mapping[str, tuple], *, repeats: int, burst: float = 0.02) -> dict[str, float]:
    """Least seconds of each call, taken in turns so that machine load affects all alike.

    Args:
        calls: Function and arguments of each, by name. Compilation is not counted.
        repeats: Rounds.
        burst: Seconds for which short calls are repeated in each round.
    """
    once = {}
    for name, call in calls.items():
        seconds(*call)  # compiles
        once[name] = seconds(*call)
    gc.collect()
    for _ in range(repeats):
        for name, call in calls.items():
            for _ in range(max(1, min(100, int(burst / once[name])))):
                once[name] = min(once[name], seconds(*call))
    return once
