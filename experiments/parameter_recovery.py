"""Whether tuning recovers the noise parameters that drives were simulated with, from any start.

Part of `experiments.tuning`. The drives are those of `experiments.exact_model`, for which the
filter's model is true. Each start is off in every parameter by its own factor, at most `FACTOR`.
"""

from functools import partial
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from experiments import common, exact_model
from jaxslam.core.episode import Episode
from jaxslam.evaluation import summary
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline import episodes
from jaxslam.tuning import fitting, parameters, standard_errors

FACTOR = 5.0
FIRST_BATCH, SECOND_BATCH = 32, 64  # trials of an update at first, then
UPDATES = (40, 20, 12)  # with these, and then with all trials


def compute(
    seed: int, num_starts: int, num_trials: int, num_heldout: int, cache: common.ResultCache
) -> common.Numbers:
    """Tune from all starts on the same trials; compare parameters, and errors on other trials.

    Standard errors are those of the best result, by its loss.
    """
    truth = exact_model.true_params()
    drives = exact_model.drives(jax.random.key(seed), truth, num_trials=num_trials + num_heldout)
    train = common.take(drives, slice(num_trials))
    test = common.take(drives, slice(num_trials, None))
    true_rmse = position_rmse(truth, test)
    rows = []
    with tqdm(total=num_starts, unit="start", desc="recovery", leave=False) as bar:
        for number in range(num_starts):
            rows.append(cache(f"start {number}", partial(_recover, seed, number, train, test)))
            bar.update()
    best = min(rows, key=lambda row: row["loss"])
    params = parameters.unflatten_params(best["theta"], truth)
    errors = cache("standard errors", partial(_errors, params, train))
    se = np.array([np.nan if x is None else x for x in errors["relative"]])
    identifiable = np.array(errors["identifiable"])
    off = np.array([row["theta"] for row in rows]) - parameters.flatten_params(truth)
    z = off[:, identifiable] / se[identifiable]
    ratio = np.array([row["heldout_rmse_m"] for row in rows]) / true_rmse
    return {
        "starts": num_starts,
        "runs": num_trials,
        "heldout": num_heldout,
        "within_3_se": int(np.sum(np.all(np.abs(z) < 3.0, axis=1))),
        "worst_z": float(np.abs(z).max()),
        "worst_heldout_ratio": float(ratio.max()),
        "heldout_rmse_true_noise_m": true_rmse,
        "names": errors["names"],
        "identifiable": errors["identifiable"],
        "standard_errors": errors["relative"],
        "warnings": errors["warnings"],
        "log_truth": parameters.flatten_params(truth),
        "rows": rows,
    }


def _recover(seed: int, number: int, train: Episode, test: Episode) -> common.Numbers:
    """Tune from a random start."""
    truth = parameters.flatten_params(exact_model.true_params())
    reach = np.log(FACTOR)
    start = truth + np.random.default_rng([seed, number]).uniform(-reach, reach, truth.size)
    rough = fitting.tune(
        exact_model.CONFIG,
        parameters.unflatten_params(start, exact_model.true_params()),
        train,
        num_updates=UPDATES[0],
        batch_size=FIRST_BATCH,
        seed=number,
    )
    near = fitting.tune(
        exact_model.CONFIG,
        rough.params,
        common.take(train, slice(SECOND_BATCH)),
        num_updates=UPDATES[1],
    )
    fine = fitting.tune(exact_model.CONFIG, near.params, train, num_updates=UPDATES[2])
    return {
        "start": start,
        "theta": parameters.flatten_params(fine.params),
        "loss": fine.loss[fine.best],
        "skipped": int(sum(one.skipped.sum() for one in (rough, near, fine))),
        "heldout_rmse_m": position_rmse(fine.params, test),
    }


def _errors(params: NoiseParams, train: Episode) -> common.Numbers:
    found = standard_errors.standard_errors(exact_model.CONFIG, params, train)._asdict()
    return {key: value for key, value in found.items() if key != "of_params"}


def position_rmse(params: NoiseParams, drives: Episode) -> float:
    """Position RMSE [m] of the filter on drives [B]."""
    results = episodes.filter_episodes(exact_model.CONFIG, params, drives)
    return summary.evaluate(results)["position_rmse_m"]


def draw(axis: Any, numbers: common.Numbers) -> None:
    """The results of tuning from all starts, with three standard errors of each parameter."""
    off = np.array([row["theta"] for row in numbers["rows"]]) - np.array(numbers["log_truth"])
    start = np.array([row["start"] for row in numbers["rows"]]) - np.array(numbers["log_truth"])
    rng = np.random.default_rng(0)
    for i, identifiable in enumerate(numbers["identifiable"]):
        x = i + rng.uniform(-0.25, 0.25, len(off))
        axis.plot(x, np.exp(start[:, i]), "o", color=common.SKY, markersize=4, alpha=0.6)
        colour = common.GREEN if identifiable else common.ORANGE
        axis.plot(x, np.exp(off[:, i]), "D", color=colour, markersize=4)
        if identifiable:
            band = np.exp(3 * numbers["standard_errors"][i])
            axis.fill_between([i - 0.4, i + 0.4], 1 / band, band, color=common.BLACK, alpha=0.2)
    axis.axhline(1.0, color=common.BLACK, linewidth=0.8)
    for colour, marker, label in (
        (common.SKY, "o", "start"),
        (common.GREEN, "D", "found"),
        (common.ORANGE, "D", "found, not identifiable"),
    ):
        axis.plot([], [], marker, color=colour, label=label)
    axis.fill_between([], [], color=common.BLACK, alpha=0.2, label="3 standard errors")
    low = min(0.15, *np.exp(off.min(axis=0)))
    axis.set(ylabel="noise / true noise", ylim=(max(low, 0.02), 8.0))
    common.log_scale(axis)
    axis.set_xticks(range(len(numbers["names"])), numbers["names"], rotation=30, ha="right")
    axis.set_title(f"{numbers['starts']} starts, {numbers['runs']} trials")
    axis.legend(fontsize="small")
