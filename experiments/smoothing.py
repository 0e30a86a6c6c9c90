"""Batch smoother against filter on the same trials.

The filter estimates each pose from the measurements so far, linearised at the estimate of that
time; the smoother estimates it from all measurements of the trial. At the last pose both have the
same measurements: the difference there is due to the filter's linearisation alone.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import common, filter_benchmark, workload
from jaxslam.core.batching import map_batches
from jaxslam.core.types import CORNER, Array
from jaxslam.evaluation.consistency import pose_error
from jaxslam.smoothing import dense
from jaxslam.smoothing.problem import LandmarkPrior, SmoothingProblem, SmoothingResult

ITERATIONS = 10


def smooth_trial(trial: workload.Drive, poses: Array) -> SmoothingResult:
    """Smooth one trial from the filter's poses (T, 3) and the priors of the landmarks."""
    steps, size = trial.odometry.shape[0], trial.prior.shape[0]
    variance = trial.prior_cov[:, 0, 0]
    information = jnp.eye(2, dtype=variance.dtype)[None] / variance[:, None, None]
    problem = SmoothingProblem(
        start=jnp.zeros(3, trial.odometry.dtype),
        odometry=trial.odometry,
        odometry_cov=jnp.broadcast_to(trial.odometry_cov, (steps, 3, 3)),
        measurement=trial.range_bearing,
        measurement_cov=trial.measurement_cov,
        kind=jnp.full(trial.landmark_ids.shape, CORNER, jnp.int32),
        landmark_index=jnp.where(trial.landmark_ids < 0, size, trial.landmark_ids),
        prior=LandmarkPrior(trial.prior, information),
    )
    return dense.smooth_trial(problem, poses, trial.prior, iterations=ITERATIONS)


@jax.jit
def smooth_drive(drive: workload.Drive, poses: Array) -> Array:
    """Smooth B trials from the filter's poses (B, T, 3), a few together; poses (B, T, 3)."""

    def smoothed_poses(items: tuple[workload.Drive, Array]) -> Array:
        return smooth_trial(*items).poses

    return map_batches(smoothed_poses, (drive, poses), batch_size=workload.BATCH)


def errors(poses: Array, truth: np.ndarray) -> common.Numbers:
    """RMSE over trials and steps, over the last poses, and over the trials at each step."""
    error = np.asarray(pose_error(jnp.asarray(poses), jnp.asarray(truth, poses.dtype)), float)
    square = np.sum(error[..., :2] ** 2, axis=-1)
    return {
        "position_rmse_m": np.sqrt(np.mean(square)),
        "position_rmse_last_m": np.sqrt(np.mean(square[:, -1])),
        "heading_rmse_deg": np.degrees(np.sqrt(np.mean(error[..., 2] ** 2))),
        "position_rmse_by_step_m": np.sqrt(np.mean(square, axis=0)),
        "by_run_m": np.sqrt(np.mean(square, axis=1)),
    }


def compute(seed: int, num_trials: int) -> common.Numbers:
    """Errors of both on the rings, whose landmarks have a prior of half a metre."""
    drive = workload.rings(seed, num_trials)
    floats = workload.as_floats(drive)
    filtered = filter_benchmark.filter_drive(floats).pose
    poses = {"filter": filtered, "smoother": smooth_drive(floats, filtered)}
    found = {name: errors(x, drive.truth) for name, x in poses.items()}
    better = np.mean(found["smoother"].pop("by_run_m") < found["filter"].pop("by_run_m"))
    ratio = found["smoother"]["position_rmse_m"] / found["filter"]["position_rmse_m"]
    return {
        "seed": seed,
        "runs": num_trials,
        **found,
        "smoother_vs_filter": ratio,
        "runs_better": better,
    }


def draw(numbers: common.Numbers, path: Path) -> None:
    """Position error over the steps."""
    figure, axes = common.canvas(7, 3.2, 1, 1)
    (axis,) = axes[0]
    for name, colour in (("filter", common.ORANGE), ("smoother", common.BLUE)):
        values = numbers[name]["position_rmse_by_step_m"]
        axis.plot(np.arange(1, len(values) + 1), values, color=colour, label=name)
    axis.set(xlabel="step", ylabel=f"position RMSE of {numbers['runs']} trials [m]", ylim=(0, None))
    axis.legend(frameon=False)
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    args = common.parse(__doc__, argv, runs=512)
    numbers = compute(args.seed, args.runs)
    common.save(args.out, "smoothing", numbers, draw)
    for name in ("filter", "smoother"):
        of = numbers[name]
        print(
            f"{name:9} {of['position_rmse_m']:.4f} m {of['heading_rmse_deg']:.2f} deg, "
            f"last pose {of['position_rmse_last_m']:.4f} m"
        )
    print(f"better in {100 * numbers['runs_better']:.1f} % of trials")


if __name__ == "__main__":
    main()
