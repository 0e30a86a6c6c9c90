"""How often `jaxslam run` warns of a wrong map, and how often of a right one.

Trajectories of simulated drives, each in a world of its own, are left as they are, given small
errors, or damaged as logs are. Of the former those with an error below 0.2 m are fine, of the
latter those with one above 0.5 m lost; the others do not count. Recorded logs `NAME.clf` in the
folder `--data` are damaged likewise if their reference `NAME.reference.tum` lies beside them.
"""

from collections.abc import Callable, Iterator
from itertools import chain, cycle, islice
from pathlib import Path

import numpy as np
from tqdm import tqdm

from experiments import common, damaged_drives
from experiments.common import Numbers
from experiments.damaged_drives import FINE, LOST, Damage, Drive
from jaxslam.core.scan import Scan
from jaxslam.core.time_series import match_times
from jaxslam.io import readers, tum
from jaxslam.mapping.map_consistency import check_map

NAME = "map_warnings"
LOST_ERROR, FINE_ERROR = 0.5, 0.2  # [m] RMSE of the positions
SIMULATED = "simulated"
TIMES_EACH = 3  # that a recorded log is damaged in each manner
KINDS = {"lost": common.BLUE, "fine": common.ORANGE}


def recorded_drives(folder: Path) -> Iterator[tuple[str, Drive]]:
    """Names and drives of the CARMEN logs of a folder that have a reference trajectory."""
    for path in sorted(folder.rglob("*.reference.tum")):
        name = path.name.split(".")[0]
        log, (times, poses) = readers.read_log(path.with_name(f"{name}.clf")), tum.read(path)
        i, j = match_times(log.times, times).T
        ranges = log.ranges[i]
        hit = np.isfinite(ranges)
        scans = Scan(np.where(hit, ranges, log.lidar.range_max), hit)
        yield name, Drive(log.lidar, scans, poses[j])


def examine(drive: Drive, damage: Damage, rng: np.random.Generator) -> Numbers:
    """Error of a damaged trajectory, and the warnings that it causes."""
    kept, poses = damage(rng, drive.poses)
    scans = Scan(drive.scans.ranges[kept], drive.scans.hit[kept])
    found = check_map(drive.lidar, poses, scans)
    error = damaged_drives.position_error(poses, drive.poses[kept])
    kind = None
    if damage in LOST.values() and error > LOST_ERROR:
        kind = "lost"
    elif damage in FINE.values() and error < FINE_ERROR:
        kind = "fine"
    return {
        "damage": damage.__name__,
        "error_m": error,
        "kind": kind,
        "scans": len(kept),
        "warned": len(found.warnings) > 0,
        "worst_step": float(np.nanmax(found.step_contradiction, initial=0.0)),
        "explained": found.metrics()["explained"],
    }


def examine_all(
    examine: Callable[[Drive, Damage, np.random.Generator], Numbers],
    simulated: list[Damage],
    recorded: list[Damage],
    seed: int,
    data: Path | None,
) -> list[Numbers]:
    """Cases of simulated drives, one for each damage, and of the recorded ones by each damage.

    Args:
        examine: Numbers of a damaged drive.
        simulated: Damage of each simulated drive.
        recorded: Damages of each recorded drive, `TIMES_EACH` times.
        seed: Of drives and damages.
        data: Folder of the recorded logs; None for none.
    """
    cases = []
    for k, damage in enumerate(tqdm(simulated, unit="drive", leave=False)):
        number = 1_000_000 * (seed + 1) + k
        drive = damaged_drives.simulate(number)
        case = examine(drive, damage, np.random.default_rng([seed, k]))
        cases.append({"drive": SIMULATED, "number": number} | case)
    for name, drive in recorded_drives(data) if data else ():
        for k, damage in enumerate(tqdm(recorded * TIMES_EACH, desc=name, leave=False)):
            case = examine(drive, damage, np.random.default_rng([seed, k]))
            cases.append({"drive": name, "number": k} | case)
    return cases


def compute(seed: int, num_drives: int, data: Path | None) -> Numbers:
    """Errors and warnings of all trajectories, and the shares that were warned of."""
    pairs = zip(cycle(FINE.values()), cycle(LOST.values()), strict=False)
    damages = list(islice(chain.from_iterable(pairs), num_drives))
    cases = examine_all(examine, damages, [*FINE.values(), *LOST.values()], seed, data)
    drives = sorted({case["drive"] for case in cases})
    return {
        "seed": seed,
        "shares": {
            drive: {kind: share_warned(cases, drive=drive, kind=kind) for kind in KINDS}
            for drive in drives
        },
        "by_damage": {
            damage: share_warned(cases, damage=damage, kind=kind)
            for kind, damages in (("lost", LOST), ("fine", FINE))
            for damage in damages
        },
        "cases": cases,
    }


def share_warned(cases: list[Numbers], **wanted: str) -> Numbers:
    """Share of the cases with these values that were warned of, with its 95 % Wilson interval."""
    warned = [c["warned"] for c in cases if all(c[key] == x for key, x in wanted.items())]
    low, high = wilson_interval(sum(warned), len(warned))
    share = sum(warned) / len(warned) if warned else None
    return {"cases": len(warned), "warned": sum(warned), "share": share, "low": low, "high": high}


def wilson_interval(count: int, total: int, sigmas: float = 1.96) -> tuple[float, float]:
    """Wilson's interval of a probability, of `count` successes in `total` trials."""
    square = sigmas**2
    centre = (count + square / 2) / (total + square)
    half = sigmas * np.sqrt(count * (total - count) / max(total, 1) + square / 4) / (total + square)
    return max(0.0, float(centre - half)), min(1.0, float(centre + half))


def draw(numbers: Numbers, path: Path) -> None:
    """Draw the shares by drive and by damage."""
    figure, axes = common.canvas(9.0, 4.5, 1, 2)
    for kind, colour in KINDS.items():
        rows = [(name, shares[kind]) for name, shares in numbers["shares"].items()]
        damages = LOST if kind == "lost" else FINE
        draw_shares(axes[0, 0], rows, colour)
        rows = [(name, numbers["by_damage"][name]) for name in damages]
        draw_shares(axes[0, 1], rows, colour)
    for axis in axes[0]:
        axis.set(xlim=(-0.02, 1.02), xlabel="share with a warning, 95 % interval")
        axis.invert_yaxis()
    for kind, colour in KINDS.items():
        error = f"> {LOST_ERROR}" if kind == "lost" else f"< {FINE_ERROR}"
        axes[0, 0].plot([], [], "o", color=colour, label=f"{kind}: error {error} m")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path)


def draw_shares(axis, rows: list[tuple[str, Numbers]], colour: str) -> None:
    """Draw the share and its interval for each name."""
    for name, share in rows:
        if share["cases"]:
            axis.plot([share["low"], share["high"]], [name, name], color=colour)
            axis.plot(share["share"], name, "o", color=colour)


def main(argv: list[str] | None = None) -> int:
    """Run the experiment from the command line."""
    given = common.parse(__doc__, argv, drives=240, data=Path())
    numbers = compute(given.seed, given.drives, given.data if given.data != Path() else None)
    for drive, shares in numbers["shares"].items():
        for kind, s in shares.items():
            interval = f"{s['low']:.1%} to {s['high']:.1%}"
            print(f"{drive:12} {kind}: warned {s['warned']} of {s['cases']} ({interval})")
    common.save(given.out, NAME, numbers, draw)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
