"""One step of the EKF-SLAM filter, and the filter over an episode."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.features import Features, restrict_features
from jaxslam.core.measurement import Measurement
from jaxslam.core.ranking import stable_order
from jaxslam.core.se2 import rotation
from jaxslam.core.types import WALL, Array
from jaxslam.filtering import ekf, robust
from jaxslam.filtering.adaptation import adapt
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.config import (
    FilterConfig,
    check_config,
    check_options,
    required_observations,
)
from jaxslam.filtering.data_association import Association, Matches, associate, use_known_ids
from jaxslam.filtering.inputs import check_inputs
from jaxslam.filtering.joint_covariance import LinearizedMeasurements, mask_measurements
from jaxslam.filtering.kalman import Innovation, UpdateResult, project
from jaxslam.filtering.match_verification import verify_matches
from jaxslam.filtering.noise import NoiseParams, measurement_cov, motion_estimate
from jaxslam.filtering.odometry_bias import correct_odometry, walk
from jaxslam.filtering.robust import Score
from jaxslam.filtering.step_info import StepInfo as StepInfo
from jaxslam.filtering.step_info import degrees, step_info
from jaxslam.filtering.track_management import add_landmarks, manage_tracks


def step(
    config: FilterConfig, params: NoiseParams, belief: Belief, measurement: Measurement
) -> tuple[Belief, StepInfo]:
    """One step of EKF-SLAM; compiled once for a configuration and the shapes.

        select     the features of the configured kinds; their covariance R
        predict    the belief by the odometry increment
        associate  features with landmarks of the predicted belief
        choose     the matches that update the state: confirmed landmarks, walls first
        linearise  their innovations
        verify     them jointly, and drop the rejected ones
        reweight   the features, if their noise is a Student t distribution
        adapt      the scales of Q and R to the innovations, if they adapt
        update     the belief; leave the update out if it is not finite
        manage     the tracks: record observations, prune landmarks, merge duplicates
        add        new landmarks, evicting unconfirmed ones from a full map

    With `measurement.landmark_ids` correspondences are known: nothing is associated, verified,
    pruned or merged, and a landmark is confirmed by its first observation. No more than
    `config.max_updates` features update the state in a step, and no more than `config.max_new`
    become landmarks.

    Correspondences are integers: derivatives are those of the filter with correspondences fixed.

    Args:
        config: Static configuration.
        params: Standard deviations of odometry and features.
        belief: Belief after the step before.
        measurement: Odometry increment (3,) and features (M) of this step; NumPy arrays and lists
            are taken, too.

    Returns:
        The belief after the step, and its diagnostics.

    Raises:
        ValueError: The configuration is wrong (`check_config`), or a shape, type or concrete value
            of the parameters or of the measurement (`inputs.check_inputs`).

    References:
        Paper, section 3, eqs. (1)-(16). Thrun, Burgard, Fox (2005), Probabilistic Robotics,
        chapter 10.
    """
    check_config(config)
    params, measurement = check_inputs(params, belief, measurement, over_time=False)
    check_options(config, params, belief)
    return _compiled_step(config, params, belief, measurement)


def unchecked_step(
    config: FilterConfig, params: NoiseParams, belief: Belief, measurement: Measurement
) -> tuple[Belief, StepInfo]:
    """`step` of inputs that are checked; not jitted, for a scan over time."""
    is_known = measurement.landmark_ids is not None
    if is_known:
        config = config._replace(confirm_count=1, wall_confirm_count=1)
    features, features_cov = _select(config, params, measurement)
    if belief.adaptation is not None:
        features_cov *= jnp.exp(belief.adaptation.log_variance[1])
    predicted, odometry_cov = predict(config, params, belief, measurement)
    found = _associate(config, predicted, features, features_cov, measurement.landmark_ids)
    matches = _choose(config, predicted, features, found.slot)
    chosen, rows = _linearise(config, predicted, features, features_cov, matches)
    known = None
    if not is_known:
        predicted, rows, matches, known = _verify(config, predicted, chosen, rows, matches)
    if params.student_dof is not None:
        known = None  # the weights change R
    rows, score = _reweight(params, predicted, chosen, rows, matches)
    predicted = _adapt(config, belief, predicted, odometry_cov, chosen, rows, matches)
    updated, result, matches = _update(config, predicted, rows, known, matches)
    tracked, pruned, merged = manage_tracks(config, updated, features, matches, is_known)
    found = found._replace(is_new=found.is_new & result.ok)
    mapped, new_slot, evicted = add_landmarks(config, tracked, features, features_cov, found)
    info = step_info(
        mapped,
        features,
        matches,
        new_slot,
        result,
        score,
        pruned=pruned,
        merged=merged,
        evicted=evicted,
    )
    return mapped, info


_compiled_step = partial(jax.jit, static_argnames="config")(unchecked_step)


def _select(
    config: FilterConfig, params: NoiseParams, measurement: Measurement
) -> tuple[Features, Array]:
    """Features of the configured kinds, and their measurement covariance R (M, 2, 2)."""
    kind = measurement.features.kind
    allowed = jnp.isin(kind, jnp.array(config.landmark_kinds, jnp.int32))
    features = restrict_features(measurement.features, allowed)
    return features, measurement_cov(
        params,
        features,
        measurement,
        untrusted_inflation=config.untrusted_inflation,
        noise_model=config.noise_model,
    )


def predict(
    config: FilterConfig, params: NoiseParams, belief: Belief, measurement: Measurement
) -> tuple[Belief, Array]:
    """Predict by the odometry increment, and count the step: what `unchecked_step` begins with.

    Returns:
        The belief, and the covariance Q (3, 3) of the increment in the frame of the pose before it.
    """

    def increment(bias: Array | None) -> tuple[Array, tuple[Array, Array]]:
        given = measurement
        if bias is not None:
            given = given._replace(odometry=correct_odometry(bias, given.odometry))
        odometry, odometry_cov = motion_estimate(params, given, noise_model=config.noise_model)
        return odometry, (odometry, odometry_cov)

    bias, by_bias = belief.bias, None
    if bias is None:
        odometry, odometry_cov = increment(None)[1]
    else:
        by_bias, (odometry, odometry_cov) = jax.jacfwd(increment, has_aux=True)(bias.mean)
    if belief.adaptation is not None:
        odometry_cov *= jnp.exp(belief.adaptation.log_variance[0])
    belief = ekf.predict(
        belief, odometry, odometry_cov, linearisation=config.linearisation, by_bias=by_bias
    )
    if belief.bias is not None and params.odometry_bias_walk is not None:
        walked = walk(belief.bias, params.odometry_bias_walk, measurement.odometry)
        belief = belief._replace(bias=walked)
    return belief._replace(step=belief.step + 1), odometry_cov


def _associate(
    config: FilterConfig,
    belief: Belief,
    features: Features,
    features_cov: Array,
    landmark_ids: Array | None,
) -> Association:
    """Associate features with landmarks, by known ids where they are given."""
    if landmark_ids is not None:
        return use_known_ids(belief, features, landmark_ids)
    return associate(config.association, belief, features, features_cov)


def _choose(config: FilterConfig, belief: Belief, features: Features, slot: Array) -> Matches:
    """Choose the matches that update the state, no more than `config.max_updates`.

    Only landmarks that this observation confirms, or that are confirmed already, are used. Wall
    directions come first, then the order of the front end.
    """
    size = belief.num_seen.size
    observations = belief.num_seen.at[slot].get(mode="fill", fill_value=0) + 1
    used = (slot < size) & (observations >= required_observations(config, features.kind))
    turn = jnp.where(used, jnp.where(features.kind == WALL, 0.0, 1.0), 2.0)
    order = stable_order(turn)[: config.max_updates]
    used &= jnp.zeros_like(used).at[order].set(True)
    return Matches(slot, used, order)


def _linearise(
    config: FilterConfig, belief: Belief, features: Features, features_cov: Array, matches: Matches
) -> tuple[Features, LinearizedMeasurements]:
    """Features (K) of the rows of the update, and their innovations with Jacobians."""
    used_slot = jnp.where(matches.used, matches.slot, belief.num_seen.size)
    chosen, chosen_cov, chosen_slot = jax.tree.map(
        lambda field: field[matches.order], (features, features_cov, used_slot)
    )
    rows = ekf.linearize(
        belief, chosen, chosen_cov, chosen_slot, linearisation=config.linearisation
    )
    return chosen, rows


def _verify(
    config: FilterConfig,
    belief: Belief,
    chosen: Features,
    rows: LinearizedMeasurements,
    matches: Matches,
) -> tuple[Belief, LinearizedMeasurements, Matches, Innovation]:
    """Drop the matches that `verify_matches` rejects.

    Returns:
        The belief with its counts of matches not yet accepted, the rows and the matches that are
        left, and what the test computed of their innovations. A rejected match does not count as
        an observation of its landmark, either.
    """
    products, joint_cov = lax.stop_gradient(project(ekf.covariance_blocks(belief), rows))
    verified, num_pending = verify_matches(config.association, belief, chosen, rows, joint_cov)
    accepted = verified.kept
    left = jnp.repeat(accepted, 2)[:, None]
    by_pose, by_map = (jnp.where(left, x, 0.0) for x in products)
    inv_root, logdet, is_definite = verified.factor
    known = Innovation(by_pose, by_map, inv_root, logdet, is_definite)
    rows, belief = mask_measurements(rows, accepted), belief._replace(num_pending=num_pending)
    slot, used, order = matches
    rejected = used & jnp.zeros_like(used).at[order].set(~accepted)
    slot = jnp.where(rejected, belief.num_seen.size, slot)
    return belief, rows, Matches(slot, used & ~rejected, order), known


def _reweight(
    params: NoiseParams,
    belief: Belief,
    chosen: Features,
    rows: LinearizedMeasurements,
    matches: Matches,
) -> tuple[LinearizedMeasurements, Score | None]:
    """Weigh the features if their noise is a Student t distribution; else None is the score."""
    if params.student_dof is None:
        return rows, None
    size = jnp.where(matches.used[matches.order], degrees(chosen), 0)
    return robust.reweight(params.student_dof, ekf.covariance_blocks(belief), rows, size)


def _adapt(
    config: FilterConfig,
    before: Belief,
    belief: Belief,
    odometry_cov: Array,
    chosen: Features,
    rows: LinearizedMeasurements,
    matches: Matches,
) -> Belief:
    """The predicted belief with the scales of Q and R that follow from its innovations."""
    if config.adaptation is None or belief.adaptation is None:
        return belief
    size = jnp.where(matches.used[matches.order], degrees(chosen), 0)
    to_map_frame = jnp.eye(3, dtype=odometry_cov.dtype)
    to_map_frame = to_map_frame.at[:2, :2].set(rotation(before.pose[2]))
    adapted = adapt(
        config.adaptation,
        belief.adaptation,
        ekf.covariance_blocks(belief),
        rows,
        size,
        to_map_frame @ odometry_cov @ to_map_frame.T,
    )
    return belief._replace(adaptation=adapted)


def _update(
    config: FilterConfig,
    belief: Belief,
    rows: LinearizedMeasurements,
    known: Innovation | None,
    matches: Matches,
) -> tuple[Belief, UpdateResult, Matches]:
    """Update by all rows at once, unless the result is not finite.

    Returns:
        The belief, the result of the update, and the matches. Where the updated mean is not finite,
        `result.ok` is False and no match is left. An update that fails changes no covariance, so
        only the mean is restored.
    """
    updated, result = ekf.update(belief, rows, known, linearisation=config.linearisation)
    finite = jnp.all(jnp.isfinite(updated.mean)) & result.ok
    updated = updated._replace(mean=jnp.where(finite, updated.mean, belief.mean))
    slot = jnp.where(finite, matches.slot, belief.num_seen.size)
    matches = matches._replace(slot=slot, used=matches.used & finite)
    return updated, result._replace(ok=finite), matches


def run_filter(
    config: FilterConfig, params: NoiseParams, belief: Belief, measurements: Measurement
) -> tuple[Belief, StepInfo]:
    """Run the filter over one log; compiled once for a configuration and the shapes.

    For a derivative, only the rows of the covariance that each step touched are kept, never the
    whole. Derivatives are taken in reverse mode only (`kalman.kalman_update`).

    Args:
        config: Static configuration.
        params: Standard deviations of odometry and features.
        belief: Belief before the first step.
        measurements: [T] measurements: odometry (T, 3), features (T, M); NumPy arrays and lists are
            taken, too.

    Returns:
        The belief after the last step, and the diagnostics [T].

    Raises:
        ValueError: As of `step`, and where the T of two fields differ.
    """
    check_config(config)
    params, measurements = check_inputs(params, belief, measurements, over_time=True)
    check_options(config, params, belief)
    return _run(config, params, belief, measurements)


@partial(jax.jit, static_argnames="config")
def _run(
    config: FilterConfig, params: NoiseParams, belief: Belief, measurements: Measurement
) -> tuple[Belief, StepInfo]:
    """`run_filter`, of inputs that are checked."""

    def body(belief: Belief, now: Measurement) -> tuple[Belief, StepInfo]:
        return unchecked_step(config, params, belief, now)

    return lax.scan(body, belief, measurements)
