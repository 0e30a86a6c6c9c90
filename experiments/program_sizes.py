"""Sizes of the main programs, in equations of their jaxprs: what tracing and compiling cost.

Programs grow unseen: a function that is called in another place, or a loop that Python unrolls,
makes every first call slower. `python -m experiments.program_sizes --out tests/experiments` records
the sizes, which a test compares with those of the sources. Nothing is compiled.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax

from experiments import common
from experiments.programs import PROGRAMS, traced
from jaxslam.io.output import write_json

TOLERANCE = 0.1
"""Share by which a program may differ from its record."""

RECORD = Path(__file__).resolve().parents[1] / "tests" / "experiments" / "program_sizes.json"
COMMAND = "python -m experiments.program_sizes --out tests/experiments"


class Record(NamedTuple):
    """Recorded sizes.

    Attributes:
        jax: Version with which they were counted; others trace to other numbers of equations.
        equations: Number of each program, by its name.
    """

    jax: str
    equations: dict[str, int]


def num_equations(jaxpr: Any) -> int:
    """Number of equations of a jaxpr, with those of the ones inside."""
    inner = (x for eqn in jaxpr.eqns for value in eqn.params.values() for x in _jaxprs(value))
    return len(jaxpr.eqns) + sum(map(num_equations, inner))


def _jaxprs(value: Any) -> Iterator[Any]:
    """The jaxprs in a parameter of an equation."""
    for x in value if isinstance(value, tuple | list) else (value,):
        x = getattr(x, "jaxpr", x)
        if hasattr(x, "eqns"):
            yield x


def size(name: str) -> int:
    """Number of equations of a main program, in JAX's default precision."""
    return num_equations(traced(name).jaxpr.jaxpr)


def read(path: Path = RECORD) -> Record:
    """The recorded sizes."""
    return Record(**json.loads(path.read_text(encoding="utf-8")))


def is_comparable(version: str) -> bool:
    """Whether sizes of a version of JAX are those of this one: major and minor number agree."""
    return version.split(".")[:2] == jax.__version__.split(".")[:2]


def difference(name: str, count: int, recorded: Mapping[str, int]) -> str | None:
    """What is wrong with the size of a program, in a sentence; None within `TOLERANCE`.

    A program that has become smaller is to be recorded, too: otherwise it could grow back unseen.
    """
    if name not in recorded:
        return f"{name} has no recorded number of equations; record it by `{COMMAND}`"
    before = recorded[name]
    if abs(count - before) <= TOLERANCE * before:
        return None
    share = abs(count - before) / before
    changed = f"{name} has {count} equations, {share:.0%} {{}} than the {before} recorded; "
    if count > before:
        return changed.format("more") + f"if that growth is wanted, record it by `{COMMAND}`"
    return changed.format("fewer") + f"record it by `{COMMAND}`, so that it stays small"


def main(argv: list[str] | None = None) -> None:
    """Count, print, and write `program_sizes.json`."""
    args = common.parse(__doc__, argv)
    equations = {name: size(name) for name in PROGRAMS}
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / RECORD.name
    write_json(path, Record(jax.__version__, equations)._asdict())
    for name, count in equations.items():
        print(f"{name:24}{count:8}")
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
