"""Noise that adapts online against noise that stays, where Q and R are off by known factors.

On the drives of `exact_model`, for which the filter's model is true. Each filter starts with the
standard deviations of Q and of R times a factor; with adaptation it should find their inverse.
"""

import sys
from functools import partial
from pathlib import Path

import jax
import numpy as np

from experiments import common, exact_model
from jaxslam.core.batching import map_batches
from jaxslam.core.caches import enable_caches
from jaxslam.core.devices import use_cpu_devices
from jaxslam.core.episode import Episode, measurements_of
from jaxslam.evaluation import consistency, summary
from jaxslam.filtering import StepInfo, run_filter
from jaxslam.filtering.adaptation import AdaptationSpec
from jaxslam.filtering.config import FilterConfig, init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline import episodes
from jaxslam.pipeline.episodes import TrialResult

NAME = "adaptation"
FACTORS = ((1.0, 1.0), (3.0, 1.0), (1.0, 3.0), (3.0, 3.0), (1 / 3, 1 / 3), (3.0, 1 / 3))
"""On the standard deviations of Q and of R."""


def scaled(params: NoiseParams, by_q: float, by_r: float) -> NoiseParams:
    """The noise with all standard deviations of Q, and of R, times a factor."""
    return params._replace(
        odometry_coefficients=by_q * params.odometry_coefficients,
        range_std=by_r * params.range_std,
        bearing_std=by_r * params.bearing_std,
        feature_std_scale=by_r * params.feature_std_scale,
        wall_angle_std=by_r * params.wall_angle_std,
    )


@partial(jax.jit, static_argnames="config")
def _filter(
    config: FilterConfig, params: NoiseParams, drives: Episode
) -> tuple[TrialResult, StepInfo]:
    """Results [B] and diagnostics [B] of the filter on drives [B]."""

    def of_drive(episode: Episode) -> tuple[TrialResult, StepInfo]:
        start = init(config, episode.truth[0])
        belief, info = run_filter(config, params, start, measurements_of(episode))
        return episodes.trial_result(config, episode, belief, info), info

    return map_batches(of_drive, drives, batch_size=episodes.EPISODE_BATCH)


def heldout(config: FilterConfig, params: NoiseParams, drives: Episode) -> common.Numbers:
    """Errors on drives [B] of a filter that adapts, as of `noise_search.evaluate_heldout`.

    Besides, the factors on the standard deviations of Q and of R at the end of a drive: their
    geometric means over the drives.
    """
    adapting = config._replace(adaptation=AdaptationSpec())
    results, info = _filter(adapting, params, drives)
    found = summary.evaluate(results)
    q, r = np.exp(np.log(np.asarray(info.noise_factors)[:, -1]).mean(axis=0))
    return {
        "heldout_rmse_m": found["position_rmse_m"],
        "nees": found["nees"],
        "diverged": found["diverged"],
        "q_factor": q,
        "r_factor": r,
    }


def run(config: FilterConfig, params: NoiseParams, drives: Episode) -> common.Numbers:
    """Results over drives [B]: mean and standard error of each measure."""
    info = jax.tree.map(np.asarray, _filter(config, params, drives)[1])
    error = np.asarray(consistency.pose_error(info.pose, drives.truth))
    nees = np.asarray(consistency.nees(error, info.pose_cov))[:, 1:] / 3  # the first is certain
    numbers = {
        "log_likelihood_per_scalar": _mean(info.log_likelihood.sum(axis=1) / info.dof.sum(axis=1)),
        "position_rmse_m": np.sqrt((error[..., :2] ** 2).sum(axis=-1).mean()),
        "pose_nees_per_dof": _mean(nees.mean(axis=1)),
    }
    if info.noise_factors is not None:
        logs = np.log(info.noise_factors[:, -1])
        numbers |= {"log_q": _mean(logs[:, 0]), "log_r": _mean(logs[:, 1])}
    return numbers


def _mean(values: np.ndarray) -> common.Numbers:
    """Mean of one number per drive, and its standard error."""
    return {"mean": values.mean(), "standard_error": values.std(ddof=1) / np.sqrt(len(values))}


def compute(seed: int, num_trials: int, num_scans: int | None) -> list[common.Numbers]:
    """A row for each pair of factors, with and without adaptation."""
    truth = exact_model.true_params()
    key = jax.random.key(seed)
    drives = exact_model.drives(key, truth, num_trials=num_trials, num_scans=num_scans)
    fixed = exact_model.CONFIG.filter
    adapts = fixed._replace(adaptation=AdaptationSpec())
    rows = []
    for by_q, by_r in FACTORS:
        row: common.Numbers = {"q_factor": by_q, "r_factor": by_r}
        for name, config in (("fixed", fixed), ("adapted", adapts)):
            row[name] = run(config, scaled(truth, by_q, by_r), drives)
        rows.append(row)
    return rows


def draw(numbers: common.Numbers, path: Path) -> None:
    """NEES and errors of both filters for each pair of factors."""
    figure, axes = common.canvas(11, 4.2, 1, 2)
    rows = numbers["rows"]
    labels = [f"Q x {row['q_factor']:.2g}\nR x {row['r_factor']:.2g}" for row in rows]
    place = np.arange(len(rows))
    for name, colour, marker, side in (
        ("fixed", common.ORANGE, "s", -0.1),
        ("adapted", common.GREEN, "o", 0.1),
    ):
        nees = [row[name]["pose_nees_per_dof"] for row in rows]
        mean, error = (np.array([x[key] for x in nees]) for key in ("mean", "standard_error"))
        rmse = [100 * row[name]["position_rmse_m"] for row in rows]
        style = {"fmt": marker, "color": colour, "label": name}
        axes[0, 0].errorbar(place + side, mean, 2 * error, capsize=3, **style)
        axes[0, 1].plot(place + side, rmse, marker, color=colour, label=name)
    axes[0, 0].axhline(1.0, color=common.BLACK, linewidth=0.8)
    axes[0, 0].set(ylabel="pose NEES per degree of freedom")
    axes[0, 1].set(ylabel="position RMSE [cm]")
    common.log_scale(axes[0, 0])
    axes[0, 0].set_title("bars: 2 standard errors", fontsize="small")
    for axis in axes[0]:
        axis.set_xticks(place, labels)
        axis.set_xlabel("standard deviations assumed, by the true ones")
        axis.grid(axis="y", alpha=0.3)
        axis.legend(fontsize="small")
    figure.savefig(path)


@common.report_errors(NAME)
def main(argv: list[str] | None = None) -> int:
    """Run the experiment; returns the exit code, 2 for bad input, 130 for Ctrl-C."""
    args = common.parse(__doc__, argv, runs=32, scans=0)
    use_cpu_devices()
    enable_caches()
    rows = compute(args.seed, args.runs, args.scans or None)
    common.save(args.out, NAME, {"seed": args.seed, "rows": rows}, draw)
    for row in rows:
        print(f"Q x {row['q_factor']:.3g}, R x {row['r_factor']:.3g}")
        for name in ("fixed", "adapted"):
            own = row[name]
            nees, score = own["pose_nees_per_dof"], own["log_likelihood_per_scalar"]
            text = f"  {name:8} RMSE {100 * own['position_rmse_m']:.3f} cm, NEES per dof "
            text += f"{nees['mean']:.2f} +- {nees['standard_error']:.2f}, log score "
            text += f"{score['mean']:.3f} +- {score['standard_error']:.3f}"
            if "log_q" in own:
                q, r = (np.exp(own[key]["mean"]) for key in ("log_q", "log_r"))
                text += f"; factors at the end: Q {q:.2f}, R {r:.2f}"
            print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main(None))
