"""Whether the filter knows how wrong it is: three linearisations on drives with known landmarks.

NEES of the pose by the filter's own covariance, per degree of freedom (1 is right, more is too
sure of itself), NIS of the innovations likewise, and RMSE, over noise levels; and the 2-D SLAM
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
SKIP = 10  # steps at the start of the circle whose NEES counts as zero, as UKF-M has it
PUBLISHED = {  # of UKF-M: position [m], heading [deg], NEES of position and of heading
    "standard": (0.67, 3.02, 2.56, 2.88),
    "invariant": (0.55, 2.51, 1.17, 1.01),
}


def spread(values: np.ndarray) -> float:
    """Standard error of the mean over runs (B,)."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values)))


def row(setting: str, linearisation: str, drive: workload.Drive, of_rate: bool) -> common.Numbers:
    """Errors of one linearisation on all runs of a drive, with standard errors over the runs."""
    steps = workload.filtered(linearisation, workload.as_floats(drive))
    steps = type(steps)(*(np.asarray(x, float) for x in steps))
    error = np.asarray(pose_error(jnp.asarray(steps.last_pose), jnp.asarray(drive.truth)))
    first = SKIP if of_rate else 0
    joint = np.asarray(nees(jnp.asarray(error), jnp.asarray(steps.cov)))[:, first:] / 3
    place = np.sum(error[..., :2] ** 2, axis=-1)
    turn = error[..., 2] ** 2
    inverse = np.linalg.inv(steps.cov[:, first:, :2, :2])
    xy = error[:, first:, :2]
    nees_place = np.einsum("bti,btij,btj->bt", xy, inverse, xy) / 2
    nees_turn = turn[:, first:] / steps.cov[:, first:, 2, 2]
    # Over all poses, the first of which is certain, as UKF-M has it.
    share = nees_turn.shape[1] / (error.shape[1] + 1) if of_rate else 1.0
    rmse = np.sqrt(np.mean(place))
    return {
        "setting": setting,
        "linearisation": linearisation,
        "runs": len(error),
        "position_rmse_m": float(rmse),
        "position_rmse_se_m": spread(place.mean(axis=1)) / (2 * rmse),
        "heading_rmse_deg": float(np.degrees(np.sqrt(np.mean(turn)))),
        "nees": float(joint.mean()),
        "nees_se": spread(joint.mean(axis=1)),
        "nees_position": float(share * nees_place.mean()),
        "nees_heading": float(share * nees_turn.mean()),
        "nis": float(steps.nis.sum() / steps.dof.sum()),
    }


def compute(seed: int, runs: int, circle_runs: int) -> common.Numbers:
    """All rows: noise levels of the rings, then the circle."""
    drives = {
        f"odometry x{a:g}, sensor x{b:g}": (
            workload.rings,
            runs,
            {"odometry": a, "sensing": b, "prior": 0.0},
        )
        for a, b in NOISE
    }
    drives["UKF-M circle"] = (workload.circle, circle_runs, {})
    rows = []
    with tqdm(total=len(drives) * len(LINEARISATIONS), unit="row", leave=False) as bar:
        for setting, (make, count, factors) in drives.items():
            drive = make(seed, count, **factors)
            for linearisation in LINEARISATIONS:
                rows.append(row(setting, linearisation, drive, make is workload.circle))
                bar.update()
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
            at = np.arange(len(settings)) + 0.27 * (k - 1)
            axis.bar(at, [r[name] for r in own], 0.25, color=colour, label=linearisation)
        axis.set_xticks(np.arange(len(settings)), [s.replace(", ", "\n") for s in settings])
    axes.flat[0].axhline(1.0, color="black", lw=0.8, ls="--")
    axes.flat[0].set_ylabel("pose NEES per degree of freedom")
    axes.flat[1].set_ylabel("position RMSE [m]")
    axes.flat[0].legend(frameon=False, fontsize=8)
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    given = common.parse(__doc__, argv, runs=1000, circle_runs=500)
    numbers = compute(given.seed, given.frontend.segments, given.circle_runs)
    common.save(given.out, "consistency", numbers, draw)
    for r in numbers["rows"]:
        print(
            f"{r['setting']:28} {r['linearisation']:16} {r['position_rmse_m']:.3f} m "
            f"{r['heading_rmse_deg']:.2f} deg  NEES {r['nees']:.3f} +- {r['nees_se']:.3f} "
            f"({r['nees_position']:.2f} / {r['nees_heading']:.2f})  NIS {r['nis']:.3f}"
        )


if __name__ == "__main__":
    main()
