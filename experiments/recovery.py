"""Whether tuning finds the noise that drives were made with, from wherever it starts.

Part of `experiments.tuning`. The drives are those of `experiments.exact`, for which the filter's
model is true. Each start is off in every parameter by a factor of its own, at most `FACTOR`.
"""

from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from experiments import common, exact
from jaxslam.core.episode import Episode
from jaxslam.evaluation import summary
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline import episodes
from jaxslam.tuning import fitting, parameters, standard_errors

FACTOR = 5.0
PACK, SOME = 32, 64  # runs of a step at first, then
ROUGH, MIDDLE, FINE = 40, 20, 12  # steps with these, and then with all


def compute(seed: int, starts: int, runs: int, heldout: int, kept: common.Kept) -> common.Numbers:
    """Tune from all starts on the same runs; compare the noise, and errors on other runs.

    Standard errors are those of the best of the fits, by its loss.
    """
    truth = exact.truth()
    logs = exact.drives(jax.random.key(seed), truth, runs=runs + heldout)
    train, test = (common.part(logs, part) for part in (slice(runs), slice(runs, None)))
    right = position_rmse(truth, test)
    rows = []
    with tqdm(total=starts, unit="start", desc="recovery", leave=False) as bar:
        for number in range(starts):
            rows.append(kept(f"start {number}", lambda n=number: _recover(seed, n, train, test)))
            bar.update()
    best = min(rows, key=lambda row: row["loss"])
    sure = kept(
        "standard errors", lambda: _errors(parameters.unflatten_params(best["theta"], truth), train)
    )
    se = np.array([np.nan if x is None else x for x in sure["relative"]])
    known = np.array(sure["identifiable"])
    off = np.array([row["theta"] for row in rows]) - parameters.flatten_params(truth)
    z = off[:, known] / se[known]
    ratio = np.array([row["heldout_rmse_m"] for row in rows]) / right
    return {
        "starts": starts,
        "runs": runs,
        "heldout": heldout,
        "within_3_se": int(np.sum(np.all(np.abs(z) < 3.0, axis=1))),
        "worst_z": float(np.abs(z).max()),
        "worst_heldout_ratio": float(ratio.max()),
        "heldout_rmse_true_noise_m": right,
        "names": sure["names"],
        "identifiable": sure["identifiable"],
        "standard_errors": sure["relative"],
        "warnings": sure["warnings"],
        "log_truth": parameters.flatten_params(truth),
        "rows": rows,
    }


def _recover(seed: int, number: int, train: Episode, test: Episode) -> common.Numbers:
    """Tune from a start drawn at random."""
    truth = parameters.flatten_params(exact.truth())
    reach = np.log(FACTOR)
    start = truth + np.random.default_rng([seed, number]).uniform(-reach, reach, truth.size)
    rough = fitting.tune(
        exact.CONFIG,
        parameters.unflatten_params(start, exact.truth()),
        train,
        num_updates=ROUGH,
        batch_size=PACK,
        seed=number,
    )
    near = fitting.tune(
        exact.CONFIG, rough.params, common.part(train, slice(SOME)), num_updates=MIDDLE
    )
    fine = fitting.tune(exact.CONFIG, near.params, train, num_updates=FINE)
    return {
        "start": start,
        "theta": parameters.flatten_params(fine.params),
        "loss": fine.loss[fine.best],
        "skipped": int(sum(one.skipped.sum() for one in (rough, near, fine))),
        "heldout_rmse_m": position_rmse(fine.params, test),
    }


def _errors(noise: NoiseParams, train: Episode) -> common.Numbers:
    sure = standard_errors.standard_errors(exact.CONFIG, noise, train)
    return {**sure._asdict()}


def position_rmse(noise: NoiseParams, logs: Episode) -> float:
    """Position RMSE [m] of the filter on drives [B]."""
    return summary.evaluate(episodes.filter_episodes(exact.CONFIG, noise, logs))["position_rmse_m"]


def draw(axis: Any, told: common.Numbers) -> None:
    """Where tuning ended, from all starts, in standard errors of each parameter."""
    off = np.array([row["theta"] for row in told["rows"]]) - np.array(told["log_truth"])
    start = np.array([row["start"] for row in told["rows"]]) - np.array(told["log_truth"])
    rng = np.random.default_rng(0)
    for i, sure in enumerate(told["identifiable"]):
        x = i + rng.uniform(-0.25, 0.25, len(off))
        axis.plot(x, np.exp(start[:, i]), "o", color=common.SKY, markersize=4, alpha=0.6)
        colour = common.GREEN if sure else common.ORANGE
        axis.plot(x, np.exp(off[:, i]), "D", color=colour, markersize=4)
        if sure:
            band = np.exp(3 * told["standard_errors"][i])
            axis.fill_between([i - 0.4, i + 0.4], 1 / band, band, color=common.BLACK, alpha=0.2)
    axis.axhline(1.0, color=common.BLACK, linewidth=0.8)
    for colour, marker, label in (
        (common.SKY, "o", "start"),
        (common.GREEN, "D", "found"),
        (common.ORANGE, "D", "found, told to be not identifiable"),
    ):
        axis.plot([], [], marker, color=colour, label=label)
    axis.fill_between([], [], color=common.BLACK, alpha=0.2, label="3 standard errors")
    low = min(0.15, *np.exp(off.min(axis=0)))
    axis.set(ylabel="noise / true noise", ylim=(max(low, 0.02), 8.0))
    common.plain_log(axis)
    axis.set_xticks(range(len(told["names"])), told["names"], rotation=30, ha="right")
    axis.set_title(f"{told['starts']} starts, {told['runs']} runs")
    axis.legend(fontsize="small")
