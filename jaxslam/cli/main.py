"""The command line: `jaxslam simulate`, `run LOG`, `map MAP.yaml` and `tune [LOG ...]`."""

import sys

import tyro

import jaxslam
from jaxslam.cli.map_command import map_grid
from jaxslam.cli.run_command import run
from jaxslam.cli.simulate_command import simulate
from jaxslam.cli.tune_command import tune
from jaxslam.io.errors import InputError

ABOUT = """Topological SLAM for a robot with a 2-D laser scanner.
`jaxslam COMMAND --help` lists the options of a command, `jaxslam --version` prints the version."""


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 2 for bad input, 130 for Ctrl-C."""
    argv = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if argv[0] == "--version":
        print(f"jaxslam {jaxslam.__version__}")
        return 0
    commands = {"simulate": simulate, "run": run, "map": map_grid, "tune": tune}
    try:
        tyro.extras.subcommand_cli_from_dict(commands, prog="jaxslam", description=ABOUT, args=argv)
    except InputError as error:
        print(f"jaxslam: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        print(f"jaxslam: {str(interrupt) or 'interrupted, nothing written'}", file=sys.stderr)
        return 130
    return 0
