"""The command line: `jaxslam simulate`, `run`, `localise`, `map`, `route`, `tune` and `study`."""

import contextlib
import functools
import inspect
import io
import re
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import tyro

import jaxslam
from jaxslam.cli import deprecated, usage
from jaxslam.io.errors import InputError

ABOUT = """Topological SLAM for a robot with a 2-D laser scanner.
`jaxslam COMMAND --help` lists the options of a command, `jaxslam --version` prints the version."""

COMMANDS = {
    "simulate": "simulate_command.simulate",
    "run": "run_command.run",
    "localise": "localise_command.localise_in_map",
    "map": "map_command.map_occupancy",
    "route": "route_command.plan_route",
    "tune": "tune_command.tune",
    "study": "study_command.study",
}
"""Module and function of each command."""


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 2 for bad input or usage, 130 for Ctrl-C.

    `run --strict` returns 3 if the map contradicts itself.

    Args:
        argv: Arguments; by default those of the process, and `--help` if there are none.

    Raises:
        SystemExit: Of code 0, after `--help`.
    """
    argv = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if argv[0] == "--version":
        print(f"jaxslam {jaxslam.__version__}")
        return 0
    command, *options = deprecated.rewrite(argv)
    try:
        if command in COMMANDS:
            return _parsed(command, options)() or 0
        if command not in ("--help", "-h"):
            raise usage.unknown_command(command, list(COMMANDS))
        _help()
    except InputError as error:
        print(f"jaxslam: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        print(f"jaxslam: {str(interrupt) or 'interrupted, nothing written'}", file=sys.stderr)
        return 130
    return 0


def function_of(command: str) -> Callable[..., Any]:
    """The function of a command, imported here, so that a command imports only what it needs."""
    module, _, name = COMMANDS[command].partition(".")
    function: Callable[..., Any] = getattr(import_module(f"jaxslam.cli.{module}"), name)
    return function


def _parsed(command: str, options: Sequence[str]) -> Callable[[], int | None]:
    """A command with its options; raise InputError if they are wrong."""
    function = function_of(command)
    function.__doc__ = _unwrapped(function.__doc__ or "")

    @functools.wraps(function)
    def bind(*args: Any, **kwargs: Any) -> Callable[[], int | None]:
        return functools.partial(function, *args, **kwargs)

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            call: Callable[[], int | None] = tyro.cli(bind, prog=f"jaxslam {command}", args=options)
            return call
    except SystemExit as stop:
        if not stop.code:
            raise
    raise usage.explain(command, function, options, said.getvalue())


def _help() -> None:
    """Print the help of all commands and exit."""

    def summary(function: Callable[..., Any]) -> Callable[[], None]:
        def stub() -> None: ...

        stub.__doc__ = (function.__doc__ or "").splitlines()[0]
        return stub

    commands = {command: summary(function_of(command)) for command in COMMANDS}
    tyro.extras.subcommand_cli_from_dict(
        commands, prog="jaxslam", description=ABOUT, args=["--help"]
    )


def _unwrapped(docstring: str) -> str:
    """A docstring with each argument on one line: tyro keeps line breaks of their descriptions."""
    return re.sub(r"\n {8}(?=\S)", " ", inspect.cleandoc(docstring))
