"""How long a user waits for the first scans of a log to be mapped: `jaxslam run` as it is called.

The first start compiles everything. Later ones read what was kept: what was compiled, and what was
traced; beside them are starts that trace anew. Of a log, or of a drive simulated in the office.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import jax
import numpy as np

from experiments import common
from experiments.common import Numbers
from jaxslam.core import se2
from jaxslam.core.logs import LaserLog
from jaxslam.io import npz
from jaxslam.pipeline.config import Config
from jaxslam.simulation import drives

USUAL = "from jaxslam.cli import main; raise SystemExit(main())"
ANEW = f"from jaxslam import programs; programs.keep = lambda: None; {USUAL}"
MAPPED = b"mapping"  # of the bar, from the first stretch of scans on


def simulated(seed: int, path: Path) -> None:
    """A log of the office drive."""
    place, robot, way, steps = common.scene()
    given = jax.random.key(seed), Config(), place, robot, way
    truth, told, scans = drives.simulate_scans(*given, num_scans=steps)
    ranges = np.where(scans.hit, scans.ranges, np.inf).astype(np.float32)
    times = np.arange(steps, dtype=float)
    poses = np.asarray(se2.dead_reckoning(truth[0], told), float)
    npz.write(path, LaserLog(times, poses, ranges, Config().frontend.lidar, 0, times, poses))


def start(log: Path, folder: Path, code: str) -> Numbers:
    """Seconds until the first stretch of a log is mapped, and until all is written."""
    env = {name: x for name, x in os.environ.items() if not name.startswith("JAX_")}
    env |= {"XDG_CACHE_HOME": str(folder)}
    command = [sys.executable, "-c", code, "run", str(log), "--out", str(folder / "out")]
    outputs = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    begin, first, seen = perf_counter(), None, b""
    with subprocess.Popen(command, env=env, **outputs) as process:
        while some := os.read(process.stderr.fileno(), 1 << 16):
            seen += some
            if first is None and MAPPED in seen:
                first = perf_counter() - begin
    if process.returncode or first is None:
        raise SystemExit(f"{log}: {seen.decode(errors='replace').strip().splitlines()[-1:]}")
    return {"mapped_s": first, "written_s": perf_counter() - begin}


def compute(seed: int, log: str, repeats: int) -> Numbers:
    """Starts of each kind: the quickest of some, taken in turns; the first of all once."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        path = Path(log).absolute() if log else folder / "office.npz"
        if not log:
            simulated(seed, path)
        starts = {"first": [start(path, folder, USUAL)], "later": [], "traced_anew": []}
        start(path, folder, ANEW)  # which compiles what the others find under another name
        for _ in range(repeats):
            starts["later"].append(start(path, folder, USUAL))
            starts["traced_anew"].append(start(path, folder, ANEW))
    best = {
        kind: {name: min(one[name] for one in all) for name in all[0]}
        for kind, all in starts.items()
    }
    ratio = best["later"]["mapped_s"] / best["traced_anew"]["mapped_s"]
    return {"seed": seed, "log": path.name, "later_vs_traced_anew": ratio, "starts": best}


def draw(numbers: Numbers, path: Path) -> None:
    """Bars of either time for each kind of start."""
    figure, axes = common.canvas(8, 2.6, 1, 1)
    axis, starts = axes[0, 0], numbers["starts"]
    names = {"mapped_s": "first scans mapped", "written_s": "all written"}
    rows = np.arange(len(starts))[::-1]
    for k, (name, text) in enumerate(names.items()):
        drawn = axis.barh(rows - 0.36 * k + 0.18, [one[name] for one in starts.values()], 0.36)
        for bar in drawn:
            bar.set_color((common.BLUE, common.SKY)[k])
        drawn.set_label(text)
        axis.bar_label(drawn, fmt="%.1f", padding=2)
    axis.set_yticks(rows, [kind.replace("_", " ") for kind in starts])
    axis.set_xlabel(f"seconds from the start of jaxslam run, {numbers['log']}")
    axis.margins(x=0.1)
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    given = common.parse(__doc__, argv, log="", repeats=3)
    numbers = compute(given.seed, given.log, given.repeats)
    for kind, one in numbers["starts"].items():
        print(f"{kind}: mapped after {one['mapped_s']:.1f} s, written after {one['written_s']:.1f}")
    common.save(given.out, "start", numbers, draw)


if __name__ == "__main__":
    main()
