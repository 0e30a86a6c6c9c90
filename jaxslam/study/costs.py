"""What variants of a study cost: the table `cost` of its file, and their own."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxslam.io.errors import InputError
from jaxslam.study.settings import SETTINGS, TEXTS, Settings, number, unknown, value_of


class Given(NamedTuple):
    """A variant of a file.

    Attributes:
        name: Of the variant.
        settings: Those of the base included.
        cost: Its own; None: not given.
    """

    name: str
    settings: Settings
    cost: float | None = None


def costs_of(path: Path, given: Any, variants: Sequence[Given]) -> list[float | None]:
    """Costs of variants: their own, and those of a table; None if there are none.

    Args:
        path: File of the study.
        given: Its table `cost`: `base`, of all variants, and by the names of settings tables of the
            costs of their values; None if there is none.
        variants: In order.

    Raises:
        InputError: The table is not possible, a value of it does not occur, or a variant has none.
    """
    own = [one.cost is not None for one in variants]
    if any(own) and not all(own):
        name = variants[own.index(False)].name
        raise InputError("has no cost, and others have", path=path, field=f"variant {name!r}")
    if given is None:
        return [one.cost for one in variants]
    if not isinstance(given, dict) or not given:
        raise InputError("is no table of costs", path=path, field="cost")
    base = number(path, "cost.base", given.get("base", 0.0), 0.0, math.inf)
    costs = [base + (one.cost or 0.0) for one in variants]
    for name, table in _tables(path, {k: x for k, x in given.items() if k != "base"}).items():
        field, used = f"cost.{name}", [one.settings.get(name) for one in variants]
        for value in table:
            if value not in used:
                problem = f"{value!r} is no value of {name} in this study"
                raise InputError(problem, path=path, field=field)
        for index, value in enumerate(used):
            if value not in table:
                what = f"{name} {value!r}" if value is not None else f"a variant without {name}"
                raise InputError(f"has no cost of {what}", path=path, field=field, advice="add it")
            costs[index] += table[value]
    return [*costs]


def _tables(path: Path, given: dict[str, Any]) -> dict[str, dict[Any, float]]:
    """Costs by value, by the names of settings; `life.KEY` is a table in the table `life`."""
    nested = given.get("life")
    if isinstance(nested, dict) and all(isinstance(x, dict) for x in nested.values()):
        given = {k: x for k, x in given.items() if k != "life"}
        given |= {f"life.{key}": x for key, x in nested.items()}
    found: dict[str, dict[Any, float]] = {}
    for name, table in given.items():
        if name not in SETTINGS:
            raise unknown(path, name, ("base", *SETTINGS), "cost")
        if not isinstance(table, dict):
            raise InputError("is no table of costs by value", path=path, field=f"cost.{name}")
        found[name] = {}
        for key, cost in table.items():
            field, value = f"cost.{name}.{key}", _value(path, name, key)
            if value in found[name]:
                raise InputError(f"is another cost of {value!r}", path=path, field=field)
            found[name][value] = number(path, field, cost, 0.0, math.inf)
    return found


def _value(path: Path, name: str, key: str) -> Any:
    """The value that a key of a table of costs names: a text, or a number with or without unit."""
    if name in TEXTS:
        return key
    try:
        return value_of(path, "cost", name, float(key))
    except ValueError:
        return value_of(path, "cost", name, key)
