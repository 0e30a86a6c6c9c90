"""Cold starts: what a first command costs in a new process whose cache folder is empty.

Wall and processor time and peak memory of `jaxslam simulate`, `tune` and `run`, until all files are
written, on one core; then once more with the caches that the first start has filled. `--against`
names another build, a wheel or a checkout, whose commands take turns with these.
"""

import compileall
import json
import os
import signal
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from experiments import common, import_time, start
from experiments.common import Numbers
from experiments.timing import pin
from jaxslam.io.errors import InputError

COMMANDS = {
    "simulate": ("simulate",),
    "tune": ("tune", "--updates", "1", "--trials", "4", "--heldout", "2"),
    "run": ("run", "LOG"),
}
"""Arguments of each command; LOG stands for the log."""

KINDS = ("cold", "warm")
MEASURED = ("wall_s", "cpu_s", "peak_mb")
TIMEOUT = 1800.0  # [s] of a command
FOUND = "import jaxslam; print(next(iter(jaxslam.__path__)))"

# Its own small process, as the peak memory of a new process begins with that of its parent.
LAUNCH = """
import json, os, sys, time
null = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
begin = time.perf_counter()
new = os.posix_spawn(sys.executable, [sys.executable, *sys.argv[1:]], os.environ, file_actions=null)
status, used = os.wait4(new, 0)[1:]
wall = time.perf_counter() - begin
megabyte = 2**20 if sys.platform == "darwin" else 2**10
found = wall, used.ru_utime + used.ru_stime, used.ru_maxrss / megabyte
print(json.dumps(found))
sys.exit(os.waitstatus_to_exitcode(status) != 0)
"""


class Build(NamedTuple):
    """A version of jaxslam.

    Attributes:
        name: Of its wheel or folder; "this" is the one that measures.
        folder: Folder that holds the package `jaxslam`.
    """

    name: str
    folder: Path

    def environment(self, cache: Path) -> dict[str, str]:
        """Environment of a process that imports it, with its caches in a folder."""
        kept = {k: x for k, x in os.environ.items() if not k.startswith("JAX_")}
        kept |= {k: x for k, x in os.environ.items() if k == "JAX_PLATFORMS"}
        path = filter(None, [str(self.folder), os.environ.get("PYTHONPATH")])
        return kept | {"PYTHONPATH": os.pathsep.join(path), "XDG_CACHE_HOME": str(cache)}


def this_build() -> Build:
    """The build that measures."""
    return Build("this", import_time.HOME)


def other_build(against: Path, folder: Path) -> Build:
    """The build of a wheel, which is installed into a folder, or of a checkout.

    Raises:
        InputError: There is none, or Python does not find it.
    """
    against = against.absolute()
    if against.suffix == ".whl" and against.is_file():
        if find_spec("pip") is None:
            raise InputError("pip is missing, which installs a wheel", advice="name a checkout")
        options = ("--no-deps", "--no-index", "--quiet", "--disable-pip-version-check")
        command = [sys.executable, "-m", "pip", "install", *options, "--target", folder, against]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise InputError(f"cannot be installed: {_last_line(done.stderr)}", path=against)
        build = Build(against.name, folder)
    elif (against / "jaxslam" / "__init__.py").is_file():
        build = Build(against.name, against)
    else:
        advice = "name a .whl file, or a folder that holds the package jaxslam"
        raise InputError("is no build of jaxslam", path=against, field="--against", advice=advice)
    command, env = [sys.executable, "-c", FOUND], build.environment(folder)
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True)
    found = done.stdout.strip()
    if done.returncode or Path(found).resolve().parent != build.folder.resolve():
        instead = found or _last_line(done.stderr)
        raise InputError(f"Python does not import it, but: {instead}", path=against)
    return build


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["it says nothing"])[-1][:200]


def start_once(build: Build, arguments: tuple[str, ...], cache: Path, out: Path) -> Numbers:
    """`MEASURED` of a command in a new process, or a note why there is none.

    Args:
        build: Whose command.
        arguments: Of the command, without `--out`.
        cache: Folder of its caches.
        out: Folder that it writes to, and in which it runs.
    """
    out.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-c", LAUNCH, "-c", start.MAIN, *arguments, "--out", str(out)]
    process = subprocess.Popen(
        command,
        cwd=out,
        env=build.environment(cache),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        printed, errors = process.communicate(timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        return {"note": f"it took longer than {TIMEOUT:.0f} s"}
    finally:
        if process.returncode is None:  # also where this process is interrupted
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    if process.returncode:
        return {"note": f"it failed: {_last_line(errors)}"}
    return dict(zip(MEASURED, json.loads(printed), strict=True))


def _least(found: list[Numbers]) -> Numbers:
    """The least of each of `MEASURED`, or the first note."""
    notes = [one for one in found if "note" in one]
    return notes[0] if notes else {name: min(one[name] for one in found) for name in MEASURED}


def measure_builds(builds: tuple[Build, ...], log: Path, folder: Path, repeats: int) -> Numbers:
    """By build, command and kind of start: the least of some starts, of which builds take turns.

    Args:
        builds: At most two.
        log: That `run` maps.
        folder: For caches and results.
        repeats: Cold starts of each command, each with a warm one after it.
    """
    found: Numbers = {
        build.name: {command: {kind: [] for kind in KINDS} for command in COMMANDS}
        for build in builds
    }
    starts = list(product(range(repeats), COMMANDS, KINDS, enumerate(builds)))
    for turn, command, kind, (k, build) in tqdm(starts, desc="starts", leave=False):
        arguments = tuple(str(log) if word == "LOG" else word for word in COMMANDS[command])
        own = folder / f"{turn}_{command}_{k}"
        done = start_once(build, arguments, own / "cache", own / kind)
        found[build.name][command][kind].append(done)
    return {
        name: {
            command: {kind: _least(each) for kind, each in kinds.items()}
            for command, kinds in commands.items()
        }
        for name, commands in found.items()
    }


def ratios(this: Numbers, other: Numbers, name: str) -> Numbers:
    """Costs of the commands of this build by those of another; None where one failed.

    Args:
        this: `MEASURED` by command and kind of start.
        other: Likewise.
        name: Name of the other build.
    """

    def ratio(command: str, kind: str, key: str) -> float | None:
        own, theirs = this[command][kind].get(key), other[command][kind].get(key)
        return own and theirs and own / theirs

    def of(key: str) -> Numbers:
        return {command: {kind: ratio(command, kind, key) for kind in KINDS} for command in this}

    return {
        "build": name,
        "cold_first_result": {command: ratio(command, "cold", "wall_s") for command in this},
        "cpu_seconds": of("cpu_s"),
        "peak_mb": of("peak_mb"),
    }


def compute(seed: int, log: str, against: str, repeats: int) -> Numbers:
    """Costs of all starts.

    Args:
        seed: Of the simulated log.
        log: Log that `run` maps; "": a simulated one.
        against: Wheel or checkout of another build; "": none.
        repeats: Cold starts of each command.

    Returns:
        `cold_first_result` [s] and `cpu_seconds` by command, `ratio_to`, what they are by the other
        build's or None, and `cold_start`, `MEASURED` of each build.

    Raises:
        InputError: There is no such log, or no such build.
    """
    if log and not Path(log).exists():
        raise InputError("does not exist", path=log, field="--log", advice="name a log")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        builds = (this_build(),)
        if against:
            (folder / "installed").mkdir()
            builds += (other_build(Path(against), folder / "installed"),)
        for build in builds:  # as an installed one is
            compileall.compile_dir(build.folder / "jaxslam", quiet=2)
        path = Path(log).absolute() if log else folder / "office.npz"
        if not log:
            start.simulate_log(seed, path)
        starts = measure_builds(builds, path, folder, repeats)
    this, *others = starts.values()
    return {
        "cold_first_result": {name: kinds["cold"].get("wall_s") for name, kinds in this.items()},
        "cpu_seconds": {
            name: {kind: kinds[kind].get("cpu_s") for kind in KINDS} for name, kinds in this.items()
        },
        "ratio_to": ratios(this, others[0], builds[1].name) if others else None,
        "cold_start": {"log": path.name, "builds": starts},
    }


def print_table(numbers: Numbers) -> None:
    """Print a line for each start, and the ratios."""
    print(f"{'cold and warm starts':26}" + "".join(f"{x:>13}" for x in ("wall s", "cpu s", "MB")))
    for build, commands in numbers["cold_start"]["builds"].items():
        for command, kinds in commands.items():
            for kind, found in kinds.items():
                shown = [f"{found[key]:13.1f}" for key in MEASURED if key in found]
                name = f"{command}, {kind}, {build}"
                print(f"{name:26}" + ("".join(shown) or f" {found['note']}"))
    ratio = numbers["ratio_to"]
    if ratio:
        for command, cold in ratio["cold_first_result"].items():
            cpu = ratio["cpu_seconds"][command]
            shown = ["-" if x is None else f"{x:.2f}" for x in (cold, *cpu.values())]
            names = ("first result", "processor time cold", "warm")
            text = ", ".join(f"{name} {x}" for name, x in zip(names, shown, strict=True))
            print(f"{command} by that of {ratio['build']}: {text}")


def draw(axis: Any, numbers: Numbers) -> None:
    """Draw bars of the wall time of each start."""
    rows = {
        f"{command}, {kind}" + (f", {build}"[:24] if build != "this" else ""): found["wall_s"]
        for build, commands in numbers["cold_start"]["builds"].items()
        for command, kinds in commands.items()
        for kind, found in kinds.items()
        if "wall_s" in found
    }
    names = sorted(rows, key=lambda name: name.split(", ")[:2], reverse=True)
    drawn = axis.barh(names, [rows[name] for name in names])
    for bar, name in zip(drawn, names, strict=True):
        bar.set_color(common.BLUE if "cold" in name else common.SKY)
    axis.bar_label(drawn, fmt="%.1f", padding=2)
    axis.margins(x=0.15)
    axis.set_title("new processes: seconds until all is written", fontsize=10)


def save_picture(numbers: Numbers, path: Path) -> None:
    """Draw the starts alone."""
    figure, axes = common.canvas(8, 3.6, 1, 1)
    draw(axes[0, 0], numbers)
    figure.savefig(path)


@common.report_errors("cold_start")
def main(argv: list[str] | None = None) -> int:
    """Run the experiment."""
    pin()
    args = common.parse(__doc__, argv, log="", against="", repeats=1)
    numbers = compute(args.seed, args.log, args.against, args.repeats)
    print_table(numbers)
    common.save(args.out, "cold_start", numbers, save_picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
