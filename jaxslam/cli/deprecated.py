"""Old names of options and of their values, which go on working for one version, with a note.

Remove this module, its call in `main` and its exemption in `tests/test_words.py` in version 0.3.
"""

import sys
from collections.abc import Callable, Mapping

from jaxslam.io import noise_file

OPTIONS: Mapping[str, Mapping[str, str]] = {
    "simulate": {"--runs": "--trials"},
    "run": {"--animate": "--gif", "--no-animate": "--no-gif", "--view": "--rerun"},
    "map": {"--clearance": "--robot-radius", "--speck": "--min-obstacle-size"},
    "tune": {"--runs": "--trials", "--steps": "--updates"},
}
"""New name of each old option, by command."""

LOSSES = {"calibrated": "pose_nll", "localisation": "pose_mse", "likelihood": "innovation_nll"}

VALUES: Mapping[str, Mapping[str, Callable[[str], str]]] = {
    "simulate": {
        "--landmarks": lambda value: {"nodes": "junctions"}.get(value, value),
        "--labels": lambda value: {"runs": "segments"}.get(value, value),
    },
    "tune": {
        "--loss": lambda value: LOSSES.get(value, value),
        "--freeze": noise_file.name_of,
    },
}
"""Function from an old value to the new one, by command and option; it keeps new values."""

SEVERAL = {"--freeze"}  # options that take several values


def rewrite(argv: list[str]) -> list[str]:
    """Arguments with new names and values in the place of old ones; a note on stderr for each.

    Both `--option value` and `--option=value` are understood, and `_` for `-` in an option.

    Args:
        argv: Arguments of `jaxslam`, the command first.
    """
    if not argv:
        return argv
    command, *rest = argv
    options, values = OPTIONS.get(command, {}), VALUES.get(command, {})
    new, notes = [command], {}
    option, num_values = "", 0  # the option whose values follow, and how many have
    for token in rest:
        if token.startswith("--"):
            given, equals, value = token.partition("=")
            known = given.replace("_", "-")
            option, num_values = options.get(known, known), 0
            if known in options:
                notes[given] = option
                given = option
            if equals:
                value, num_values = _renamed(values, option, value, notes), 1
            new.append(given + equals + value)
        else:
            if num_values == 0 or option in SEVERAL:
                token = _renamed(values, option, token, notes)
            num_values += 1
            new.append(token)
    for old, name in notes.items():
        note = f"note: {old} is now {name}; the old name goes away in the next version"
        print(note, file=sys.stderr)
    return new


def _renamed(
    values: Mapping[str, Callable[[str], str]], option: str, value: str, notes: dict[str, str]
) -> str:
    """The new name of a value of an option; noted if it differs."""
    if option not in values or values[option](value) == value:
        return value
    name = values[option](value)
    notes[f"{option} {value}"] = f"{option} {name}"
    return name
