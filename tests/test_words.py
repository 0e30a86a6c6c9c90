"""Words that must not come back: old names, a private dialect, one word for several things.

`python tests/test_words.py PATH ...` lists what is left in files or folders.
"""

import re
import sys
from pathlib import Path

HOME = Path(__file__).resolve().parents[1]

PROSE = """
way, ways, told, tell, tells, telling, survey, surveys, surveyed, laid, lay, lays, stretch,
stretches, judge, judges, judged, judgement, judgements, sighting, sightings, worth, doubt, doubts,
doubted, doubtful, believe, believes, believed, twin, twins, mend, mends, mended, mending, film,
films, filmed, overdue, witness, recognise, recognises, recognised, room for, rooms for,
make room, makes room, making room, more room, machine's hours, which cannot be, robot that is lost,
straight run, straight runs
"""
NAMES = """
Runs, RunSpec, Nodes, NodeSpec, Aligned, AlignSpec, ClosureSpec, Closures, Records, Postponed,
Conditioned, Recognised, MatchSpec, Mapper, Sightings, Recording, Spread, Jitted, log_noise,
sighting_noise, seen_from, composed, by_time, theta_of, noise_of, keep_compiled, one_by_one,
use_cores, second_look, map_grid, front_end, monte_carlo.Log, slam.run, fit.tune, sensor_noise,
from_sightings, from_recording, config_of_scans, add_driven, still_open, make_room, Way
"""
OPTIONS = """
--runs, --clearance, --speck, --animate, --view, --steps, --labels runs, --landmarks nodes,
--loss calibrated, --loss localisation, --loss likelihood
"""


def _pattern(words: str, before: str, after: str, flags: int = 0) -> re.Pattern:
    parts = (re.escape(" ".join(word.split())) for word in words.split(","))
    return re.compile(f"(?<!{before})(?:{'|'.join(parts)})(?!{after})", flags)


IN_PROSE = _pattern(PROSE, r"[\w-]", r"[\w-]", re.IGNORECASE)
IN_CODE = _pattern(NAMES, r"\w", r"\w")
IN_HELP = _pattern(OPTIONS, r"\w", r"[\w-]")
# JSON keys and flags of experiments, which keep their spelling, and a method of Optuna.
KEYS = re.compile(r"[\"'`](mended|judged_on|front_end|ways|--runs)[\"'`]|\bstudy\.tell\b")
EXEMPT = {"jaxslam/cli/deprecated.py"}  # notes on old options, for one version


def words(text: str) -> list[tuple[int, str]]:
    """Line and word of everything forbidden in a text; parts of snake_case names are words too."""
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        line = KEYS.sub("", line)
        found += [(number, match[0]) for match in IN_PROSE.finditer(line.replace("_", " "))]
        found += [(number, match[0]) for match in IN_CODE.finditer(line)]
        found += [(number, match[0]) for match in IN_HELP.finditer(line)]
    return found


def sources() -> list[Path]:
    """Package, experiments and READMEs; help texts are docstrings of the package."""
    paths = [*HOME.glob("jaxslam/**/*.py"), *HOME.glob("experiments/**/*.py")]
    paths += [HOME / "README.md", *HOME.glob("jaxslam/**/*.md"), *HOME.glob("experiments/*.md")]
    return [path for path in sorted(paths) if path.relative_to(HOME).as_posix() not in EXEMPT]


def test_forbidden_words_are_found():
    text = 'the way is\nrun_survey(x)\nwaypoint always\n"mended": 1\n--runs 3\nfrom x import Nodes'
    assert words(text) == [(1, "way"), (2, "survey"), (5, "--runs"), (6, "Nodes")]


def test_old_words_do_not_come_back():
    found = [
        f"{path.relative_to(HOME)}:{line}: {word}"
        for path in sources()
        for line, word in words(path.read_text())
    ]
    assert not found, "\n" + "\n".join(found)


if __name__ == "__main__":
    for given in map(Path, sys.argv[1:]):
        for path in sorted(given.rglob("*")) if given.is_dir() else [given]:
            if path.suffix in (".py", ".md"):
                for line, word in words(path.read_text()):
                    print(f"{path}:{line}: {word}")
