"""What is wrong with the arguments of a command, in one line."""

import difflib
import inspect
import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import tyro

from jaxslam.io.errors import InputError

(_POSITIONAL,) = get_args(tyro.conf.Positional[int])[1:]
_OPTION = re.compile(r"--?[a-zA-Z]")  # unlike negative numbers
_WORDS = {int: "whole number", float: "number"}


class Argument(NamedTuple):
    """An argument of a command.

    Attributes:
        name: `--option`, or the word that stands for a positional argument.
        values: What its values look like, in words of the help.
        types: Type of each of its values, or choices; one that stands for all if there are several.
        several: Whether it takes any number of values.
        required: Whether it has to be given.
    """

    name: str
    values: str
    types: tuple[Any, ...]
    several: bool
    required: bool


def arguments_of(function: Callable[..., Any]) -> list[Argument]:
    """The arguments of a command, from the signature of its function."""
    return list(_arguments(function))


def explain(
    command: str, function: Callable[..., Any], given: Sequence[str], said: str
) -> InputError:
    """The error of arguments that were refused.

    Args:
        command: Name of the command.
        function: The command.
        given: Its arguments.
        said: What the parser said of them, for what is not known here.
    """
    known = arguments_of(function)
    options = {a.name: a for a in known if a.name.startswith("-")}
    places = [a for a in known if a.name not in options]
    free, seen = [], set()
    token = list(given)
    while token:
        word = token.pop(0)
        if not _OPTION.match(word):
            free.append(word)
            continue
        name, equals, value = word.partition("=")
        name = name.replace("_", "-")
        if name not in options:
            near = difflib.get_close_matches(name.lstrip("-"), [o[2:] for o in options], 1)
            advice = f"did you mean --{near[0]}?" if near else f"see `jaxslam {command} --help`"
            return InputError(f"is no option of `jaxslam {command}`", field=name, advice=advice)
        option = options[name]
        count = next((k for k, text in enumerate(token) if _OPTION.match(text)), len(token))
        most = count if option.several else min(count, len(option.types))
        values, token = ([value], token) if equals else (token[:most], token[most:])
        wrong = _wrong_values(option, values)
        if wrong:
            return InputError(wrong, field=name, advice=f"write {name} {option.values}".rstrip())
        seen.add(name)
    usage = [a.name if a in places else f"{a.name} {a.values}" for a in known if a.required]
    advice = f"write `{' '.join(['jaxslam', command, *usage])}` and then options"
    missing = [a.name for a in places[len(free) :] if a.required]
    missing += [a.name for a in options.values() if a.required and a.name not in seen]
    if missing:
        problem = "is missing" if len(missing) == 1 else "are missing"
        return InputError(problem, field=", ".join(missing), advice=advice)
    if len(free) > len(places) and not any(a.several for a in places):
        return InputError("is one argument too many", field=free[len(places)], advice=advice)
    return InputError(first_paragraph(said), advice=f"see `jaxslam {command} --help`")


def unknown_command(word: str, commands: Sequence[str]) -> InputError:
    """The error of a word that is no command."""
    near = difflib.get_close_matches(word, commands, 1)
    advice = f"did you mean {near[0]}?" if near else f"the commands are {', '.join(commands)}"
    return InputError("is no command", field=word, advice=advice)


def first_paragraph(said: str) -> str:
    """The first paragraph of what a parser printed in a box, on one line, without the title."""
    lines = said.splitlines()
    bare = [re.sub(r"[\u2500-\u257f|+]|-{3,}", "", line).strip() for line in lines[1:]]
    words = " ".join(itertools.takewhile(bool, itertools.dropwhile(lambda line: not line, bare)))
    return words or "wrong arguments"


def _wrong_values(option: Argument, values: Sequence[str]) -> str:
    """What is wrong with the values of an option, empty for nothing."""
    if not values and option.types and not option.several:
        return "has no value"
    if not option.several and len(values) != len(option.types):
        return f"has {len(values)} value{'s'[: len(values) != 1]}, not {len(option.types)}"
    types = len(values) * option.types if option.several else option.types
    for value, kind in zip(values, types, strict=True):
        if isinstance(kind, tuple) and value not in kind:
            return f"{value!r:.40} is none of {', '.join(kind)}"
        if kind in _WORDS:
            try:
                kind(value)
            except ValueError:
                return f"{value!r:.40} is no {_WORDS[kind]}"
    return ""


def _arguments(function: Callable[..., Any]) -> Iterator[Argument]:
    """The arguments of a function, those of records among them under their own names."""
    hints = get_type_hints(function, include_extras=True)
    for key, parameter in inspect.signature(function).parameters.items():
        kind, about = hints[key], []
        while get_origin(kind) is Annotated:
            kind, *more = get_args(kind)
            about += more
        if hasattr(kind, "_fields"):
            yield from _arguments(kind)
            continue
        name = next((a.name for a in about if getattr(a, "name", None)), key).replace("_", "-")
        metavar = next((a.metavar for a in about if getattr(a, "metavar", None)), None)
        is_required = parameter.default is inspect.Parameter.empty
        if kind is bool:
            yield from (Argument(f"--{no}{name}", "", (), False, False) for no in ("", "no-"))
            continue
        types, several = _types(kind)
        values = metavar or " ".join(_in_words(t) for t in types)
        place = _POSITIONAL in about
        yield Argument(str(metavar) if place else f"--{name}", values, types, several, is_required)


def _types(kind: Any) -> tuple[tuple[Any, ...], bool]:
    """Types of the values of an annotation, choices as tuples; whether there may be several."""
    if get_origin(kind) in (Union, UnionType):
        (kind,) = (part for part in get_args(kind) if part is not NoneType)
    if get_origin(kind) is Literal:
        return (get_args(kind),), False
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        return (parts[:1], True) if parts[-1] is Ellipsis else (parts, False)
    return (kind,), False


def _in_words(kind: Any) -> str:
    """A value of a type, or of some choices, as in a line of help."""
    if isinstance(kind, tuple):
        return "|".join(kind)
    return {Path: "FILE", str: "NAME", int: "N", float: "NUMBER"}.get(kind, "VALUE")
