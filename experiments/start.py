"""Startup time of `jaxslam run`: how long until the first scans of a log are mapped.

The first start compiles everything. Later ones read compiled programs and traces from the caches;
beside them are starts with the cache of traces disabled. Of a log, or of a simulated drive.
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
from jaxslam.frontend.config import FrontendConfig
from jaxslam.io import npz
from jaxslam.simulation import drives

MAIN = "from jaxslam.cli.main import main; raise SystemExit(main())"
NO_TRACES = f"from jaxslam.core import trace_cache; trace_cache.enable = lambda: None; {MAIN}"
MAPPED = b"mapping"  # of the progress bar, from the first chunk of scans on


def simulate_log(seed: int, path: Path) -> None:
    """Write a log of the office drive."""
    world, robot, waypoints, num_scans = common.drive_in()
    key, lidar = jax.random.key(seed), FrontendConfig().lidar
    truth, odometry, scans = drives.simulate_scans(
        key, lidar, robot, world, waypoints, num_scans=num_scans
    )
    ranges = np.where(scans.hit, scans.ranges, np.inf).astype(np.float32)
    times = np.arange(num_scans, dtype=float)
    poses = np.asarray(se2.dead_reckoning(truth[0], odometry), float)
    npz.write(path, LaserLog(times, poses, ranges, lidar, 0, times, poses))


def start(log: Path, folder: Path, code: str) -> Numbers:
    """Seconds until the first chunk of a log is mapped, and until all files are written."""
    env = {name: x for name, x in os.environ.items() if not name.startswith("JAX_")}
    env |= {"XDG_CACHE_HOME": str(folder)}
    command = [sys.executable, "-c", code, "run", str(log), "--out", str(folder / "out")]
    begin, first, output = perf_counter(), None, b""
    with subprocess.Popen(
        command, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        while new := os.read(process.stderr.fileno(), 1 << 16):
            output += new
            if first is None and MAPPED in output:
                first = perf_counter() - begin
    if process.returncode or first is None:
        raise SystemExit(f"{log}: {output.decode(errors='replace').strip().splitlines()[-1:]}")
    return {"mapped_s": first, "written_s": perf_counter() - begin}


def compute(seed: int, log: str, repeats: int) -> Numbers:
    """Starts of each kind: the fastest of some, taken in turns; the very first once."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        path = Path(log).absolute() if log else folder / "office.npz"
        if not log:
            simulate_log(seed, path)
        starts = {"first": [start(path, folder, MAIN)], "later": [], "traced_anew": []}
        start(path, folder, NO_TRACES)  # compiles, as its programs have other cache keys
        for _ in range(repeats):
            starts["later"].append(start(path, folder, MAIN))
            starts["traced_anew"].append(start(path, folder, NO_TRACES))
    best = {
        kind: {name: min(one[name] for one in found) for name in found[0]}
        for kind, found in starts.items()
    }
    ratio = best["later"]["mapped_s"] / best["traced_anew"]["mapped_s"]
    return {"seed": seed, "log": path.name, "later_vs_traced_anew": ratio, "starts": best}


def draw(numbers: Numbers, path: Path) -> None:
    """Bars of either time for each kind of start."""
    figure, axes = common.canvas(8, 2.6, 1, 1)
    axis, starts = axes[0, 0], numbers["starts"]
    names = {"mapped_s": "first scans mapped", "written_s": "all files written"}
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
    args = common.parse(__doc__, argv, log="", repeats=3)
    numbers = compute(args.seed, args.log, args.repeats)
    for kind, one in numbers["starts"].items():
        kind = kind.replace("_", " ")
        print(f"{kind}: mapped after {one['mapped_s']:.1f} s, written after {one['written_s']:.1f}")
    common.save(args.out, "start", numbers, draw)


if __name__ == "__main__":
    main()
