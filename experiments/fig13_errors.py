"""Errors of heading, y and x over time, with 3-sigma bounds, over many trials (paper, Fig. 13)."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import common
from jaxslam.core.devices import use_cpu_devices
from jaxslam.evaluation import consistency, summary
from jaxslam.filtering.noise import NoiseParams
from jaxslam.pipeline.config import Config

SHOWN = 20  # trials drawn one by one
NAMES = ("x_m", "y_m", "heading_deg")
UNIT = np.array([1.0, 1.0, 180.0 / np.pi])


def compute(seed: int, num_trials: int) -> common.Numbers:
    """Errors per step over all trials, those of a few, and the consistency of the filter."""
    results = common.filter_trials(
        jax.random.key(seed), Config(), NoiseParams.for_simulated_robot(), num_trials
    )
    error = consistency.pose_error(jnp.asarray(results.estimate), jnp.asarray(results.truth))
    nees = np.array(consistency.nees(error, jnp.asarray(results.cov)))[:, 1:]
    error = np.asarray(error) * UNIT
    sigma = np.sqrt(np.diagonal(results.cov, axis1=-2, axis2=-1)) * UNIT
    inside = np.abs(error) <= 3 * sigma + 1e-9
    return {
        "seed": seed,
        **summary.evaluate(results),
        "rmse": by_name(np.sqrt(np.mean(error**2, axis=0))),
        "sigma": by_name(np.sqrt(np.mean(sigma**2, axis=0))),
        "within_3_sigma": {name: inside[..., k].mean() for k, name in enumerate(NAMES)},
        "largest": {name: np.abs(error[..., k]).max() for k, name in enumerate(NAMES)},
        "nees_per_step": np.mean(nees, axis=0) / 3,
        "nees_bounds_95": [b / 3 for b in consistency.chi_square_bounds(3, num_trials)],
        "runs_shown": {name: error[:SHOWN, :, k] for k, name in enumerate(NAMES)},
    }


def by_name(values: np.ndarray) -> common.Numbers:
    """The columns of values (T, 3) of x, y and heading, by name."""
    return {name: values[..., k].T for k, name in enumerate(NAMES)}


def draw(numbers: common.Numbers, path: Path) -> None:
    """Three panels as in the paper, and the consistency of the filter."""
    figure, axes = common.canvas(9, 8, 4, 1)
    labels = {"heading_deg": "heading [deg]", "y_m": "y [m]", "x_m": "x [m]"}
    for axis, (name, label) in zip(axes[:3, 0], labels.items(), strict=True):
        shown, sigma = np.array(numbers["runs_shown"][name]), np.array(numbers["sigma"][name])
        axis.plot(shown.T, color=common.SKY, linewidth=0.5)
        axis.plot(numbers["rmse"][name], color=common.BLUE, label="RMSE of all trials")
        for sign in (-3, 3):
            bound = "3 sigma of the filter" if sign > 0 else None
            axis.plot(sign * sigma, color=common.RED, linestyle="--", label=bound)
        axis.set(ylabel=f"error of {label}", xlim=(0, len(sigma)))
    axes[0, 0].legend(loc="upper left", ncols=2)
    axis = axes[3, 0]
    axis.plot(np.arange(1, len(numbers["nees_per_step"]) + 1), numbers["nees_per_step"])
    for bound in numbers["nees_bounds_95"]:
        axis.axhline(bound, color=common.RED, linestyle="--")
    axis.set(ylabel="NEES per dof", xlabel="scan", xlim=(0, len(sigma)), ylim=(0, None))
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    args = common.parse(__doc__, argv, runs=100)
    use_cpu_devices()
    numbers = compute(args.seed, args.runs)
    common.save(args.out, "fig13_errors", numbers, draw)
    print({key: numbers[key] for key in ("position_rmse_m", "heading_rmse_deg", "nees")})
    print("within 3 sigma:", numbers["within_3_sigma"])


if __name__ == "__main__":
    main()
