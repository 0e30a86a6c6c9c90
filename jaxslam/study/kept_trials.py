"""Trials in order, finished ones kept in files, so that a stop loses little."""

import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

from jaxslam.core.memory import peak_memory, release_memory
from jaxslam.io.errors import InputError
from jaxslam.io.output import replace
from jaxslam.pipeline.episodes import EPISODE_BATCH

TRIALS_PER_FILE = 64

Record = TypeVar("Record", bound=tuple)
"""A record of arrays that lead with the number of trials."""


class Collected(NamedTuple):
    """All trials of one kind.

    Attributes:
        record: Of them, in order; None where this is not process 0.
        seconds: [s] in which they were computed, without compiling.
        peak_mb: [MB] most memory of this process, of earlier calls too.
    """

    record: Any
    seconds: float
    peak_mb: float


def collect(
    results: Callable[[int, int], Iterator[Record]],
    kind: type[Record],
    num_trials: int,
    *,
    folder: Path | None,
    mark: str,
    warm_up: bool = True,
    callback: Callable[[int], None] | None = None,
) -> Collected:
    """Trials 0 to N - 1; the same call resumes where it was stopped, bit for bit.

    With several processes all must call it; process 0 keeps the files, and has the result.

    Args:
        results: Of trials `first` to `num_trials` - 1, called with `num_trials` and `first`; some
            at a time.
        kind: Of a record of results.
        num_trials: N.
        folder: For finished trials; None to keep nothing.
        mark: Text that is another one for trials of something else.
        warm_up: Whether the first round of trials, of all devices, is computed twice, so that
            compiling is not timed, nor that of what is done with as many results.
        callback: Called with the number of trials that are done.

    Raises:
        InputError: The folder cannot be written, or holds trials of something else.
    """
    leads = jax.process_index() == 0
    folder = folder if leads else None
    done, seconds, peak = _kept(folder, mark, kind)
    first = sum(map(_count, done))
    if jax.process_count() > 1:
        first = int(multihost_utils.broadcast_one_to_all(np.int32(first)))
    if callback is not None:
        callback(min(first, num_trials))
    if warm_up and first < num_trials:
        count = EPISODE_BATCH.on(jax.default_backend()) * jax.device_count()
        next(results(min(first + count, num_trials), first))
        release_memory()
    begin = perf_counter()
    new: list[Record] = []
    for part in results(num_trials, first) if first < num_trials else ():
        first += _count(part)
        if leads:
            new.append(part)
        if new and (sum(map(_count, new)) >= TRIALS_PER_FILE or first == num_trials):
            done.append(_joined(kind, new))
            now, new = perf_counter(), []
            seconds, begin = seconds + now - begin, now
            peak = max(peak, peak_memory())
            if folder is not None:
                _keep(folder, first, done[-1], mark, seconds, peak)
        if callback is not None:
            callback(first)
    whole = kind(*(x[:num_trials] for x in _joined(kind, done))) if leads else None
    return Collected(whole, seconds, max(peak, peak_memory()))


def _count(part: tuple) -> int:
    return len(part[0])


def _joined(kind: type[Record], parts: list[Record]) -> Record:
    if len(parts) == 1:
        return parts[0]
    return kind(*(np.concatenate(x) for x in zip(*parts, strict=True)))


def _keep(folder: Path, end: int, part: Any, mark: str, seconds: float, peak: float) -> None:
    """Write the trials before number `end` to a file, which appears whole or not at all."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", path=folder) from None
    with replace(folder / f"{end - _count(part):07d}.npz") as file:
        np.savez(file, mark=mark, seconds=seconds, peak_mb=peak, **part._asdict())


def _kept(folder: Path | None, mark: str, kind: type[Record]) -> tuple[list[Record], float, float]:
    """Kept trials, from number 0 without a gap; their seconds and most memory [MB]."""
    parts: list[Record] = []
    seconds, peak, done = 0.0, 0.0, 0
    for file in sorted([] if folder is None else folder.glob("*.npz")):
        if file.stem != f"{done:07d}":
            break
        try:
            with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as saved:
                other = str(saved["mark"])
                part = kind(*(saved[name] for name in kind._fields))  # type: ignore[attr-defined]
                seconds, peak = float(saved["seconds"]), float(saved["peak_mb"])
        except (OSError, KeyError, ValueError, zipfile.BadZipFile):
            raise InputError("is broken", path=file, advice="remove it") from None
        if other != mark:
            problem = "has trials of another variant, seed or version of this program"
            raise InputError(problem, path=file, advice="remove it, or name another folder")
        parts.append(part)
        done += _count(part)
    return parts, seconds, peak
