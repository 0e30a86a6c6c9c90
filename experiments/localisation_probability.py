"""Localisation in a saved map: how its probability was fitted, and whether it holds.

Each log of the folder `--data` is mapped to its middle, and `--starts` robots start anywhere in the
rest and drive on for 60 scans, many of them where the map shows nothing, or what looks the same. A
pose is right within `probability.RIGHT` of the reference, or of the smoothed trajectory of a log
without one. The model is fitted to all logs but one, each of the same weight, by most likelihood
with wrong poses counted `WRONG_WEIGHT` times, and compared with what is right on the one left out;
`coefficients` are those of all. Steps are not independent, so the intervals are too narrow.
"""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import common, log_folder
from experiments.common import Numbers
from experiments.map_warnings import wilson_interval
from jaxslam.core.caches import enable_caches
from jaxslam.core.scan import Lidar
from jaxslam.core.se2_np import compose, relative
from jaxslam.core.time_series import match_times
from jaxslam.io.errors import InputError
from jaxslam.localisation import LocaliseSpec, init, map_of_scans, run_steps
from jaxslam.localisation.hypotheses import widest_std
from jaxslam.localisation.probability import RIGHT, features
from jaxslam.matching import scan_matching
from jaxslam.pipeline import log_input, odometry_notes

NAME, SPEC = "localisation_probability", LocaliseSpec()
LENGTH, SURE, WRONG_WEIGHT = 60, 0.9, 3.0  # scans of a robot; probability of a pose that is sure
BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.9, 0.95, 0.99)  # lower edges
RIDGE = 1e-4  # of the coefficients: they stay finite where right and wrong are separate
COLOURS = (common.BLUE, common.RED, common.GREEN, common.ORANGE, common.PINK, common.SKY)
Answers = tuple[np.ndarray, np.ndarray]  # 1 and features (N, 1 + F) of poses; if right (N,)


@partial(jax.jit, static_argnums=0)
def _localise(lidar: Lidar, place_map, scans, odometry):
    """Features (B, T, F) and poses (B, T, 3) of robots, and where there is one (B, T)."""

    def one(given):
        info = run_steps(SPEC, lidar, place_map, init(SPEC, lidar), *given, jnp.int32(LENGTH))[1]
        std = jax.vmap(widest_std)(info.cov)
        values = jax.vmap(features)(info.log_odds, info.path_score, info.windows, std)
        return values, info.pose, info.num_hypotheses > 0

    return jax.lax.map(one, (scans, odometry))


def trials(rng: np.random.Generator, log: log_folder.Log, starts: int) -> Answers:
    """Answers at all steps of all robots that have a pose, and a true one."""
    given = log_input.from_laser_log(log.laser_log)
    scans, count = jax.tree.map(np.asarray, given.scans), len(given.increments)
    lidar, half = given.config.frontend.lidar, count // 2
    cut: Any = {k: x[:half] for k, x in given._asdict().items() if isinstance(x, np.ndarray)}
    first = given._replace(**cut, scans=jax.tree.map(lambda x: x[:half], scans))
    mapped = np.asarray(log_input.run(first).poses, float)
    place_map = map_of_scans(SPEC, lidar, mapped, first.scans)
    odometry, guessed, _ = odometry_notes.share_out(given.increments, scans, given.after_pause)
    wheels = (
        scan_matching.empty_submap(options := given.config.scan_matching, lidar),
        scans,
        odometry,
    )
    matches = scan_matching.match_scans(options, lidar, *wheels, guessed=guessed)[1]
    odometry = np.asarray(matches.increment, float)
    if log.reference is None:
        true = np.asarray(log_input.run(given).poses, float)
    else:
        true = np.full((count, 3), np.nan)
        pairs = match_times(log.laser_log.times, log.reference[0])
        true[pairs[:, 0]] = log.reference[1][pairs[:, 1]]
    off = relative(true[None, :half], true[:, None])
    far = np.hypot(off[..., 0], off[..., 1]) + 0.3 * np.abs(off[..., 2])
    nearest = np.argmin(np.where(np.isfinite(far), far, np.inf), axis=1)
    true = compose(mapped[nearest], off[np.arange(count), nearest])
    rows = rng.integers(half, count - 8, starts)[:, None] + np.arange(LENGTH)
    at = np.minimum(rows, count - 1)
    moved = odometry[at] * (np.arange(LENGTH) > 0)[:, None]
    seen = jax.tree.map(lambda x: jnp.asarray(x[at]), scans)
    values, poses, some = _localise(lidar, place_map, seen, jnp.asarray(moved, float))
    off = relative(true[at], np.asarray(poses, float))
    right = (np.hypot(off[..., 0], off[..., 1]) < RIGHT[0]) & (np.abs(off[..., 2]) < RIGHT[1])
    used = np.asarray(some) & (rows < count) & np.isfinite(off).all(axis=-1)
    return np.insert(np.asarray(values, float)[used], 0, 1.0, axis=1), right[used]


def fit(logs: list[Answers]) -> np.ndarray:
    """Coefficients (1 + F,) of most likelihood, the constant first; by Newton's method."""
    values, right = (np.concatenate(x) for x in zip(*logs, strict=True))
    weight = np.concatenate([np.full(len(y), 1.0 / len(y) / len(logs)) for _, y in logs])
    weight *= np.where(right, 1.0, WRONG_WEIGHT)
    found = np.zeros(values.shape[1])
    for _ in range(200):
        chance = _chance(found, values)
        slope = values.T @ (weight * (right - chance)) - RIDGE * found
        curvature = (values * (weight * chance * (1.0 - chance))[:, None]).T @ values
        found += np.linalg.solve(curvature + RIDGE * np.eye(len(found)), slope).clip(-5.0, 5.0)
    return found


def _chance(coefficients: np.ndarray, values: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-(values @ coefficients).clip(-40.0, 40.0)))


def compare(coefficients: np.ndarray, answers: Answers) -> Numbers:
    """Shares that are right by probability, and those that are sure and wrong."""
    chance, right = _chance(coefficients, answers[0]), answers[1]
    number, bins = np.searchsorted(BINS, chance, side="right"), []
    for k, low in enumerate(BINS, 1):
        own = number == k
        share = {"mean": chance[own].mean(), "right": right[own].mean()} if own.any() else {}
        bins.append({"from": low, "steps": own.sum()} | share)
    sure = chance > SURE
    wrong, total = int((sure & ~right).sum()), int(sure.sum())
    counts = {"sure": total, "wrong": wrong, "interval": wilson_interval(wrong, total)}
    shares = {"wrong_share": wrong / max(total, 1), "sure_of_right": sure[right].mean()}
    return {"coefficients": coefficients, "bins": bins} | counts | shares


def draw(numbers: Numbers, path: Path) -> None:
    """Observed shares of right poses by probability, for each log that was left out."""
    figure, axes = common.canvas(5.0, 4.5, 1, 1)
    axes[0, 0].plot([0, 1], [0, 1], ":", color=common.BLACK)
    for colour, (name, log) in zip(COLOURS, numbers["left_out"].items(), strict=False):
        points = [(one["mean"], one["right"]) for one in log["bins"] if one["steps"] >= 30]
        axes[0, 0].plot(*zip(*points, strict=True), "o-", color=colour, label=name)
    axes[0, 0].set(xlabel="probability", ylabel="share of poses that are right")
    axes[0, 0].legend(frameon=False)
    figure.savefig(path)


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Write localisation_probability.json and .png."""
    args = common.parse(__doc__, argv, data="", starts=200)
    enable_caches()
    found = log_folder.find_logs(log_folder.checked_folder(args.data), installed=False)
    logs = {log.name: log for log in found[::-1] if log.laser_log.lidar.num_beams > 1}
    if len(logs) < 2:
        raise InputError("has fewer than 2 logs", path=args.data, advice="name a folder of logs")
    answers, left_out = {}, {}
    for number, (name, log) in enumerate(tqdm(sorted(logs.items()), desc="logs")):
        answers[name] = trials(np.random.default_rng([args.seed, number]), log, args.starts)
    for name, own in answers.items():
        left_out[name] = compare(fit([x for x in answers.values() if x is not own]), own)
    of_all = fit(list(answers.values()))
    numbers = {"seed": args.seed, "coefficients": of_all, "left_out": left_out}
    common.save(args.out, NAME, numbers, draw)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
