"""How much pairs of trials with the same random numbers say about a difference of two variants.

Trial i of all variants of a study has the same random numbers, each source of noise its own. The
standard error of the mean difference of their position RMSE is compared with that of as many trials
that have nothing in common: `ratio`, with a 95 % interval by resampling the trials. Small changes
of noise or filter leave what happens in a trial as it was: there a pair replaces many trials. Where
a change makes other features appear, the errors of two trials have little in common but the drive.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from experiments import common
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.evaluation.trial_statistics import paired_difference
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config
from jaxslam.simulation import path_following, worlds
from jaxslam.simulation.life import life_in
from jaxslam.simulation.range_errors import RangeErrors
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.traffic import Traffic
from jaxslam.study.outcomes import Outcomes, position_rmse
from jaxslam.study.progress import run_shown
from jaxslam.study.runner import Variant

NAME = "paired_trials"
MAX_PEOPLE = 10
RESAMPLES = 500
GOAL = 1 / 3


def variants_of(num_scans: int) -> list[Variant]:
    """Variants, the first of which the others are compared with; `kind` is what differs."""
    robot, world = Robot(), worlds.named("office")
    path = path_following.densify(worlds.waypoints("office"))
    params = NoiseParams.for_simulated_robot(*robot[:2])

    def scaled(q: float = 1.0, r: float = 1.0) -> NoiseParams:
        sensor = ("range_std", "bearing_std", "feature_std_scale", "wall_angle_std")
        changed = {name: getattr(params, name) * r for name in sensor}
        q_scaled = params.odometry_coefficients * q
        return params._replace(odometry_coefficients=q_scaled, **changed)

    def variant(kind: str, change: str, **given: Any) -> Variant:
        ranges, traffic = given.get("ranges", RangeErrors()), given.get("traffic", Traffic())
        life = life_in(world, path, ranges=ranges, traffic=traffic, max_people=MAX_PEOPLE)
        own = given.get("params", params), given.get("robot", robot)
        name = f"{kind} {change}".strip()
        return Variant(name, {"kind": kind}, Config(), *own, world, path, num_scans, life)

    noisier = robot._replace(encoder_noise=1.05 * robot.encoder_noise)
    return [
        variant("as it is", ""),
        *(variant("Q", f"+{100 * x:g} %", params=scaled(q=1.0 + x)) for x in (0.05, 0.2)),
        *(variant("R", f"+{100 * x:g} %", params=scaled(r=1.0 + x)) for x in (0.05, 0.2)),
        *(
            variant("range noise", f"+{100 * x:g} %", ranges=RangeErrors(std_scale=1.0 + x))
            for x in (0.02, 0.05, 0.2, 1.0)
        ),
        *(
            variant("missing beams", f"{100 * x:g} %", ranges=RangeErrors(missing=x))
            for x in (0.0005, 0.01, 0.1)
        ),
        *(variant("people", f"{x:g}", traffic=Traffic(people=x)) for x in (1.0, 10.0)),
        variant("wheel noise", "+5 %", robot=noisier),
    ]


def numbers_of(variants: list[Variant], found: list[Outcomes], seed: int) -> common.Numbers:
    """Standard errors of paired and unpaired differences from the first variant."""
    rng = np.random.default_rng(seed)
    errors = [position_rmse(one) for one in found]
    count = len(errors[0])
    rows = []
    for variant, own, outcomes in zip(variants[1:], errors[1:], found[1:], strict=True):
        difference = paired_difference(errors[0], own)
        drawn = (rng.integers(count, size=count) for _ in range(RESAMPLES))
        low, high = np.quantile([_ratio(errors[0][k], own[k]) for k in drawn], [0.025, 0.975])
        rows.append(
            {
                "name": variant.name,
                "kind": variant.settings["kind"],
                **difference._asdict(),
                "ratio": _ratio(errors[0], own),
                "ratio_low": low,
                "ratio_high": high,
                "same_drives": bool((found[0].place == outcomes.place).all()),
            }
        )
    numbers = {"seed": seed, "runs": count, "steps": found[0].error.shape[1]}
    return numbers | {"mean_rmse_m": errors[0].mean(), "rows": rows}


def _ratio(first: np.ndarray, second: np.ndarray) -> float:
    found = paired_difference(first, second)
    return found.standard_error / max(found.unpaired_standard_error, 1e-12)


def draw(numbers: common.Numbers, path: Path) -> None:
    """The ratio of each variant with its interval."""
    rows = numbers["rows"]
    figure, axes = common.canvas(8, 1.2 + 0.32 * len(rows), 1, 1)
    axis, at = axes[0, 0], np.arange(len(rows))
    value, low, high = (
        np.array([r[k] for r in rows]) for k in ("ratio", "ratio_low", "ratio_high")
    )
    spread = np.maximum([value - low, high - value], 0.0)
    axis.errorbar(value, at, xerr=spread, fmt="o", color=common.BLUE, capsize=2)
    axis.axvline(GOAL, color=common.BLACK, linestyle=":", label="1/3: nine times fewer trials")
    axis.axvline(1.0, color=common.RED, linestyle="--", label="nothing in common")
    axis.set_yticks(at, [row["name"] for row in rows])
    axis.invert_yaxis()
    axis.set(xlim=(0, 1.15), xlabel="standard error of the difference: paired / unpaired trials")
    axis.legend(loc="upper right", fontsize=8)
    axis.grid(axis="x", alpha=0.3)
    figure.savefig(path)


def _table(rows: list[common.Numbers]) -> Iterator[str]:
    for row in rows:
        interval = f"[{row['ratio_low']:.2f}, {row['ratio_high']:.2f}]"
        yield f"{row['name']:22s} ratio {row['ratio']:.2f} {interval}"


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code."""
    args = common.parse(__doc__, argv, runs=48, steps=60)
    use_cpu_devices()
    enable_caches()
    variants = variants_of(args.steps)
    found = run_shown(variants, num_trials=args.runs, seed=args.seed)
    numbers = numbers_of(variants, [one.record for one in found], args.seed)
    common.save(args.out, NAME, numbers, draw)
    print("\n".join(_table(numbers["rows"])))
    return 0


if __name__ == "__main__":
    sys.exit(main())
