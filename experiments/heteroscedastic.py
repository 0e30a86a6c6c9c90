"""Noise that depends on incidence against constant noise, for a sensor whose noise grows with it.

Both are tuned by the likelihood of the innovations on the same drives through the office, and
compared on others: by that likelihood, by the errors of the pose, and by whether both are right at
all angles. In two worlds: drives for which the filter's model is true (`exact_model`, corners), and
simulated scans, whose range noise grows with incidence, through the whole front end. The same
command resumes where it was stopped.
"""

import sys
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from experiments import common, exact_model
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.episode import Episode, measurements_of
from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement
from jaxslam.core.types import CORNER, Array
from jaxslam.evaluation import consistency, summary
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.heteroscedastic import MeasurementWeights, incidence
from jaxslam.filtering.measurement_model import measure, predict_measurement, residual
from jaxslam.filtering.noise import NoiseParams, measurement_cov
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.features import FeatureSpec
from jaxslam.io.errors import InputError
from jaxslam.pipeline import episodes
from jaxslam.pipeline.config import Config
from jaxslam.simulation import trial_episodes
from jaxslam.tuning import fitting
from jaxslam.tuning.losses import innovation_nll, pose_nll

NAME = "heteroscedastic"
GROWTH = 1.5  # [1 / rad] of the logarithm of the standard deviation of a range
RANGE_STD = 0.005  # [m] of a corner at normal incidence
LANDMARKS = 64  # capacity of the map of the simulated scans
BINS = 6  # of incidence, with equal numbers of features
# The walls of `exact_model` have no incidence; only its corners have.
FROZEN = ("measurement_weights.incidence[2]",)


class Task(NamedTuple):
    """What both kinds of noise are tuned on.

    Attributes:
        config: Its filter is tuned.
        start: Constant noise.
        weights: Those of the noise that depends on the step, at first.
        train: [B] episodes.
        test: [H] episodes.
        frozen: Names of parameters that are not tuned.
        batch_size: Episodes of an update. Where data association changes with the noise, the loss
            jumps, which stops a line search on all episodes; minibatches go on.
    """

    config: Config
    start: NoiseParams
    weights: MeasurementWeights
    train: Episode
    test: Episode
    frozen: tuple[str, ...]
    batch_size: int | None = None


def true_params() -> NoiseParams:
    """Q and R of the drives for which the model is true."""
    growth = jnp.array([GROWTH, 0.0, 0.0])
    return exact_model.true_params()._replace(
        range_std=jnp.asarray(RANGE_STD, float),
        measurement_weights=MeasurementWeights(incidence=growth),
    )


def exact(seed: int, num_trials: int, num_heldout: int, num_scans: int | None) -> Task:
    """Drives for which the noise that depends on incidence is the true one."""
    drives = exact_model.drives(
        jax.random.key(seed),
        true_params(),
        num_trials=num_trials + num_heldout,
        num_scans=num_scans,
        corners=True,
    )
    return Task(
        exact_model.CORNER_CONFIG,
        exact_model.true_params(),
        MeasurementWeights(incidence=jnp.zeros(3)),
        common.take(drives, slice(num_trials)),
        common.take(drives, slice(num_trials, None)),
        FROZEN,
    )


def scans(seed: int, num_trials: int, num_heldout: int, num_scans: int | None) -> Task:
    """Simulated scans whose range noise grows with incidence, and the features found in them."""
    spec = FeatureSpec(incidence=True)
    config = Config(
        frontend=FrontendConfig(features=spec), filter=FilterConfig(max_landmarks=LANDMARKS)
    )
    drives = trial_episodes.simulate_episodes(
        jax.random.key(seed),
        config,
        num_trials=num_trials + num_heldout,
        num_scans=num_scans,
        noise_by_incidence=GROWTH,
    )
    zero = jnp.zeros(3)
    return Task(
        config,
        NoiseParams.for_simulated_robot(),
        MeasurementWeights(incidence=zero, range=zero, clearance=zero),
        common.take(drives, slice(num_trials)),
        common.take(drives, slice(num_trials, None)),
        ("measurement_weights.range[2]", "measurement_weights.clearance[2]"),  # not of walls
        batch_size=max(1, num_trials // 2),
    )


WORLDS = {"exact": exact, "scans": scans}


def compare(name: str, task: Task, num_updates: int, cache: common.ResultCache) -> common.Numbers:
    """Tune both kinds of noise; their scores on the held-out drives, and the difference."""
    found: common.Numbers = {}
    noises = {
        "constant": task.start,
        "incidence": task.start._replace(measurement_weights=task.weights),
    }
    for kind, start in noises.items():
        numbers = cache(f"{name} {kind}", partial(_tune, task, start, num_updates))
        params = _unravel(start, numbers["params"])
        scores = cache(f"{name} {kind} scores", partial(_score, task, params))
        found[kind] = numbers | scores
    for loss in ("innovation_nll", "pose_nll"):
        gain = np.array(found["constant"][loss]) - np.array(found["incidence"][loss])
        found[f"{loss}_gain"] = _mean(gain)
    return found


def _tune(task: Task, start: NoiseParams, num_updates: int) -> common.Numbers:
    frozen = task.frozen if start.measurement_weights is not None else ()
    result = fitting.tune(
        task.config,
        start,
        task.train,
        loss=innovation_nll,
        num_updates=num_updates,
        batch_size=task.batch_size,
        frozen=frozen,
    )
    return {"params": ravel_pytree(result.params)[0], "loss": result.loss}


def _unravel(like: NoiseParams, numbers: list[float]) -> NoiseParams:
    flat, unravel = ravel_pytree(like)
    return unravel(jnp.asarray(numbers, flat.dtype))


def _score(task: Task, params: NoiseParams) -> common.Numbers:
    """Losses (H,) of the held-out drives, errors of the pose, and NEES over incidence."""
    results = jax.tree.map(np.asarray, episodes.filter_episodes(task.config, params, task.test))
    metrics = summary.evaluate(results)
    nees = consistency.nees(consistency.pose_error(results.estimate, results.truth), results.cov)
    angle = np.asarray(_step_incidence(task.test.features))
    known = np.isfinite(np.asarray(nees)) & np.isfinite(angle)
    known[:, 0] = False  # the first pose is known exactly
    return {
        "innovation_nll": fitting.values(task.config, params, task.test, innovation_nll),
        "pose_nll": fitting.values(task.config, params, task.test, pose_nll),
        "position_rmse_m": metrics["position_rmse_m"],
        "pose_nees_per_dof": _mean(np.nanmean(np.where(known, nees, np.nan), axis=1) / 3),
        "pose_nees_over_incidence": _over_incidence(angle, np.asarray(nees) / 3, known),
    } | _range_scores(task, params)


@jax.jit
def _step_incidence(features: Features) -> Array:
    """Mean incidence (B, T) [rad] of the features that have one; NaN where there is none."""
    angle = jax.vmap(jax.vmap(incidence))(features)
    known = features.valid & (angle > 0.0)
    count = jnp.sum(known, axis=-1)
    mean = jnp.sum(jnp.where(known, angle, 0.0), axis=-1) / jnp.maximum(count, 1)
    return jnp.where(count > 0, mean, jnp.nan)


def _range_scores(task: Task, params: NoiseParams) -> common.Numbers:
    """Squared range errors of corners over their variance in R; where landmarks are known."""
    if task.test.landmark_ids is None:
        return {}
    angle, square, known = map(np.asarray, _range_errors(params, task.test))
    flat = [x.reshape(len(x), -1) for x in (angle, square, known)]
    return {"range_nees_over_incidence": _over_incidence(*flat)}


@jax.jit
def _range_errors(params: NoiseParams, drives: Episode) -> tuple[Array, Array, Array]:
    """Incidence, squared normalised range error, and whether it is a corner; (B, T, M)."""
    positions = jnp.asarray(exact_model.landmark_positions(), drives.truth.dtype)

    def of_scan(truth: Array, given: Measurement) -> tuple[Array, Array, Array]:
        features = given.features
        assert given.landmark_ids is not None
        is_corner = features.valid & (features.kind == CORNER)
        own = positions[jnp.where(is_corner, given.landmark_ids, 0)]
        predict = jax.vmap(predict_measurement, in_axes=(None, 0, 0))
        error = residual(measure(features), predict(truth, own, features.kind)[0], features.kind)
        R = measurement_cov(params, features, given)
        return incidence(features), error[:, 0] ** 2 / R[:, 0, 0], is_corner

    return jax.vmap(jax.vmap(of_scan))(drives.truth, measurements_of(drives))


def _over_incidence(angle: np.ndarray, values: np.ndarray, known: np.ndarray) -> common.Numbers:
    """Mean of values (B, N) in bins of the angle (B, N), with standard errors over drives."""
    edges = np.quantile(angle[known], np.linspace(0, 1, BINS + 1))
    edges = np.unique(edges)
    rows = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        inside = known & (angle >= low) & ((angle < high) | (high == edges[-1]))
        count = inside.sum(axis=1)
        each = np.where(inside, values, 0.0).sum(axis=1)[count > 0] / count[count > 0]
        rows.append({"from_rad": low, "to_rad": high} | _mean(each))
    return {"bins": rows}


def _mean(values: np.ndarray) -> common.Numbers:
    """Mean of one number per drive, its standard error, and their ratio."""
    values = values[np.isfinite(values)]
    error = values.std(ddof=1) / np.sqrt(len(values))
    return {"mean": values.mean(), "standard_error": error, "z": values.mean() / error}


def draw(numbers: common.Numbers, path: Path) -> None:
    """NEES over incidence of both kinds of noise, in each world."""
    shown = [name for name in WORLDS if name in numbers]
    figure, axes = common.canvas(6.0 * len(shown), 4.2, 1, len(shown))
    for axis, name in zip(axes[0], shown, strict=True):
        key = "range_nees_over_incidence" if name == "exact" else "pose_nees_over_incidence"
        _draw_nees(axis, numbers[name], key)
        gain = numbers[name]["innovation_nll_gain"]
        axis.set_title(f"{name}: {gain['mean']:.3f} nats per scalar, z = {gain['z']:.0f}")
    figure.savefig(path)


def _draw_nees(axis: Any, found: common.Numbers, key: str) -> None:
    for kind, colour in (("constant", common.ORANGE), ("incidence", common.GREEN)):
        rows = found[kind][key]["bins"]
        middle = [np.degrees(row["from_rad"] + row["to_rad"]) / 2 for row in rows]
        mean, error = ([row[name] for row in rows] for name in ("mean", "standard_error"))
        bars = 2 * np.array(error)  # two standard errors
        axis.errorbar(middle, mean, bars, fmt="o-", color=colour, label=kind)
    axis.axhline(1.0, color=common.BLACK, linewidth=0.8)
    common.log_scale(axis)
    axis.set(xlabel="incidence [degrees]", ylabel=key.split("_over")[0].replace("_", " "))
    axis.legend(fontsize="small")


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    args = common.parse(
        __doc__, argv, runs=32, heldout=64, scans=0, updates=25, worlds="exact,scans"
    )
    worlds = args.worlds.split(",")
    if not set(worlds) <= set(WORLDS):
        raise InputError(
            f"is {args.worlds!r}", field="--worlds", advice="give exact, scans or both"
        )
    use_cpu_devices()
    enable_caches()
    about = {key: str(value) for key, value in vars(args).items() if key != "out"}
    cache = common.ResultCache(args.out / f"{NAME}_parts", about)
    count = args.scans or None
    numbers: common.Numbers = {"seed": args.seed, "growth": GROWTH}
    for name in worlds:
        task = WORLDS[name](args.seed, args.runs, args.heldout, count)
        numbers[name] = compare(name, task, args.updates, cache)
    common.save(args.out, NAME, numbers, draw)
    cache.clear()
    for name in worlds:
        print(line(name, numbers[name]))
    return 0


def line(name: str, found: common.Numbers) -> str:
    """The results of one world in a few lines of text."""
    text = []
    for loss in ("innovation_nll", "pose_nll"):
        gain = found[f"{loss}_gain"]
        text.append(
            f"{name}: {loss} better by {gain['mean']:.4f} +- {gain['standard_error']:.4f} "
            f"({gain['z']:.1f} standard errors)"
        )
    for kind in ("constant", "incidence"):
        own = found[kind]
        nees = own["pose_nees_per_dof"]
        text.append(
            f"  {kind:10} RMSE {100 * own['position_rmse_m']:.3f} cm, pose NEES per dof "
            f"{nees['mean']:.2f} +- {nees['standard_error']:.2f}"
        )
        for key in ("range_nees_over_incidence", "pose_nees_over_incidence"):
            if key in own:
                bins = [
                    f"{row['mean']:.2f}+-{row['standard_error']:.2f}" for row in own[key]["bins"]
                ]
                text.append(f"    {key}: {' '.join(bins)}")
    return "\n".join(text)


if __name__ == "__main__":
    sys.exit(main(None))
