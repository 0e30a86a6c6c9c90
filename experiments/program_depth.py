"""What a compiled program does: operations, the longest chain of them, and their cost.

On a device that is large enough, a program takes as long as its longest chain of operations that
wait for each other, however many there are. All is read from the text of the optimised program,
and a loop counts as often as it turns, once if XLA does not know how often that is.
"""

import re
from collections.abc import Callable, Iterator
from functools import cache
from typing import NamedTuple

import jax
from jax.extend import backend

HEADER = re.compile(r"^(ENTRY )?%?([\w.\-]+) .*\{\s*$")
OPCODE = re.compile(r" ([a-z][\w\-]*)\(")
BODY = re.compile(
    r"(?:body|to_apply|true_computation|false_computation|branch_computations)="
    r"\{?((?:%[\w.\-]+(?:, )?)+)"
)
CALLED = re.compile(r"%([\w.\-]+)")
TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')
FRAME = re.compile(r" ?stack_frame_id=\d+")  # says where in the sources, by a table of the whole
NO_WORK = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast"}
CALLS = {"while", "conditional", "call"}
"""Operations that are those of the computations that they call; all others are one."""


class Operation(NamedTuple):
    """An operation of a computation.

    Attributes:
        name: Its name, unique in the program.
        opcode: What it does.
        operands: Names of what it waits for.
        bodies: Computations that it runs, of `CALLS`: the body of a loop, branches, or a function.
        trips: How often it runs them; None where that is not known.
    """

    name: str
    opcode: str
    operands: tuple[str, ...]
    bodies: tuple[str, ...]
    trips: int | None


class Module(NamedTuple):
    """A compiled program.

    Attributes:
        entry: Name of the computation that it begins with.
        computations: Operations of each computation, in their order, by its name.
        lines: Lines of the text of each.
    """

    entry: str
    computations: dict[str, list[Operation]]
    lines: dict[str, list[str]]


class Cost(NamedTuple):
    """Cost of a program, by XLA's analysis.

    Attributes:
        flops: Operations on numbers.
        bytes: Bytes that are read and written by all operations.
    """

    flops: float
    bytes: float


def parse(text: str) -> Module:
    """The program of a text.

    Args:
        text: Optimised HLO, as of `Compiled.as_text`.
    """
    computations: dict[str, list[Operation]] = {}
    lines: dict[str, list[str]] = {}
    name, entry = "", ""
    for line in text.splitlines():
        begins = HEADER.match(line)
        if begins and " = " not in line.split("{")[0]:
            name = begins[2]
            computations[name], lines[name] = [], []
            entry = name if begins[1] else entry
        elif " = " in line and name:
            computations[name].append(_operation(line))
        if name:
            lines[name].append(FRAME.sub("", line))
        if line.startswith("}"):
            name = ""
    return Module(entry, computations, lines)


def _operation(line: str) -> Operation:
    """The operation of a line, `%name = shape opcode(%operand, ...), attributes`."""
    left, right = line.split(" = ", 1)
    shape_end = _closing(right, 0) if right.startswith("(") else 0
    found = OPCODE.search(right, shape_end)
    if found is None:
        raise ValueError(f"no operation in {line!r}")
    opcode, end = found[1], _closing(right, found.end() - 1)
    operands, attributes = right[found.end() : end], right[end:]
    bodies: list[str] = []
    if opcode in CALLS:
        bodies = [x for names in BODY.findall(attributes) for x in CALLED.findall(names)]
    known = TRIPS.search(attributes)
    trips = (int(known[1]) if known else None) if opcode == "while" else 1
    name = left.split()[-1].lstrip("%")
    return Operation(name, opcode, tuple(CALLED.findall(operands)), tuple(bodies), trips)


def _closing(text: str, begin: int) -> int:
    """Index after the bracket that closes the one at `begin`."""
    level = 0
    for index in range(begin, len(text)):
        level += {"(": 1, ")": -1}.get(text[index], 0)
        if not level:
            return index + 1
    raise ValueError(f"a bracket is not closed in {text!r}")


def executed_operations(module: Module) -> int:
    """Operations that a program begins, of all branches; the test of a loop is not counted."""

    @cache
    def count(name: str) -> int:
        operations = module.computations.get(name, ())
        return sum(
            (each.opcode not in NO_WORK) + (each.trips or 1) * sum(map(count, each.bodies))
            for each in operations
        )

    return count(module.entry)


def depth(module: Module) -> int:
    """Operations of the longest chain of which each waits for the one before.

    A turn of a loop waits for the one before, and of branches the longest counts.
    """

    @cache
    def longest(name: str) -> int:
        ends: dict[str, int] = {}
        for each in module.computations.get(name, ()):  # operands come first
            inside = (each.trips or 1) * max(map(longest, each.bodies), default=0)
            own = inside if each.bodies else int(each.opcode not in NO_WORK)
            ends[each.name] = own + max((ends.get(x, 0) for x in each.operands), default=0)
        return max(ends.values(), default=0)

    return longest(module.entry)


def unknown_loops(module: Module) -> int:
    """Loops of which XLA does not know how often they turn."""
    return sum(
        each.trips is None for operations in module.computations.values() for each in operations
    )


def cost(module: Module) -> Cost | None:
    """Cost of a program with its loops; None where this jaxlib does not analyse parts of one.

    XLA counts the body of a loop once. So the parts of each body are analysed alone, too.
    """
    analyse = _analysis()
    if analyse is None:
        return None

    @cache
    def once(name: str) -> Cost:
        found = analyse(_text(module, name))
        return Cost(found.get("flops", 0.0), found.get("bytes accessed", 0.0))

    def more(name: str) -> Cost:
        """What the loops of a computation add to `once`."""
        total = Cost(0.0, 0.0)
        for each in module.computations.get(name, ()):
            if each.opcode == "while":
                (body,) = each.bodies
                whole, single, turns = more_and_once(body), once(body), each.trips or 1
                added = Cost(*(turns * x - y for x, y in zip(whole, single, strict=True)))
            else:  # of branches the most expensive one counts, as in XLA's analysis
                added = max(map(more, each.bodies), default=Cost(0.0, 0.0))
            total = Cost(*(x + y for x, y in zip(total, added, strict=True)))
        return total

    @cache
    def more_and_once(name: str) -> Cost:
        return Cost(*(x + y for x, y in zip(once(name), more(name), strict=True)))

    return more_and_once(module.entry)


def _text(module: Module, entry: str) -> str:
    """The text of a program that begins with one of the computations."""
    needed = list(_reachable(module, entry))
    parts = ["HloModule part", ""]
    for name in module.lines:
        if name in needed:
            first, *rest = module.lines[name]
            first = first.removeprefix("ENTRY ")
            parts += [f"ENTRY {first}" if name == entry else first, *rest, ""]
    return "\n".join(parts)


def _reachable(module: Module, entry: str) -> Iterator[str]:
    """A computation and all that it names."""
    seen, left = {entry}, [entry]
    while left:
        name = left.pop()
        yield name
        for line in module.lines[name][1:]:
            new = {x for x in CALLED.findall(line) if x in module.lines} - seen
            seen |= new
            left += new


def _analysis() -> Callable[[str], dict[str, float]] | None:
    """XLA's analysis of a text, which jaxlib does not promise to have."""
    try:
        from jaxlib import _hlo, _jax  # type: ignore[attr-defined]

        client = backend.get_backend()
        module_of, analyse = _hlo.hlo_module_from_text, _jax.hlo_module_cost_analysis
    except (ImportError, AttributeError):
        return None
    return lambda text: analyse(client, module_of(text))


def profile(compiled: jax.stages.Compiled) -> dict[str, float | None]:
    """Operations, depth, flops, bytes, and loops of unknown length of a compiled program."""
    module = parse(compiled.as_text())
    found = cost(module)
    return {
        "operations": executed_operations(module),
        "depth": depth(module),
        "flops": found and found.flops,
        "bytes": found and found.bytes,
        "unknown_loops": unknown_loops(module),
    }
