"""Loops that are metres open: how often places that were found again are the right ones.

Trajectories of simulated drives, each in a world of its own, are damaged as logs are, or left as
they are, or given small errors; so are recorded logs of the folder `--data` that have a reference.
On each, `matching.revisits` looks for places that the drive shows twice, far from where it has
them. A pair of scans is right if their relative pose is within 0.5 m and 10 degrees of the true
one. A trajectory that damage has left nearly right, or on which nothing can be found, counts too.
"""

from itertools import chain, cycle, islice
from pathlib import Path

import numpy as np

from experiments import common, damaged_drives
from experiments.common import Numbers
from experiments.damaged_drives import FINE, LOST, Damage, Drive
from experiments.map_warnings import draw_shares, examine_all, wilson_interval
from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import increments, motion_size, relative
from jaxslam.matching.map_places import JoinSpec, ScanMap
from jaxslam.matching.revisits import find_revisits

NAME = "revisits"
RIGHT = (0.5, np.radians(10.0))  # [m], [rad]
KEYFRAME = 0.3  # [m] moved, a radian counting as half a metre, from keyframe to keyframe
DAMAGES = {**FINE, **LOST}


def examine(drive: Drive, damage: Damage, rng: np.random.Generator) -> Numbers:
    """Places found again on a damaged trajectory, and how many of them are right."""
    kept, poses = damage(rng, drive.poses)
    moved = np.cumsum(motion_size(increments(drive.poses[kept])))
    keyframes = np.unique(np.floor(moved / KEYFRAME), return_index=True)[1]
    kept, poses = kept[keyframes], poses[keyframes]
    scans = Scan(drive.scans.ranges[kept], drive.scans.hit[kept])
    found = find_revisits(JoinSpec(), ScanMap(drive.lidar, poses, scans))
    true = drive.poses[kept]
    off = relative(found.relative_pose, relative(true[found.first], true[found.second]))
    right = (np.hypot(off[:, 0], off[:, 1]) < RIGHT[0]) & (np.abs(off[:, 2]) < RIGHT[1])
    return {
        "damage": damage.__name__,
        "error_m": damaged_drives.position_error(poses, true),
        "right": int(right.sum()),
        "wrong": int((~right).sum()),
        "wrong_sets": len(np.unique(found.group[~right])),
    }


def compute(seed: int, num_drives: int, data: Path | None) -> Numbers:
    """Cases of all trajectories, and sums by damage."""
    damages = [*DAMAGES.values()]
    simulated = list(islice(cycle(damages), num_drives))
    cases = examine_all(examine, simulated, damages, seed, data)
    names = list(dict.fromkeys(case["drive"] for case in cases))
    return {
        "seed": seed,
        "by_drive": {name: total(cases, drive=name) for name in names},
        "by_damage": {name: total(cases, damage=name) for name in DAMAGES},
        "cases": cases,
    }


def total(cases: list[Numbers], **wanted: str) -> Numbers:
    """Sums over the cases with these values; the intervals are Wilson's, of 95 %."""
    some = [case for case in cases if all(case[key] == x for key, x in wanted.items())]
    found = sum(case["right"] + case["wrong"] > 0 for case in some)
    low, high = wilson_interval(found, len(some))
    counts = {key: sum(case[key] for case in some) for key in ("right", "wrong", "wrong_sets")}
    share = found / len(some) if some else None
    found_in = {"cases": len(some), "found": found, "share": share, "low": low, "high": high}
    return found_in | counts


def draw(numbers: Numbers, path: Path) -> None:
    """Draw the share of trajectories on which places were found, and the wrong ones, by damage."""
    figure, axes = common.canvas(9.0, 4.0, 1, 2)
    share, pairs = axes[0]
    rows = list(numbers["by_damage"].items())
    draw_shares(share, rows, common.BLUE)
    for name, row in rows:
        if row["cases"]:
            pairs.barh(name, row["right"], color=common.BLUE)
            pairs.barh(name, row["wrong"], left=row["right"], color=common.ORANGE)
    share.set(xlim=(-0.02, 1.02), xlabel="share of trajectories with places found, 95 % interval")
    pairs.set(xlabel="pairs of scans: right (blue), wrong (orange)")
    for axis in axes[0]:
        axis.invert_yaxis()
    figure.savefig(path)


def main(argv: list[str] | None = None) -> int:
    """Run the experiment from the command line."""
    given = common.parse(__doc__, argv, drives=100, data=Path())
    numbers = compute(given.seed, given.drives, given.data if given.data != Path() else None)
    for name, row in chain(numbers["by_drive"].items(), numbers["by_damage"].items()):
        print(
            f"{name:14} places found on {row['found']} of {row['cases']}; pairs of scans: "
            f"{row['right']} right, {row['wrong']} wrong, in {row['wrong_sets']} sets"
        )
    common.save(given.out, NAME, numbers, draw)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
