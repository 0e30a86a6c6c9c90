"""Probability of a rare failure: multilevel splitting beside plain trials of the same drive.

`--drive landmarks`: twenty steps past known landmarks (`landmark_drive`), where errors grow little
by little. `--drive scans`: ten scans of a small scanner in the paper's room, through the whole
front end, where some large errors come at once, without a score that rises before. A drive fails if
its position is ever more than `--threshold` metres off. Multilevel splitting
(`study.rare_failures`) estimates how often, again and again with new noise; plain trials count it.
`relative_error` is the standard error by the probability; `distance` that of the two estimates, in
standard errors of their difference; `trials_ratio` the plain trials by those of one splitting;
`plain_trials` how many plain ones would determine the probability as well; `mean` is that of the
repetitions. The same command resumes where it was stopped.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import common, landmark_drive
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.scan import Lidar
from jaxslam.core.types import Key
from jaxslam.evaluation.trial_statistics import proportion
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.features import FeatureSpec
from jaxslam.frontend.grid import GridSpec
from jaxslam.frontend.segments import SegmentSpec
from jaxslam.pipeline.config import Config
from jaxslam.simulation import path_following, worlds
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.trial_episodes import trial_keys
from jaxslam.study.rare_failures import RareFailure, describe, rare_failure
from jaxslam.study.runner import Variant
from jaxslam.study.trials_from_noise import TrialsFromNoise

NAME = "rare_failures"
ENCODER_NOISE = 0.005  # [m / sqrt(m)]
NUM_SCANS = 10
WAYPOINTS = (0.7, 0.8), (2.0, 1.0), (2.2, 2.3), (1.6, 3.6)
PLAIN_BATCH, PLAIN_GROUP = 2000, 500  # trials that are kept together, and in memory
CONFIG = Config.for_lidar(
    Lidar(num_beams=91, angle_increment=np.pi / 90, range_max=6.0),
    frontend=FrontendConfig(
        grid=GridSpec(cell_size=0.2, x_max=3.0, x_min=-0.2, y_half=3.0),
        segments=SegmentSpec(max_segments=12),
        features=FeatureSpec(max_junctions=4, max_corners=6, max_walls=2),
        automaton_steps=12,
    ),
    filter=FilterConfig(max_landmarks=16, max_updates=4, max_new=4),
)


def drive() -> Variant:
    """Ten scans in the paper's room."""
    return Variant(
        "room",
        {},
        CONFIG,
        NoiseParams.for_simulated_robot(0.4, ENCODER_NOISE),
        Robot(encoder_noise=ENCODER_NOISE),
        worlds.named("fig07"),
        path_following.densify(np.array(WAYPOINTS)),
        NUM_SCANS,
    )


class Case(NamedTuple):
    """What is driven.

    Attributes:
        draw: Noise of trials, by their keys.
        score: Largest error [m] of each trial.
        threshold: [m] that a failure exceeds, by default.
        about: What the results depend on.
    """

    draw: Callable[[Key], Any]
    score: Callable[[Any], Any]
    threshold: float
    about: Any


def case_of(name: str) -> Case:
    """The drive with a name.

    Raises:
        ValueError: There is none.
    """
    if name == "landmarks":
        about = landmark_drive.WAYPOINTS, landmark_drive.NUM_SCANS
        return Case(landmark_drive.draw, landmark_drive.score, 0.059, about)
    if name != "scans":
        raise ValueError(f"--drive is {name!r}, not landmarks or scans")
    own = TrialsFromNoise(drive())
    return Case(own.draw, own.score, 0.0165, (CONFIG, ENCODER_NOISE, NUM_SCANS))


def numbers_of(found: RareFailure) -> common.Numbers:
    """Result of a splitting for JSON."""
    return {
        "probability": found.probability._asdict(),
        "relative_error": found.relative_error,
        "trials": found.num_trials,
        "plain_trials": found.plain_trials if found.reached else None,
        "levels": [level._asdict() for level in found.levels],
        "is_uncertain": found.is_uncertain,
        "line": describe(found),
    }


def split(
    case: Case, seed: int, number: int, threshold: float, level_trials: int
) -> common.Numbers:
    """Estimate by splitting; each number has other noise."""
    key = jax.random.fold_in(jax.random.key(seed), number)
    own: dict[str, Any] = {"threshold": threshold, "level_trials": level_trials}
    return numbers_of(rare_failure(key, case.draw, case.score, **own))


def plain(case: Case, seed: int, first: int, end: int) -> common.Numbers:
    """Scores of the plain trials with the numbers `first` to `end` - 1."""
    key, parts = jax.random.key(seed), []
    for begin in range(first, end, PLAIN_GROUP):
        numbers = jnp.arange(begin, min(begin + PLAIN_GROUP, end))
        parts.append(np.asarray(case.score(case.draw(trial_keys(key, numbers)))))
    return {"scores": [round(float(x), 6) for x in np.concatenate(parts)]}


def tail(scores: np.ndarray) -> common.Numbers:
    """Errors at which the share of plain trials above is a round number, and where it ends."""
    ordered = np.sort(scores)[::-1]
    counts = np.unique(np.geomspace(1, len(ordered), 120).astype(int))
    return {"error_m": ordered[counts - 1].tolist(), "share": (counts / len(ordered)).tolist()}


def compare(found: list[common.Numbers], scores: np.ndarray, threshold: float) -> common.Numbers:
    """The estimates beside the share of plain trials that fail."""
    failed = int(np.sum(~(scores <= threshold)))
    share = proportion(failed, len(scores))
    error = float(np.sqrt(share.value * (1.0 - share.value) / len(scores)))
    estimates = np.array([x["probability"]["value"] for x in found])
    errors = estimates * np.array([x["relative_error"] for x in found])
    covered = [x["probability"]["low"] <= share.value <= x["probability"]["high"] for x in found]
    return {
        "plain": {
            "trials": len(scores),
            "failed": failed,
            "probability": share._asdict(),
            "relative_error": error / share.value if failed else None,
            "tail": tail(scores),
        },
        "distance": ((estimates - share.value) / np.hypot(errors, error)).tolist(),
        "trials_ratio": len(scores) / float(np.mean([x["trials"] for x in found])),
        "mean": float(estimates.mean()),
        "mean_error": float(estimates.std(ddof=1) / np.sqrt(len(found)))
        if len(found) > 1
        else None,
        "relative_spread": float(estimates.std(ddof=1) / estimates.mean())
        if len(found) > 1
        else None,
        "intervals_that_hold": float(np.mean(covered)),
    }


def draw(numbers: common.Numbers, path: Path) -> None:
    """Draw the tail of the errors, and the estimates with their intervals."""
    figure, axes = common.canvas(10, 4, 1, 2, [3, 2])
    axis, beside = axes[0]
    own = numbers["compared"]["plain"]
    axis.plot(
        own["tail"]["error_m"], own["tail"]["share"], color=common.BLACK, label="plain trials"
    )
    for k, found in enumerate(numbers["splitting"]):
        levels = found["levels"]
        share = np.cumprod([x["share"] for x in levels])
        label = f"splitting, {found['trials']} trials or so" if k == 0 else None
        at = [x["threshold"] for x in levels]
        axis.plot(at, share, "o-", color=common.ORANGE, alpha=0.5, markersize=4, label=label)
    axis.axvline(numbers["threshold_m"], color=common.BLUE, linestyle=":", label="failure")
    axis.set(yscale="log", xlabel="largest position error of a drive [m]")
    axis.set(ylabel="share of drives above", xlim=(0.0, None))
    axis.legend()
    for k, found in enumerate(numbers["splitting"]):
        p = found["probability"]
        beside.plot([p["low"], p["high"]], [k, k], color=common.ORANGE)
        beside.plot(p["value"], k, "o", color=common.ORANGE)
    p = own["probability"]
    beside.axvspan(p["low"], p["high"], color=common.SKY, alpha=0.4)
    beside.axvline(p["value"], color=common.BLACK)
    common.log_scale(beside, "x")
    beside.set(xlabel=f"probability of more than {numbers['threshold_m']:g} m")
    beside.set(ylabel="repetition", title="95 % intervals; band: plain trials")
    figure.savefig(path)


@common.report_errors(NAME, ValueError)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment."""
    sizes = {"level_trials": 500, "repetitions": 8, "plain_trials": 100_000}
    arguments = common.parse(__doc__, argv, drive="landmarks", threshold=0.0, **sizes)
    use_cpu_devices()
    enable_caches()
    case, seed = case_of(arguments.drive), arguments.seed
    keep = common.ResultCache(arguments.out / f".{NAME}_{arguments.drive}", (seed, case.about))
    level = arguments.threshold or case.threshold, arguments.level_trials
    found = []
    for k in tqdm(range(arguments.repetitions), unit="splitting", leave=False):
        name = f"splitting {k} {level[0]:g} {level[1]}"
        found.append(keep(name, partial(split, case, seed, k, *level)))
        print(found[-1]["line"], flush=True)
    total, parts = arguments.plain_trials, []
    with tqdm(total=total, unit="trial", leave=False) as bar:
        for first in range(0, total, PLAIN_BATCH):
            end = min(first + PLAIN_BATCH, total)
            # Other noise than that of the splitting, whatever its seed.
            own = partial(plain, case, seed + 1_000_003, first, end)
            parts.append(keep(f"plain {first} {end}", own)["scores"])
            bar.update(end - first)
    scores = np.array([np.inf if x is None else x for x in np.concatenate(parts)])
    numbers = {
        "drive": arguments.drive,
        "threshold_m": level[0],
        "level_trials": level[1],
        "splitting": found,
        "compared": compare(found, scores, level[0]),
    }
    own = numbers["compared"]
    print(f"plain: {own['plain']['failed']} of {total} fail; distances {own['distance']}")
    common.save(arguments.out, NAME, numbers, draw)
    keep.clear()
    return 0


if __name__ == "__main__":
    sys.exit(main())
