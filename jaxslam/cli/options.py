"""Shared by the commands: checks of options, compilation cache, timing."""

import gc
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np

from jaxslam.core import trace_cache
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import noise_file
from jaxslam.io.errors import InputError

GC_THRESHOLD = (
    100_000  # threshold of the garbage collector: net new objects between two collections
)


def check_range(option: str, value: float, low: float, high: float) -> None:
    """Raise InputError unless the value of an option is in [low, high]."""
    if not low <= value <= high:
        raise InputError(f"{value} is not between {low} and {high}", field=option)


@contextmanager
def name_errors(what: str) -> Iterator[None]:
    """Turn a ValueError of the block into an InputError that names the option or file."""
    try:
        yield
    except ValueError as error:
        raise InputError(str(error), field=what) from None


def read_params(path: Path | None, default: NoiseParams) -> NoiseParams:
    """Noise parameters (Q and R) of a file; the default if there is no path."""
    return default if path is None else noise_file.read(path, default)


def enable_caches() -> None:
    """Enable the persistent caches of traced and compiled programs in the user's cache folder.

    A cache folder that JAX is already configured with is kept. Garbage is collected less often from
    here on: otherwise garbage collection takes a quarter of the time in which JAX traces.
    """
    gc.freeze()
    gc.set_threshold(GC_THRESHOLD)
    trace_cache.enable()
    if jax.config.jax_compilation_cache_dir is not None:
        return
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    cache = Path(home) / "jaxslam"
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if os.access(cache, os.W_OK | os.X_OK):
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


@contextmanager
def stopwatch() -> Iterator[dict[str, float]]:
    """Measure the block: seconds in XLA's compiler (`compile`) and the rest (`run`)."""
    seconds = {"compile": 0.0, "run": 0.0}
    spans = []

    def listen(event: str, duration: float, **_: Any) -> None:
        if running and event == "/jax/core/compile/backend_compile_duration":
            now = perf_counter()
            spans.append((now - duration, now))

    jax.monitoring.register_event_duration_secs_listener(listen)
    start, running = perf_counter(), True
    yield seconds
    running = False
    seconds["compile"] = _covered(spans)
    seconds["run"] = perf_counter() - start - seconds["compile"]


def _covered(spans: Iterable[tuple[float, float]]) -> float:
    """Length of the union of intervals (start, stop): programs are compiled in parallel."""
    total, covered_until = 0.0, -np.inf
    for start, stop in sorted(spans):
        total += max(0.0, stop - max(start, covered_until))
        covered_until = max(covered_until, stop)
    return total
