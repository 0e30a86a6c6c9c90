"""Consistency of the filter: three linearisations on drives with known data association.

NEES of the pose by the filter's own covariance, per degree of freedom (1 is consistent, more is
over-confident), NIS of the innovations likewise, and RMSE, over noise levels; and the 2-D SLAM
benchmark of UKF-M with its published figures.

References:
    Bar-Shalom, Li, Kirubarajan (2001), Estimation with applications to tracking and navigation,
    section 5.4. Brossard, Barrau, Bonnabel (2020), "A code for unscented Kalman filtering on
    manifolds", benchmark of 2-D SLAM.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import common, workload
from jaxslam.evaluation.consistency import nees, pose_error
from jaxslam.filtering.ekf import LINEARISATIONS

NOISE = ((1.0, 1.0), (2.0, 1.5), (4.0, 3.0))  # factors on odometry and sensor noise
SKIP = 10  # steps at the start of the circle whose NEES counts as zero, as in UKF-M
PUBLISHED = {  # of UKF-M: position [m], heading [deg], NEES of position and of heading
    "standard": (0.67, 3.02, 2.56, 2.88),
    "invariant": (0.55, 2.51, 1.17, 1.01),
}


def standard_error(values: np.ndarray) -> float:
    """Standard error of the mean over trials (B,)."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values)))


def row(setting: str, linearisation: str, drive: workload.Drive, first: int) -> common.Numbers:
    """Errors of one linearisation on all trials of a drive, with standard errors over them.

    Args:
        setting: Name of the row.
        linearisation: One of `LINEARISATIONS`.
        drive: The trials.
        first: Step from which NEES is evaluated; NEES counts as zero before.
    """
    steps = workload.filter_drive(linearisation, workload.as_floats(drive))
    steps = type(steps)(*(np.asarray(x, float) for x in steps))
    error = np.asarray(pose_error(jnp.asarray(steps.pose), jnp.asarray(drive.truth)))
    joint = np.asarray(nees(jnp.asarray(error), jnp.asarray(steps.cov)))[:, first:] / 3
    square = np.sum(error[..., :2] ** 2, axis=-1)
    heading_square = error[..., 2] ** 2
    inverse = np.linalg.inv(steps.cov[:, first:, :2, :2])
    xy = error[:, first:, :2]
    nees_position = np.einsum("bti,btij,btj->bt", xy, inverse, xy) / 2
    nees_heading = heading_square[:, first:] / steps.cov[:, first:, 2, 2]
    # As in UKF-M, over all poses, the first of which is certain.
    fraction = nees_heading.shape[1] / (error.shape[1] + 1) if first else 1.0
    rmse = np.sqrt(np.mean(square))
    return {
        "setting": setting,
        "linearisation": linearisation,
        "runs": len(error),
        "position_rmse_m": float(rmse),
        "position_rmse_se_m": standard_error(square.mean(axis=1)) / (2 * rmse),
        "heading_rmse_deg": float(np.degrees(np.sqrt(np.mean(heading_square)))),
        "nees": float(joint.mean()),
        "nees_se": standard_error(joint.mean(axis=1)),
        "nees_position": float(fraction * nees_position.mean()),
        "nees_heading": float(fraction * nees_heading.mean()),
        "nis": float(steps.nis.sum() / steps.dof.sum()),
    }


def compute(seed: int, num_trials: int, num_circle_trials: int) -> common.Numbers:
    """All rows: noise levels of the rings, then the circle."""
    rows = []
    with tqdm(total=(len(NOISE) + 1) * len(LINEARISATIONS), unit="row", leave=False) as bar:

        def add_rows(setting: str, drive: workload.Drive, first: int) -> None:
            for linearisation in LINEARISATIONS:
                rows.append(row(setting, linearisation, drive, first))
                bar.update()

        for odometry, sensor in NOISE:
            drive = workload.rings(
                seed, num_trials, odometry_scale=odometry, sensor_scale=sensor, prior_std=0.0
            )
            add_rows(f"odometry x{odometry:g}, sensor x{sensor:g}", drive, 0)
        add_rows("UKF-M circle", workload.circle(seed, num_circle_trials), SKIP)
    names = ("position_rmse_m", "heading_rmse_deg", "nees_position", "nees_heading")
    published = {k: dict(zip(names, v, strict=True)) for k, v in PUBLISHED.items()}
    return {"seed": seed, "rows": rows, "published": published}


def draw(numbers: common.Numbers, path: Path) -> None:
    """Bars: NEES and position error of each setting and linearisation."""
    figure, axes = common.canvas(11, 3.8, 1, 2)
    settings = list(dict.fromkeys(r["setting"] for r in numbers["rows"]))
    colours = (common.SKY, common.RED, common.GREEN)
    for axis, name in zip(axes.flat, ("nees", "position_rmse_m"), strict=True):
        for k, (linearisation, colour) in enumerate(zip(LINEARISATIONS, colours, strict=True)):
            own = [r for r in numbers["rows"] if r["linearisation"] == linearisation]
            x = np.arange(len(settings)) + 0.27 * (k - 1)
            axis.bar(x, [r[name] for r in own], 0.25, color=colour, label=linearisation)
        axis.set_xticks(np.arange(len(settings)), [s.replace(", ", "\n") for s in settings])
    axes.flat[0].axhline(1.0, color="black", lw=0.8, ls="--")
    axes.flat[0].set_ylabel("pose NEES per degree of freedom")
    axes.flat[1].set_ylabel("position RMSE [m]")
    axes.flat[0].legend(frameon=False, fontsize=8)
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    args = common.parse(__doc__, argv, runs=1000, circle_runs=500)
    numbers = compute(args.seed, args.runs, args.circle_runs)
    common.save(args.out, "consistency", numbers, draw)
    for r in numbers["rows"]:
        print(
            f"{r['setting']:28} {r['linearisation']:16} {r['position_rmse_m']:.3f} m "
            f"{r['heading_rmse_deg']:.2f} deg  NEES {r['nees']:.3f} +- {r['nees_se']:.3f} "
            f"({r['nees_position']:.2f} / {r['nees_heading']:.2f})  NIS {r['nis']:.3f}"
        )


if __name__ == "__main__":
    main()
