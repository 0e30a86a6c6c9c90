"""Time that a command takes, and XLA's compiler in it."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from time import perf_counter

import jax
import numpy as np


@contextmanager
def stopwatch() -> Iterator[dict[str, float]]:
    """Measure the block: seconds in XLA's compiler (`compile`) and the rest (`run`)."""
    seconds = {"compile": 0.0, "run": 0.0}
    spans: list[tuple[float, float]] = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if running and event == "/jax/core/compile/backend_compile_duration":
            now = perf_counter()
            spans.append((now - duration_secs, now))

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
