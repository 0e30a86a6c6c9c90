"""Files of studies: a base and what is varied, in TOML, or the same tree in JSON.

    trials = 200               # of each variant
    seed = 0
    success_m = 0.5            # a trial succeeds if its position is never further off

    [base]                     # of all variants
    world = "random:7"         # as of `jaxslam simulate --world`
    drive = "patrol"
    robot = "robot.toml"
    life.people = 5            # or life = "life.toml", as of `jaxslam simulate --life`

    [vary]                     # every combination of these
    scanner = ["LDS-01", "RPLidar A1"]
    life.missing = [0.0, 0.1]

or instead of `[vary]`

    [[variant]]                # one by one
    name = "slow"
    max_speed = 0.3

    [sample]                   # points that fill a box evenly
    method = "sobol"           # or "latin"
    count = 16
    life.missing = [0.0, 0.4]  # from, to

What variants cost, in any currency, is shown beside how often they succeed, if the file has it:

    [cost]
    base = 900                 # of all
    scanner = {"LDS-01" = 60, "RPLidar A1" = 99}

or `cost = 45` in every `[[variant]]`. Numbers may have units ("0.3 m/s", "5 %"). Files are named
relative to the file of the study. `study.settings.SETTINGS` lists what can be set.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import qmc

from jaxslam.io import toml_or_json
from jaxslam.io.errors import InputError
from jaxslam.io.quantities import Table
from jaxslam.study.costs import Given, costs_of
from jaxslam.study.settings import (
    TEXTS,
    WHOLE,
    Settings,
    flattened,
    number,
    settings_of,
    text_of,
    unknown,
    value_of,
)

MAX_VARIANTS = 1000
MAX_TRIALS = 10**6
MAX_SUCCESS = 100.0  # [m]


class StudyFile(NamedTuple):
    """What a file of a study asks for.

    Attributes:
        path: The file.
        num_trials: Of each variant.
        seed: Of all that is random.
        success_distance: [m] a trial succeeds if its position is never further off.
        variants: In order, each with its cost, or all without.
        varied: Names of the settings in which variants differ.
    """

    path: Path
    num_trials: int
    seed: int
    success_distance: float
    variants: tuple[Given, ...]
    varied: tuple[str, ...]


def read(path: str | PathLike) -> StudyFile:
    """Read a study.

    Raises:
        InputError: It cannot be read, holds something else, or asks for what is not possible.
    """
    path = Path(path)
    advice = "see jaxslam.study.study_file"
    given = toml_or_json.read(path, advice)
    if not given:
        raise InputError("asks for nothing", path=path, advice=advice)
    known = ("trials", "seed", "success_m", "base", "cost", "vary", "variant", "sample")
    for key in given:
        if key not in known:
            raise unknown(path, key, known)
    base = settings_of(path, "base", given.get("base", {}))
    kinds = [key for key in ("vary", "variant", "sample") if key in given]
    if len(kinds) > 1:
        problem = f"and {kinds[1]} are both there"
        raise InputError(problem, path=path, field=kinds[0], advice="write one of them")
    trials = number(path, "trials", given.get("trials", 100), 1, MAX_TRIALS, whole=True)
    seed = number(path, "seed", given.get("seed", 0), 0, 2**32 - 1, whole=True)
    success = number(path, "success_m", given.get("success_m", 0.5), 1e-6, MAX_SUCCESS)
    make: Callable[..., list[Given]]
    make = (
        {"vary": _combinations, "variant": _listed, "sample": _sampled}[kinds[0]] if kinds else _one
    )
    variants = make(path, given[kinds[0]] if kinds else None, base, int(seed))
    _check_distinct(path, variants)
    costs = costs_of(path, given.get("cost"), variants)
    variants = [one._replace(cost=cost) for one, cost in zip(variants, costs, strict=True)]
    names = list(dict.fromkeys(name for one in variants for name in one.settings))
    first = variants[0].settings
    varied = [n for n in names if any(one.settings.get(n) != first.get(n) for one in variants)]
    return StudyFile(path, int(trials), int(seed), success, tuple(variants), tuple(varied))


def _one(path: Path, given: Any, base: Settings, seed: int) -> list[Given]:
    return [Given("base", base)]


def _combinations(path: Path, given: Any, base: Settings, seed: int) -> list[Given]:
    """Every combination of the values of some settings."""
    values = _lists(path, "vary", given)
    checked = {name: [value_of(path, "vary", name, x) for x in own] for name, own in values.items()}
    count = math.prod(len(own) for own in checked.values())
    if count > MAX_VARIANTS:
        raise InputError(f"asks for {count} variants, more than {MAX_VARIANTS}", path=path)
    found = []
    for chosen in itertools.product(*checked.values()):
        own = dict(zip(checked, chosen, strict=True))
        name = ", ".join(text_of(name, x) for name, x in own.items())
        found.append(Given(name, base | own))
    return found


def _listed(path: Path, given: Any, base: Settings, seed: int) -> list[Given]:
    """Variants one by one."""
    if not isinstance(given, list) or not given or not all(isinstance(x, dict) for x in given):
        raise InputError("is no [[variant]]", path=path, field="variant")
    found = []
    for index, one in enumerate(given):
        field = f"variant {index + 1}"
        name = Table(path, field, one).text("name")
        rest = {k: x for k, x in one.items() if k not in ("name", "cost")}
        own, cost = settings_of(path, field, rest), one.get("cost")
        if cost is not None:
            cost = number(path, f"{field}.cost", cost, 0.0, math.inf)
        text = ", ".join(text_of(k, x) for k, x in own.items())
        found.append(Given(name or text or "base", base | own, cost))
    return found


def _sampled(path: Path, given: Any, base: Settings, seed: int) -> list[Given]:
    """Points of a box, by Sobol's sequence or as a Latin hypercube."""
    if not isinstance(given, dict):
        raise InputError("is no table", path=path, field="sample")
    rest = {key: x for key, x in given.items() if key not in ("method", "count")}
    method = given.get("method", "sobol")
    if method not in ("sobol", "latin"):
        raise InputError(f"is {method!r}, not sobol or latin", path=path, field="sample.method")
    count = int(number(path, "sample.count", given.get("count", 16), 1, MAX_VARIANTS, whole=True))
    limits, checked = _lists(path, "sample", rest), {}
    for name, pair in limits.items():
        field = f"sample.{name}"
        if name in TEXTS or len(pair) != 2:
            raise InputError("is not [from, to] of a number", path=path, field=field)
        checked[name] = [value_of(path, "sample", name, x) for x in pair]
        if not checked[name][0] < checked[name][1]:
            low, high = checked[name]
            raise InputError(f"goes from {low} to {high}", path=path, field=field)
    low, high = (np.array([float(pair[k]) for pair in checked.values()]) for k in (0, 1))
    sampler = qmc.Sobol if method == "sobol" else qmc.LatinHypercube
    engine = sampler(len(checked), seed=seed)
    if method == "sobol":  # the first points of a power of two fill the box evenly
        points = engine.random_base2(math.ceil(math.log2(count)))[:count]
    else:
        points = engine.random(count)
    found = []
    for index, point in enumerate(low + (high - low) * points):
        own = {k: round(x) if k in WHOLE else float(x) for k, x in zip(checked, point, strict=True)}
        found.append(Given(f"{index}", base | own))
    return found


def _lists(path: Path, field: str, given: Any) -> dict[str, list]:
    """Lists of values by the names of settings; there is one at least, and none is empty."""
    found = flattened(path, field, given)
    if not found:
        raise InputError("is empty", path=path, field=field, advice="name a setting and its values")
    for name, values in found.items():
        if not isinstance(values, list) or not values:
            raise InputError("is no list of values", path=path, field=f"{field}.{name}")
    return found


def _check_distinct(path: Path, variants: Sequence[Given]) -> None:
    """Raise InputError if two variants are the same, or have the same name."""
    seen: dict[str, str] = {}
    names: set[str] = set()
    for name, own, _ in variants:
        key = repr(sorted(own.items()))
        if key in seen:
            raise same_variants(path, seen[key], name)
        if name in names:
            raise InputError(f"two are called {name!r}", path=path, field="variants")
        seen[key] = name
        names.add(name)


def same_variants(path: Path, first: str, second: str) -> InputError:
    """The error of two variants that are the same."""
    problem = f"{first!r} and {second!r} are the same"
    return InputError(problem, path=path, field="variants", advice="remove one of them")
