"""The command line: `jaxslam simulate`, `run`, `localise`, `map`, `route` and `tune`."""

import inspect
import re
import sys
from collections.abc import Callable
from typing import Any

import tyro

import jaxslam
from jaxslam.cli import deprecated
from jaxslam.cli.localise_command import localise_in_map
from jaxslam.cli.map_command import map_occupancy
from jaxslam.cli.route_command import plan_route
from jaxslam.cli.run_command import run
from jaxslam.cli.simulate_command import simulate
from jaxslam.cli.tune_command import tune
from jaxslam.io.errors import InputError

ABOUT = """Topological SLAM for a robot with a 2-D laser scanner.
`jaxslam COMMAND --help` lists the options of a command, `jaxslam --version` prints the version."""

COMMANDS: dict[str, Callable[..., Any]] = {
    "simulate": simulate,
    "run": run,
    "localise": localise_in_map,
    "map": map_occupancy,
    "route": plan_route,
    "tune": tune,
}


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 2 for bad input, 130 for Ctrl-C.

    `run --strict` returns 3 if the map contradicts itself.

    Args:
        argv: Arguments; by default those of the process, and `--help` if there are none.

    Raises:
        SystemExit: Of code 0 after `--help`, of code 2 after wrong usage.
    """
    argv = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if argv[0] == "--version":
        print(f"jaxslam {jaxslam.__version__}")
        return 0
    command, *options = deprecated.rewrite(argv)
    try:
        if command in COMMANDS:
            function = COMMANDS[command]
            function.__doc__ = _unwrapped(function.__doc__ or "")
            return tyro.cli(function, prog=f"jaxslam {command}", args=options) or 0
        else:
            _usage(argv)
    except InputError as error:
        print(f"jaxslam: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        print(f"jaxslam: {str(interrupt) or 'interrupted, nothing written'}", file=sys.stderr)
        return 130
    return 0


def _usage(argv: list[str]) -> None:
    """Exit by `--help`, or by what is wrong: the arguments begin with no command."""

    def summary(function: Callable[..., Any]) -> Callable[[], None]:
        def stub() -> None: ...

        stub.__doc__ = (function.__doc__ or "").splitlines()[0]
        return stub

    commands: dict[str, Callable[..., Any]] = {
        name: summary(function) for name, function in COMMANDS.items()
    }
    tyro.extras.subcommand_cli_from_dict(commands, prog="jaxslam", description=ABOUT, args=argv)


def _unwrapped(docstring: str) -> str:
    """A docstring with each argument on one line: tyro keeps line breaks of their descriptions."""
    return re.sub(r"\n {8}(?=\S)", " ", inspect.cleandoc(docstring))
