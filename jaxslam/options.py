"""What the commands share: checked options, errors that name them, compiled programs, a clock."""

import gc
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np

from jaxslam import programs
from jaxslam.io import noise as noise_file
from jaxslam.io.errors import InputError
from jaxslam.slam import Noise

GARBAGE = 100_000  # objects that come to be, more than go, before garbage is looked for


def within(option: str, value: float, low: float, high: float) -> None:
    """Raise unless the value of an option is in its range."""
    if not low <= value <= high:
        raise InputError(f"{value} is not between {low} and {high}", field=option)


@contextmanager
def named(what: str) -> Iterator[None]:
    """Turn a ValueError of the block into an InputError that names the option or file."""
    try:
        yield
    except ValueError as error:
        raise InputError(str(error), field=what) from None


def noise_of(path: Path | None, default: Noise) -> Noise:
    """Noise in a file; the default without one."""
    return default if path is None else noise_file.read(path, default)


def keep_compiled() -> None:
    """Keep programs in the user's cache folder, unless JAX was told of another one.

    Garbage is collected less often from here on: while JAX traces, looking for it takes a quarter
    of the time.
    """
    gc.freeze()
    gc.set_threshold(GARBAGE)
    programs.keep()
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
    """Seconds of the block: those of XLA's compiler, and the rest."""
    seconds = {"compile": 0.0, "run": 0.0}
    spans = []

    def listen(event: str, duration: float, **_: Any) -> None:
        if running and event == "/jax/core/compile/backend_compile_duration":
            now = perf_counter()
            spans.append((now - duration, now))

    jax.monitoring.register_event_duration_secs_listener(listen)
    begin, running = perf_counter(), True
    yield seconds
    running = False
    seconds["compile"] = _covered(spans)
    seconds["run"] = perf_counter() - begin - seconds["compile"]


def _covered(spans: Iterable[tuple[float, float]]) -> float:
    """Length of what some of the spans, from and to, cover: programs are compiled side by side."""
    total, end = 0.0, -np.inf
    for start, stop in sorted(spans):
        total += max(0.0, stop - max(start, end))
        end = max(end, stop)
    return total
