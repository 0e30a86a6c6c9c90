"""What each loss determines of the noise: true noise recovered, and what errors of the model do.

Drives through the office as of `experiments.exact_model`, whose noise is known, and the same drives
with an error that the filter's model does not have: a share of the measurements is far off (heavy
tails); the odometry counts 3 % too much (scale); the range has a second error that lasts for some
time (lasting). Each loss is minimised from the same start, off by a factor of two in all of the
noise; the result is compared with the true noise, in standard errors, and evaluated on other
drives. With `--mrclam FOLDER` also on the robots of that data set, two held out from the other
three, five times. The same command resumes where it was stopped.
"""

import sys
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import common, exact_model
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.episode import Episode
from jaxslam.core.types import JUNCTION
from jaxslam.evaluation import summary
from jaxslam.filtering.noise import NoiseParams
from jaxslam.io import mrclam
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.tuning import BY_NAME, fitting, nis_consistency, parameters, standard_errors

NAME = "identifiability"
UPDATES = 25
START = 2.0  # factor on the true noise, alternately up and down
FAR_SHARE, FAR_STD = 0.03, 0.1  # of the measurements that are far off; [m] by how much
SCALE = 1.03  # of the odometry's distances
LASTING_STD, LASTING_STEPS = 0.03, 20  # [m] and steps, of an error of the range that lasts
STUDENT_DOF = 4.0  # of the filter that is tuned on MRCLAM
ROBOTS = (1, 2, 3, 4, 5)
HELD_OUT = ((4, 5), (2, 3), (1, 4), (3, 5), (1, 2))  # each robot twice
RECORDED_LOSSES = "pose_nll", "closure_nll", "prediction_nll", "innovation_nll"
LOSSES = {**BY_NAME, "nis_consistency": nis_consistency}
COLOURS = dict(
    zip(
        LOSSES,
        (common.BLACK, common.SKY, common.PINK, common.GREEN, common.ORANGE, common.BLUE),
        strict=False,
    )
)


def with_far_measurements(drives: Episode, seed: int) -> Episode:
    """Drives of which a share of the measurements of points is off by metres' tenths."""
    rng = np.random.default_rng([seed, 1])
    xy = np.array(drives.features.xy)
    is_far = (rng.random(xy.shape[:-1]) < FAR_SHARE) & _points(drives)
    moved = xy + np.where(is_far[..., None], rng.normal(0.0, FAR_STD, xy.shape), 0.0)
    return drives._replace(features=drives.features._replace(xy=moved.astype(xy.dtype)))


def with_scale(drives: Episode, seed: int) -> Episode:
    """Drives whose odometry counts too much."""
    del seed
    odometry = np.array(drives.odometry)
    odometry[..., :2] *= SCALE
    return drives._replace(odometry=odometry)


def with_lasting_errors(drives: Episode, seed: int) -> Episode:
    """Drives whose ranges have an error of each landmark, a Markov process of `LASTING_STEPS`."""
    rng = np.random.default_rng([seed, 2])
    ids, xy = np.asarray(drives.landmark_ids), np.array(drives.features.xy)
    count, steps = ids.shape[:2]
    size = ids.max() + 1
    keep = np.exp(-1.0 / LASTING_STEPS)
    error = np.empty((count, steps, size))
    error[:, 0] = rng.normal(0.0, LASTING_STD, (count, size))
    for t in range(1, steps):
        fresh = rng.normal(0.0, LASTING_STD * np.sqrt(1.0 - keep**2), (count, size))
        error[:, t] = keep * error[:, t - 1] + fresh
    own = np.take_along_axis(error, np.maximum(ids, 0), axis=2)
    distance = np.maximum(np.linalg.norm(xy, axis=-1), 1e-6)
    factor = 1.0 + np.where(_points(drives), own / distance, 0.0)
    return drives._replace(
        features=drives.features._replace(xy=(xy * factor[..., None]).astype(xy.dtype))
    )


def _points(drives: Episode) -> np.ndarray:
    """Features (B, T, M) bool that are points."""
    return np.asarray(drives.features.valid & (drives.features.kind == JUNCTION))


ERRORS = {
    "exact": lambda drives, seed: drives,
    "heavy tails": with_far_measurements,
    "scale": with_scale,
    "lasting": with_lasting_errors,
}


def evaluate(config: Config, params: NoiseParams, drives: Episode) -> common.Numbers:
    """Errors of the filter on drives [B]."""
    found = summary.evaluate(episodes.filter_episodes(config, params, drives))
    return {key: found[key] for key in ("position_rmse_m", "heading_rmse_deg", "nees")}


def recover(loss: str, train: Episode, test: Episode) -> common.Numbers:
    """Noise by a loss, beside the true one, with its standard errors and what it is good for."""
    truth = exact_model.true_params()
    exact = parameters.flatten_params(truth)
    off = np.log(START) * np.where(np.arange(exact.size) % 2, -1.0, 1.0)
    start = parameters.unflatten_params(exact + off, truth)
    config = exact_model.CONFIG
    found = fitting.tune(config, start, train, loss=LOSSES[loss], num_updates=UPDATES)
    sure = standard_errors.standard_errors(config, found.params, train, loss=LOSSES[loss])
    return {
        "log_ratio": parameters.flatten_params(found.params) - exact,
        "standard_errors": sure.relative,
        "identifiable": sure.identifiable,
        "skipped": int(found.skipped.sum()),
        "evaluations": len(found.loss),
        **evaluate(config, found.params, test),
    }


def tune_robots(
    config: Config, robots: list[Episode], loss: str, held: tuple[int, ...]
) -> common.Numbers:
    """Noise by a loss from three robots of MRCLAM, evaluated on the two that are held out."""
    train = [robots[i - 1] for i in ROBOTS if i not in held]
    test = episodes.stack_episodes([robots[i - 1] for i in held])
    start = NoiseParams.for_landmark_sensor()._replace(student_dof=jnp.asarray(STUDENT_DOF, float))
    found = fitting.tune(
        config,
        start,
        episodes.stack_episodes(train),
        loss=loss,
        num_updates=UPDATES,
        frozen=("wall_angle_std", "student_dof"),
    )
    numbers = evaluate(config, found.params, test)
    return numbers | {"theta": parameters.flatten_params(found.params), "held": held}


def draw(numbers: common.Numbers, path: Path) -> None:
    """Noise found over true noise by each loss, with three standard errors, for each error."""
    rows = numbers["rows"]
    kinds = list(dict.fromkeys(row["error"] for row in rows))
    figure, axes = common.canvas(11, 3.0 * len(kinds), len(kinds), 1)
    for axis, kind in zip(axes[:, 0], kinds, strict=True):
        own = [row for row in rows if row["error"] == kind]
        for k, row in enumerate(own):
            ratio = np.array(row["log_ratio"])
            width = np.array([np.nan if x is None else x for x in row["standard_errors"]])
            x = np.arange(ratio.size) + 0.7 * (k + 0.5) / len(own) - 0.35
            good = np.array(row["identifiable"])
            colour = COLOURS[row["loss"]]
            low, high = np.exp(ratio - 3 * width), np.exp(ratio + 3 * width)
            axis.vlines(x[good], low[good], high[good], color=colour, linewidth=3, alpha=0.4)
            axis.plot(x[good], np.exp(ratio[good]), "D", color=colour, markersize=4)
            clipped = np.clip(np.exp(ratio[~good]), 0.06, 15.0)
            axis.plot(x[~good], clipped, "x", color=colour, markersize=4)
            if kind == kinds[0]:
                axis.plot([], [], "D", color=colour, label=row["loss"])
        axis.axhline(1.0, color=common.BLACK, linewidth=0.8)
        axis.set(ylim=(0.05, 20.0), ylabel="noise / true noise", title=kind)
        common.log_scale(axis)
        short = [name.replace("_coefficients", " ") for name in numbers["names"]]
        axis.set_xticks(range(len(short)), short)
    axes[0, 0].plot([], [], "x", color=common.BLACK, label="not identifiable")
    axes[0, 0].legend(fontsize="small", ncols=4)
    figure.savefig(path)


def _line(row: common.Numbers) -> str:
    """A row of the printed table."""
    nees = np.nan if row["nees"] is None else row["nees"]
    position, heading = row["position_rmse_m"], row["heading_rmse_deg"]
    return f"{position:.4f} m  {heading:.2f} deg  NEES per dof {nees:.2f}"


def _simulated(args: Any, cache: common.ResultCache) -> list[common.Numbers]:
    """A row for each loss and each error of the model."""
    truth = exact_model.true_params()
    total = args.runs + args.heldout
    drives = exact_model.drives(
        jax.random.key(args.seed), truth, num_trials=total, num_scans=args.scans or None
    )
    rows = []
    work = [(loss, error) for loss in LOSSES for error in ERRORS]
    for loss, error in tqdm(work, leave=False, unit="tuning"):
        hurt = ERRORS[error](drives, args.seed)
        parts = [common.take(hurt, part) for part in (slice(args.runs), slice(args.runs, total))]
        row = cache(f"{loss} {error}", partial(recover, loss, *parts))
        rows.append({"loss": loss, "error": error} | row)
        z = np.array(row["log_ratio"]) / np.array(
            [np.nan if x is None else x for x in row["standard_errors"]]
        )
        good = np.array(row["identifiable"])
        worst = np.abs(z[good]).max() if good.any() else np.nan
        known = f"identifiable {good.sum()} of {good.size}, largest z {worst:6.1f}"
        print(f"{error:12} {loss:16} {known}  {_line(row)}", flush=True)
    return rows


def _recorded(folder: Path, cache: common.ResultCache) -> list[common.Numbers]:
    """A row for each loss and each two robots that are held out."""
    logs = [mrclam.read(folder, robot) for robot in ROBOTS]
    robots = [episodes.episode_from_landmark_log(log) for log in logs]
    config, rows = episodes.landmark_log_config(logs), []
    for held in HELD_OUT:
        for loss in RECORDED_LOSSES:
            name = f"mrclam {loss} {held[0]} {held[1]}"
            row = cache(name, partial(tune_robots, config, robots, loss, held))
            rows.append({"loss": loss} | row)
            print(f"held out {held}  {loss:16} {_line(row)}", flush=True)
    return rows


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    args = common.parse(__doc__, argv, runs=64, heldout=32, scans=0, mrclam="")
    use_cpu_devices()
    enable_caches()
    about = {key: str(value) for key, value in vars(args).items() if key not in ("out", "mrclam")}
    cache = common.ResultCache(args.out / f"{NAME}_parts", about)
    names = parameters.param_names(exact_model.true_params())
    numbers = {"seed": args.seed, "runs": args.runs, "heldout": args.heldout, "names": names}
    numbers["rows"] = _simulated(args, cache)
    numbers["recorded"] = _recorded(Path(args.mrclam), cache) if args.mrclam else []
    common.save(args.out, NAME, numbers, draw)
    cache.clear()
    return 0


if __name__ == "__main__":
    sys.exit(main())
