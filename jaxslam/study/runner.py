"""Trials of all variants of a study, on all devices, kept in files so that a stop loses little."""

import hashlib
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils

from jaxslam.core import trace_cache
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io.errors import InputError
from jaxslam.io.output import replace
from jaxslam.pipeline.config import Config
from jaxslam.simulation import trials
from jaxslam.simulation.life import Life
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World
from jaxslam.study.outcomes import Outcomes, concatenate, outcomes_of

TRIALS_PER_FILE = 64


class Variant(NamedTuple):
    """One line of the table of a study: what `simulation.run_trials` is called with.

    Attributes:
        name: Of the variant.
        settings: What is special about it, by the name of the setting.
        config: Of front end and filter.
        params: Q and R that the filter assumes.
        robot: The robot.
        world: Its building.
        path: (N, 2) [m, world] that it drives.
        num_scans: T, scans of a trial.
        life: What may go wrong; None: nothing.
        cost: In any currency; None: not known.
    """

    name: str
    settings: dict[str, Any]
    config: Config
    params: NoiseParams
    robot: Robot
    world: World
    path: np.ndarray
    num_scans: int
    life: Life | None = None
    cost: float | None = None


class Progress(NamedTuple):
    """How far a study is.

    Attributes:
        variant: Number of the variant.
        done: Its trials that are done.
    """

    variant: int
    done: int


def run(
    variants: Sequence[Variant],
    *,
    num_trials: int,
    seed: int,
    folder: Path | None = None,
    callback: Callable[[Progress], None] | None = None,
) -> list[Outcomes]:
    """Run trials 0 to N - 1 of each variant; trial i of all of them has the same random numbers.

    The same call resumes where another was stopped, and its outcomes are the same bit for bit.
    With several processes all must call it; process 0 keeps the files.

    Args:
        variants: Of the study.
        num_trials: N.
        seed: Of all that is random.
        folder: For finished trials; None to keep nothing.
        callback: Called after some trials.

    Returns:
        Outcomes [N] of each variant.

    Raises:
        InputError: The folder cannot be written, or holds trials of something else.
        ValueError: An argument of a variant is not possible.
    """
    found = []
    for number, variant in enumerate(variants):
        own = None if folder is None else folder / f"{number:03d}"
        found.append(_run_variant(number, variant, num_trials, seed, own, callback))
    return found


def _run_variant(
    number: int,
    variant: Variant,
    num_trials: int,
    seed: int,
    folder: Path | None,
    callback: Callable[[Progress], None] | None,
) -> Outcomes:
    leads = jax.process_index() == 0
    mark = fingerprint(variant, seed)
    done = list(_kept(folder, mark)) if leads and folder is not None else []
    first = sum(len(part.finite) for part in done)
    if jax.process_count() > 1:
        first = int(multihost_utils.broadcast_one_to_all(np.int32(first)))
    new: list[Outcomes] = []
    for result in _results(variant, seed, num_trials, first):
        new.append(outcomes_of(result))
        first += len(new[-1].finite)
        if sum(len(one.finite) for one in new) >= TRIALS_PER_FILE or first >= num_trials:
            done.append(concatenate(new))
            new = []
            if leads and folder is not None:
                _keep(folder, first, done[-1], mark)
        if callback is not None:
            callback(Progress(number, first))
    return Outcomes(*(x[:num_trials] for x in concatenate(done)))


def _results(
    variant: Variant, seed: int, num_trials: int, first: int
) -> Iterator[trials.TrialResult]:
    if first >= num_trials:
        return iter(())
    return trials.run_trials(
        jax.random.key(seed),
        variant.config,
        variant.params,
        variant.robot,
        variant.world,
        variant.path,
        num_trials=num_trials,
        num_scans=variant.num_scans,
        life=variant.life,
        first=first,
    )


def fingerprint(variant: Variant, seed: int) -> str:
    """Text that two variants have in common if their trials are the same; its name does not count.

    Trials of another program are others.
    """
    arrays = jax.tree.leaves((variant.world, variant.path, variant.params, variant.life))
    fixed = variant.config, variant.robot, variant.num_scans
    text = hashlib.sha256(repr((fixed, seed, trace_cache.version())).encode())
    for x in arrays:
        array = np.asarray(x)
        text.update(repr(array.shape).encode() + np.asarray(array, np.float64).tobytes())
    return text.hexdigest()[:32]


def _keep(folder: Path, end: int, part: Outcomes, mark: str) -> None:
    """Write the trials before number `end` to a file, which appears whole or not at all."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", path=folder) from None
    with replace(folder / f"{end - len(part.finite):07d}.npz") as file:
        np.savez(file, mark=mark, **part._asdict())


def _kept(folder: Path, mark: str) -> Iterator[Outcomes]:
    """Kept trials, from number 0 without a gap."""
    done = 0
    for file in sorted(folder.glob("*.npz")):
        if file.stem != f"{done:07d}":
            return
        try:
            with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as saved:
                other = str(saved["mark"])
                part = Outcomes(*(saved[name] for name in Outcomes._fields))
                done += len(part.finite)
        except (OSError, KeyError, ValueError, zipfile.BadZipFile):
            raise InputError("is broken", path=file, advice="remove it") from None
        if other != mark:
            problem = "has trials of another variant, seed or version of this program"
            raise InputError(problem, path=file, advice="remove it, or name another folder")
        yield part
