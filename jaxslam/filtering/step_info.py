"""Diagnostics of one step of the filter."""

from typing import NamedTuple

import jax.numpy as jnp

from jaxslam.core.features import Features
from jaxslam.core.types import WALL, Array
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.data_association import Matches
from jaxslam.filtering.kalman import UpdateResult, log_likelihood
from jaxslam.filtering.robust import Score


class StepInfo(NamedTuple):
    """Diagnostics of one step; the next step does not depend on them.

    Attributes:
        pose: (3,) [m, m, rad] estimated, map frame.
        pose_cov: (3, 3) its covariance.
        slot: (M,) int32 slot of each feature's landmark, matched or new; L for none.
        id: (M,) int32 id of that landmark, -1 for none.
        used: (M,) bool, the feature updated the state.
        nis: () normalised innovation squared, of all used features together; of the scales with
            `params.student_dof`.
        dof: () int32 its degrees of freedom.
        log_likelihood: () [nats] of the innovations, Gaussian or Student t.
        finite: () bool, False where the update was not finite and was left out.
        num_new: () int32 number of new landmarks.
        num_pruned: () int32 number of landmarks that were pruned, unconfirmed ones included.
        num_evicted: () int32 number of unconfirmed landmarks that were evicted from a full map.
        num_merged: () int32 number of duplicates that were merged.
        logdet: () log-determinant of the innovation covariance, of scales, with
            `params.student_dof`; None without, where it follows from `log_likelihood` and `nis`.
        noise_factors: (2,) factors on the standard deviations of Q and R from the next step on;
            None where they do not adapt.
        odometry_bias: (3,) biases of odometry (`odometry_bias`); None where there are none.
        odometry_bias_cov: (3, 3) their covariance, likewise.
    """

    pose: Array
    pose_cov: Array
    slot: Array
    id: Array
    used: Array
    nis: Array
    dof: Array
    log_likelihood: Array
    finite: Array
    num_new: Array
    num_pruned: Array
    num_evicted: Array
    num_merged: Array
    logdet: Array | None = None
    noise_factors: Array | None = None
    odometry_bias: Array | None = None
    odometry_bias_cov: Array | None = None


def degrees(features: Features) -> Array:
    """Numbers (...) that the measurement of a feature has."""
    return jnp.where(features.kind == WALL, 1, 2)


def step_info(
    belief: Belief,
    features: Features,
    matches: Matches,
    new_slot: Array,
    result: UpdateResult,
    score: Score | None,
    *,
    pruned: Array,
    merged: Array,
    evicted: Array,
) -> StepInfo:
    """Diagnostics of the step; the likelihood of an update that was left out is zero."""
    size = belief.num_seen.size
    slot = jnp.minimum(matches.slot, new_slot)
    dof = jnp.sum(jnp.where(matches.used, degrees(features), 0), dtype=jnp.int32)
    nis = result.nis if score is None else score.nis
    return StepInfo(
        pose=belief.pose,
        pose_cov=belief.pose_cov,
        slot=slot,
        id=belief.id.at[slot].get(mode="fill", fill_value=-1),
        used=matches.used,
        nis=jnp.where(result.ok, nis, 0.0),
        dof=dof,
        log_likelihood=jnp.where(
            result.ok, log_likelihood(result, dof) if score is None else score.log_likelihood, 0.0
        ),
        finite=result.ok,
        num_new=jnp.sum(new_slot < size, dtype=jnp.int32),
        num_pruned=pruned,
        num_evicted=evicted,
        num_merged=merged,
        logdet=None if score is None else jnp.where(result.ok, score.logdet, 0.0),
        noise_factors=None if belief.adaptation is None else belief.adaptation.factors,
        odometry_bias=None if belief.bias is None else belief.bias.mean,
        odometry_bias_cov=None if belief.bias is None else belief.bias.cov,
    )
