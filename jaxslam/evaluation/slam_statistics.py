"""Consistency of the SLAM filter: NIS of its steps, NEES of its pose, whiteness of its corrections.

The number of features differs from step to step, and so do the components of the innovation v. What
stays the same is what the step does to the pose: it corrects it by d = K v, with the gain K of the
pose. As the innovations of a filter that is right are white, so are the corrections, with

    cov d = K S K^T = P_predicted - P_updated

so a program of its own runs the filter and keeps both poses; its results are those of the filter.
The corrections are taken in the frame of the robot and whitened in the order heading, left, ahead:
d = L w with L lower triangular. Directions that a step does not correct have no value.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxslam.core import trace_cache
from jaxslam.core.batching import map_batches
from jaxslam.core.episode import Episode, measurements_of
from jaxslam.core.measurement import Measurement
from jaxslam.core.se2 import rotation, wrap_angle
from jaxslam.core.types import Array
from jaxslam.evaluation.consistency import CERTAIN_TRACE, pose_nees
from jaxslam.evaluation.filter_consistency import ConsistencyReport, consistency_of_nis
from jaxslam.filtering import slam_filter
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.config import FilterConfig, check_options, init
from jaxslam.filtering.inputs import check_inputs
from jaxslam.filtering.noise import NoiseParams
from jaxslam.filtering.step_info import StepInfo
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.episodes import EPISODE_BATCH, TrialResult, check_drives, trial_result

CORRECTIONS = ("heading", "to the left", "ahead")
"""Components of the correction of the pose, in the frame of the robot."""

# Of a variance, the part that a step must take off for its correction to count; a difference of
# variances in single precision has some six digits.
LEAST_CORRECTED = 1e-3


class FilterStatistics(NamedTuple):
    """What each step of the filter says about its own consistency.

    Attributes:
        nis: (T,) NIS of all features together.
        dof: (T,) int32 its degrees of freedom; 0 where no feature updated the state.
        correction: (T, 3) whitened correction of the pose, components as `CORRECTIONS`.
        corrected: (T, 3) bool, components that have a value.
        loss: () of the drive, if one was asked for.
    """

    nis: Array
    dof: Array
    correction: Array
    corrected: Array
    loss: Array | None = None


def filter_with_statistics(
    config: Config,
    params: NoiseParams,
    episodes: Episode | list[Episode],
    *,
    loss: Callable[[StepInfo, Episode], Array] | None = None,
) -> tuple[TrialResult, FilterStatistics]:
    """`filter_episodes`, and the statistics [B] for `slam_consistency`, in one program.

    Args:
        config: Of the filter.
        params: Its noise parameters.
        episodes: [B] drives, or a list of them.
        loss: Of the infos [T] of a drive, and the drive; one of `tuning.losses`, for example.

    Raises:
        ValueError: As of `filter_episodes`.
    """
    params, drives = check_drives(config, params, episodes)
    num_trials, num_scans = drives.odometry.shape[:2]
    return _filter_of(num_trials * num_scans)(config.filter, loss, params, drives)


def _filter_batch(
    config: FilterConfig,
    loss: Callable[[StepInfo, Episode], Array] | None,
    params: NoiseParams,
    episodes: Episode,
) -> tuple[TrialResult, FilterStatistics]:
    return map_batches(partial(_filter, config, loss, params), episodes, batch_size=EPISODE_BATCH)


_filter_of = trace_cache.jit_by_length(_filter_batch, static_argnames=("config", "loss"))


def _filter(
    config: FilterConfig,
    loss: Callable[[StepInfo, Episode], Array] | None,
    params: NoiseParams,
    episode: Episode,
) -> tuple[TrialResult, FilterStatistics]:
    """Result and statistics of one drive."""
    start = init(config, episode.truth[0])
    params, measurements = check_inputs(params, start, measurements_of(episode), over_time=True)
    check_options(config, params, start)

    def body(belief: Belief, now: Measurement) -> tuple[Belief, tuple[StepInfo, Array, Array]]:
        predicted, _ = slam_filter.predict(config, params, belief, now)  # the same as in the step
        belief, info = slam_filter.unchecked_step(config, params, belief, now)
        return belief, (info, *pose_correction(predicted, info))

    belief, (info, correction, corrected) = lax.scan(body, start, measurements)
    value = None if loss is None else loss(info, episode)
    statistics = FilterStatistics(info.nis, info.dof, correction, corrected, value)
    return trial_result(config, episode, belief, info), statistics


def pose_correction(predicted: Belief, info: StepInfo) -> tuple[Array, Array]:
    """Whitened correction of the pose by the features of a step; module's docstring.

    Args:
        predicted: Belief of the step after the odometry, before the features.
        info: Diagnostics of the step.

    Returns:
        The correction (3,), components as `CORRECTIONS`, 0 where there is none; and bool (3,)
        where there is one.
    """
    shift = info.pose - predicted.pose
    shift = shift.at[2].set(wrap_angle(shift[2]))
    taken = predicted.pose_cov - info.pose_cov
    w, has = _whiten(shift, predicted.pose_cov, taken, predicted.pose[2])
    has &= info.finite & (info.dof > 0)
    return jnp.where(has, w, 0.0), has


def _whiten(shift: Array, before: Array, taken: Array, heading: Array) -> tuple[Array, Array]:
    """Whiten a correction (3,) of a pose in the map frame.

    By elimination as in `consistency.nees`, leaving out components whose pivot is too small.

    Args:
        shift: (3,) the correction d [m, m, rad].
        before: (3, 3) covariance of the predicted pose.
        taken: (3, 3) what the update took off it: the covariance of d.
        heading: () [rad] of the robot.

    Returns:
        w (3,) and bool (3,), components as `CORRECTIONS`.
    """
    to_robot = jnp.eye(3, dtype=shift.dtype).at[:2, :2].set(rotation(heading).T)[::-1]
    d, C = to_robot @ shift, to_robot @ taken @ to_robot.T
    least = LEAST_CORRECTED * jnp.diagonal(to_robot @ before @ to_robot.T)
    w, has = [], []
    for j in range(3):
        good = C[j, j] > least[j]
        pivot = jnp.where(good, C[j, j], 1.0)
        factor = jnp.where(good, C[:, j] / pivot, 0.0)
        w.append(d[j] / jnp.sqrt(pivot))
        has.append(good)
        d, C = d - factor * d[j], C - factor[:, None] * C[j][None]
    return jnp.stack(w), jnp.stack(has)


def slam_consistency(
    results: TrialResult, statistics: FilterStatistics
) -> ConsistencyReport | None:
    """Report on the consistency of the filter over many trials.

    Args:
        results: [B] trials.
        statistics: [B] their statistics, as of `filter_with_statistics`.

    Returns:
        The report, of the trials whose numbers are all finite, with NEES where there is ground
        truth; None if no feature updated the state.
    """
    results, statistics = jax.tree.map(np.asarray, (results, statistics))
    good = results.finite & np.isfinite(results.estimate).all(axis=(1, 2))
    used = good[:, None] & (statistics.dof > 0) & np.isfinite(statistics.nis)
    if not used.any():
        return None
    has = used[..., None] & statistics.corrected & np.isfinite(statistics.correction)
    squares = np.asarray(pose_nees(results.estimate, results.truth, results.cov))
    certain = np.trace(results.cov, axis1=-2, axis2=-1) < CERTAIN_TRACE
    known = good[:, None] & results.truth_mask & ~certain & np.isfinite(squares)
    return consistency_of_nis(
        np.where(used, statistics.nis, 0.0),
        np.where(used, statistics.dof, 0),
        whitened=np.where(has, statistics.correction, np.nan),
        names=CORRECTIONS,
        nees=np.where(known, squares, 0.0) if known.any() else None,
        nees_dof=np.where(known, 3, 0) if known.any() else None,
    )
