"""What the filter leaves on the table: the same runs, filtered and smoothed.

The filter tells each pose from what came before it, linearised where it stood; the smoother tells
it from the whole run. The last pose has nothing after it: what the smoother gains there is the
filter's linearisation alone.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import common, estimator, workload
from jaxslam.core.batching import map_batches
from jaxslam.core.types import CORNER, Array
from jaxslam.evaluation.consistency import pose_error
from jaxslam.smoothing import dense
from jaxslam.smoothing.problem import LandmarkPrior, SmoothingProblem, SmoothingResult

ITERATIONS = 10


def smooth_one(run: workload.Drive, poses: Array) -> SmoothingResult:
    """Smooth one run from the filter's poses (T, 3) and the places that were known beforehand."""
    steps, size = run.motion.shape[0], run.prior.shape[0]
    variance = run.prior_cov[:, 0, 0]
    information = jnp.eye(2, dtype=variance.dtype)[None] / variance[:, None, None]
    records = SmoothingProblem(
        start=jnp.zeros(3, run.motion.dtype),
        odometry=run.motion,
        odometry_cov=jnp.broadcast_to(run.q, (steps, 3, 3)),
        measurement=run.polar,
        measurement_cov=run.r,
        kind=jnp.full(run.who.shape, CORNER, jnp.int32),
        landmark_index=jnp.where(run.who < 0, size, run.who),
        prior=LandmarkPrior(run.prior, information),
    )
    return dense.smooth_trial(records, poses, run.prior, iterations=ITERATIONS)


@jax.jit
def smoothed(drive: workload.Drive, poses: Array) -> Array:
    """Smooth B runs from the filter's poses (B, T, 3), a few together; poses (B, T, 3)."""
    one = lambda given: smooth_one(*given).poses
    return map_batches(one, (drive, poses), batch_size=workload.TOGETHER)


def errors(poses: Array, truth: np.ndarray) -> common.Numbers:
    """RMSE over runs and steps, over the last poses, and over the runs at each step."""
    error = np.asarray(pose_error(jnp.asarray(poses), jnp.asarray(truth, poses.dtype)), float)
    square = np.sum(error[..., :2] ** 2, axis=-1)
    root = lambda x, axis=None: np.sqrt(np.mean(x, axis=axis))
    return {
        "position_rmse_m": root(square),
        "position_rmse_last_m": root(square[:, -1]),
        "heading_rmse_deg": np.degrees(root(error[..., 2] ** 2)),
        "position_rmse_by_step_m": root(square, 0),
        "by_run_m": root(square, 1),
    }


def compute(seed: int, runs: int) -> common.Numbers:
    """Errors of both on the rings, whose landmarks are known beforehand to half a metre."""
    drive = workload.rings(seed, runs)
    given = workload.as_floats(drive)
    poses = {"filter": estimator.filtered(given).last_pose}
    poses["smoother"] = smoothed(given, poses["filter"])
    told = {name: errors(x, drive.truth) for name, x in poses.items()}
    better = np.mean(told["smoother"].pop("by_run_m") < told["filter"].pop("by_run_m"))
    ratio = told["smoother"]["position_rmse_m"] / told["filter"]["position_rmse_m"]
    return {"seed": seed, "runs": runs, **told, "smoother_vs_filter": ratio, "runs_better": better}


def draw(numbers: common.Numbers, path: Path) -> None:
    """Position error over the steps."""
    figure, axes = common.canvas(7, 3.2, 1, 1)
    (axis,) = axes[0]
    for name, colour in (("filter", common.ORANGE), ("smoother", common.BLUE)):
        values = numbers[name]["position_rmse_by_step_m"]
        axis.plot(np.arange(1, len(values) + 1), values, color=colour, label=name)
    axis.set(xlabel="step", ylabel=f"position RMSE of {numbers['runs']} runs [m]", ylim=(0, None))
    axis.legend(frameon=False)
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    given = common.parse(__doc__, argv, runs=512)
    numbers = compute(given.seed, given.frontend.segments)
    common.save(given.out, "smoothing", numbers, draw)
    for name in ("filter", "smoother"):
        of = numbers[name]
        print(
            f"{name:9} {of['position_rmse_m']:.4f} m {of['heading_rmse_deg']:.2f} deg, "
            f"last pose {of['position_rmse_last_m']:.4f} m"
        )
    print(f"better in {100 * numbers['runs_better']:.1f} % of runs")


if __name__ == "__main__":
    main()
