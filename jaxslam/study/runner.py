"""Trials of all variants of a study, on all devices, kept in files so that a stop loses little."""

import hashlib
from collections.abc import Callable, Hashable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxslam.core import trace_cache
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config
from jaxslam.simulation import trials
from jaxslam.simulation.life import Life
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.worlds import World
from jaxslam.study import kept_trials
from jaxslam.study.kept_trials import Collected
from jaxslam.study.outcomes import Outcomes, outcomes_of


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
        life: What may go wrong; None: nothing, and ranges have other numbers than with a life.
        cost: In any currency; None: not known.
        match_scans: Whether odometry is fused with scan matching.
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
    match_scans: bool = False


class Progress(NamedTuple):
    """How far a study is.

    Attributes:
        variant: Number of the variant.
        done: Its trials that are done.
        done_of_all: Trials of all variants that are done.
    """

    variant: int
    done: int
    done_of_all: int


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
    With several processes all must call it; process 0 keeps the files and has the outcomes, the
    others None for each.

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
    timed = run_timed(variants, num_trials=num_trials, seed=seed, folder=folder, callback=callback)
    return [one.record for one in timed]


def run_timed(
    variants: Sequence[Variant],
    *,
    num_trials: int,
    seed: int,
    folder: Path | None = None,
    callback: Callable[[Progress], None] | None = None,
) -> list[Collected]:
    """As `run`; with the outcomes of each variant the seconds and memory that they took.

    Variants of one program run one after the other, since a process keeps only some programs.
    """
    by_program: dict[Hashable, list[int]] = {}
    for number, variant in enumerate(variants):
        by_program.setdefault(program_of(variant), []).append(number)
    found: dict[int, Collected] = {}
    for numbers in by_program.values():
        for number in numbers:
            before = len(found) * num_trials
            found[number] = kept_trials.collect(
                partial(_outcomes, variants[number], seed),
                Outcomes,
                num_trials,
                folder=None if folder is None else folder / f"{number:03d}",
                mark=fingerprint(variants[number], seed),
                warm_up=number == numbers[0],
                callback=None if callback is None else _numbered(callback, number, before),
            )
    return [found[number] for number in range(len(variants))]


def _numbered(
    callback: Callable[[Progress], None], number: int, before: int
) -> Callable[[int], None]:
    return lambda done: callback(Progress(number, done, before + done))


def _outcomes(variant: Variant, seed: int, num_trials: int, first: int) -> Iterator[Outcomes]:
    return map(outcomes_of, results_of(variant, seed, num_trials, first))


def results_of(
    variant: Variant, seed: int, num_trials: int, first: int = 0
) -> Iterator[trials.TrialResult]:
    """Results of trials `first` to N - 1 of a variant, some at a time, on all devices."""
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
        match_scans=variant.match_scans,
        first=first,
    )


def program_of(variant: Variant) -> Hashable:
    """What variants have in common for which the same program is compiled."""
    given = variant.world, variant.path, variant.params, variant.life
    leaves, tree = jax.tree.flatten(given)
    fixed = variant.config, variant.robot, variant.num_scans, variant.match_scans
    return (*fixed, tree, tuple(np.shape(x) for x in leaves))


def in_numpy(variant: Variant) -> Variant:
    """The variant with NumPy arrays, which go to other processes without a device."""
    given = variant.world, variant.path, variant.params, variant.life
    world, path, params, life = jax.tree.map(np.asarray, given)
    return variant._replace(world=world, path=path, params=params, life=life)


def fingerprint(variant: Variant, seed: int) -> str:
    """Text that two variants have in common if their trials are the same; its name does not count.

    Trials of another program are others.
    """
    arrays = jax.tree.leaves((variant.world, variant.path, variant.params, variant.life))
    fixed = variant.config, variant.robot, variant.num_scans, variant.match_scans
    text = hashlib.sha256(repr((fixed, seed, trace_cache.version())).encode())
    for x in arrays:
        array = np.asarray(x)
        text.update(repr(array.shape).encode() + np.asarray(array, np.float64).tobytes())
    return text.hexdigest()[:32]
