"""EKF-SLAM as pure functions: predict, innovations, update, merge, augment.

The state is the robot's pose and two numbers per landmark slot: the position of a junction or
corner, or the direction of a wall (and a zero). The algebra is structured: a prediction touches
three rows and columns, an update gathers the columns it needs, no dense F or H is ever built.

References:
    Paper, section 3, eqs. (1)-(16), with eq. (7) corrected: a bearing is relative to the robot's
    heading. Thrun, Burgard, Fox (2005), Probabilistic Robotics, chapter 10.
"""

import jax
import jax.numpy as jnp

from jaxslam.core.features import Features
from jaxslam.core.se2 import compose, rotation, wrap_angle
from jaxslam.core.types import WALL, Array
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.joint_covariance import (
    CovarianceBlocks,
    LinearizedMeasurements,
    add_block_products,
)
from jaxslam.filtering.kalman import Innovation, UpdateResult, kalman_update
from jaxslam.filtering.measurement_model import measure, predict_measurement, residual

LINEARISATIONS = ("standard", "first_estimates", "invariant")


def check_linearisation(name: str) -> None:
    """Raise ValueError unless `name` is one of `LINEARISATIONS`."""
    if name not in LINEARISATIONS:
        known = ", ".join(map(repr, LINEARISATIONS))
        raise ValueError(f"linearisation is {name!r}; known are {known}")


def covariance_blocks(belief: Belief) -> CovarianceBlocks:
    """Covariance of the belief in blocks, as `kalman_update` takes it.

    Biases of odometry follow the pose in its block.
    """
    if belief.bias is None:
        return CovarianceBlocks(belief.pose_cov, belief.cross_cov, belief.map_cov)
    bias = belief.bias
    upper = jnp.concatenate([belief.pose_cov, bias.pose_cov.T], axis=1)
    lower = jnp.concatenate([bias.pose_cov, bias.cov], axis=1)
    return CovarianceBlocks(
        pose=jnp.concatenate([upper, lower]),
        cross=jnp.concatenate([belief.cross_cov, bias.map_cov]),
        map=belief.map_cov,
    )


def with_gaussian(belief: Belief, shift: Array, cov: CovarianceBlocks) -> Belief:
    """The belief with its mean shifted, the heading wrapped, and another covariance.

    Args:
        belief: The belief.
        shift: (D,) change of the mean; with biases (3 + 3 + 2 L,), those after the pose.
        cov: In the blocks of `covariance_blocks`.
    """
    if belief.bias is not None:
        bias = belief.bias._replace(
            mean=belief.bias.mean + shift[3:6],
            cov=cov.pose[3:, 3:],
            pose_cov=cov.pose[3:, :3],
            map_cov=cov.cross[3:],
        )
        belief, shift = belief._replace(bias=bias), jnp.concatenate([shift[:3], shift[6:]])
        cov = CovarianceBlocks(cov.pose[:3, :3], cov.cross[:3], cov.map)
    mean = belief.mean + shift
    return belief._replace(
        mean=mean.at[2].set(wrap_angle(mean[2])),
        pose_cov=cov.pose,
        cross_cov=cov.cross,
        map_cov=cov.map,
    )


def predict(
    belief: Belief,
    odometry: Array,
    odometry_cov: Array,
    *,
    linearisation: str = "standard",
    by_bias: Array | None = None,
) -> Belief:
    """Move the belief by odometry; landmarks stay.

        mean' = mean (+) odometry        cov' = F cov F^T + G Q G^T

    An error of the heading swings the displacement (dx, dy) [m, map frame], and nothing else
    changes between the old and the new pose's errors; G turns the noise into the map frame:

             [1  0  -dy]             [R(heading)  0]
        F =  [0  1   dx]        G =  [    0       1]
             [0  0    1]

    so F adds to the rows x and y a multiple of the row of the heading, and F cov F^T is two
    additions. With "first_estimates" the displacement counts from the pose as last predicted.

    Args:
        belief: Belief before the increment.
        odometry: (3,) odometry increment [m, m, rad], frame of the pose before it.
        odometry_cov: (3, 3) its covariance Q in the same frame.
        linearisation: One of `LINEARISATIONS`.
        by_bias: (3, 3) derivative of the increment by the biases of odometry, where the belief has
            some; `odometry_bias` has the equations.

    Raises:
        ValueError: The linearisation is none of them; while tracing.

    References:
        Paper, eqs. (3)-(5), (9)-(11).
    """
    check_linearisation(linearisation)
    pose = belief.pose
    predicted = compose(pose, odometry)
    start = belief.first_estimate[:3] if linearisation == "first_estimates" else pose
    displacement = predicted[:2] - start[:2]
    by_heading = jnp.stack([-displacement[1], displacement[0]])  # d (x, y) / d heading, of F
    to_map_frame = jnp.eye(3, dtype=odometry_cov.dtype).at[:2, :2].set(rotation(pose[2]))  # G
    pose_cov = belief.pose_cov.at[:2].add(by_heading[:, None] * belief.pose_cov[2:])
    pose_cov = pose_cov.at[:, :2].add(pose_cov[:, 2:] * by_heading[None])
    moved = belief._replace(
        mean=belief.mean.at[:3].set(predicted),
        first_estimate=belief.first_estimate.at[:3].set(predicted),
        pose_cov=pose_cov + to_map_frame @ odometry_cov @ to_map_frame.T,
        cross_cov=belief.cross_cov.at[:2].add(by_heading[:, None] * belief.cross_cov[2:]),
    )
    if by_bias is None:
        return moved
    return _add_bias_errors(moved, by_heading, to_map_frame @ by_bias)


def _add_bias_errors(belief: Belief, by_heading: Array, by_bias: Array) -> Belief:
    """Covariances of the predicted pose that come from the biases of odometry.

    Args:
        belief: Predicted without them.
        by_heading: (2,) derivative of x, y by the heading, of F.
        by_bias: (3, 3) J, derivative of the predicted pose by the biases.
    """
    bias = belief.bias
    assert bias is not None
    with_pose = bias.pose_cov.at[:, :2].add(bias.pose_cov[:, 2:] * by_heading[None])  # P_bp F^T
    mixed = by_bias @ with_pose
    return belief._replace(
        pose_cov=belief.pose_cov + mixed + mixed.T + by_bias @ bias.cov @ by_bias.T,
        cross_cov=belief.cross_cov + by_bias @ bias.map_cov,
        bias=bias._replace(pose_cov=with_pose + bias.cov @ by_bias.T),
    )


def linearize(
    belief: Belief, features: Features, R: Array, slot: Array, *, linearisation: str = "standard"
) -> LinearizedMeasurements:
    """Innovations of the matched features, and the Jacobians of their measurement model.

    Args:
        belief: Predicted belief.
        features: Features of the scan.
        R: (M, 2, 2) their covariance R: range [m] and bearing [rad], or direction [rad] and 0.
        slot: (M,) int32 matched slots, L where a feature is unmatched; otherwise unique.
        linearisation: One of `LINEARISATIONS`.

    Returns:
        Linearised measurements; unmatched ones are zero with unit noise, at slot 0.

    Raises:
        ValueError: The linearisation is none of them; while tracing.

    References:
        Paper, eqs. (12), (13).
    """
    check_linearisation(linearisation)
    matched = slot < belief.num_seen.size
    safe_slot = jnp.where(matched, slot, 0)
    kind = features.kind
    predict_all = jax.vmap(predict_measurement, in_axes=(None, 0, 0))
    predicted, H_pose, H_landmark = predict_all(
        belief.pose, belief.landmark_positions[safe_slot], kind
    )
    if linearisation == "first_estimates":
        first_positions = belief.first_estimate[3:].reshape(-1, 2)
        _, H_pose, H_landmark = predict_all(belief.pose, first_positions[safe_slot], kind)
    if belief.bias is not None:  # measured through the pose alone
        H_pose = jnp.pad(H_pose, ((0, 0), (0, 0), (0, len(belief.bias.mean))))
    keep = matched[:, None]
    eye = jnp.eye(2, dtype=R.dtype)
    return LinearizedMeasurements(
        residual=jnp.where(keep, residual(measure(features), predicted, kind), 0.0),
        H_pose=jnp.where(keep[..., None], H_pose, 0.0),
        H_landmark=jnp.where(keep[..., None], H_landmark, 0.0),
        R=jnp.where(keep[..., None], R, eye),
        slot=safe_slot,
    )


def update(
    belief: Belief,
    rows: LinearizedMeasurements,
    known: Innovation | None = None,
    *,
    linearisation: str = "standard",
) -> tuple[Belief, UpdateResult]:
    """Kalman update by all innovations of a scan at once.

    Args:
        belief: Predicted belief.
        rows: Linearised measurements, of `linearize`.
        known: Products of the two that are known already.
        linearisation: One of `LINEARISATIONS`.

    Returns:
        The belief, and the result of `kalman_update`.

    Raises:
        ValueError: The linearisation is none of them; while tracing.

    References:
        Paper, eqs. (14)-(16). Invariant: Barrau, Bonnabel (2015), "An EKF-SLAM algorithm with
        consistency properties"; Zhang et al. (2017), "Convergence and consistency analysis for a
        3-D invariant-EKF SLAM".
    """
    check_linearisation(linearisation)
    result = kalman_update(covariance_blocks(belief), rows, known)
    shift, cov = result.shift, result.cov
    if linearisation == "invariant":
        shift, cov = _retract_invariant(shift, cov, belief.kind == WALL)
    return with_gaussian(belief, shift, cov), result


def _retract_invariant(
    shift: Array, cov: CovarianceBlocks, is_wall: Array
) -> tuple[Array, CovarianceBlocks]:
    """Retraction of the right-invariant EKF on SE_{1+L}(2), in plain coordinates.

    With theta the error of the heading and T the turn by 90 degrees, (x, y) -> (-y, x), the
    right-invariant error of a position p, of the robot or of a landmark, is to first order

        p - R(theta) p_mean  =  (p - p_mean) - theta T p_mean.

    1. Mean. The exponential map of a shift (theta, d) moves p_mean to R(theta) p_mean
       + V (d - theta T p_mean). As theta V T = R(theta) - I, that is p_mean + V d:

           d' = V d,   V = mean of R(a) over a in 0..theta
                         = sin(theta / 2) / (theta / 2) R(theta / 2)

       with V the left Jacobian of SO(2). The shift of the heading stays as it is.

    2. Covariance. The filter keeps that of the invariant error when the mean moves. The plain
       error p - p_mean so gains theta T d'. With lever = T d' for each position, 0 for the
       heading, and e the unit vector of the heading,

           P' = (I + lever e^T) P (I + e lever^T)
              = P + lever a^T + a lever^T,   a = P e + (e^T P e) lever / 2

       which is an update of rank two.

    Args:
        shift: (D,) change of the mean by the Kalman update: d of each position, and theta.
        cov: P, covariance after that update.
        is_wall: (L,) bool, slots that are directions of walls; they are kept as they are.

    Returns:
        The shift (D,) with d', and P'.
    """
    theta = shift[2]
    left_jacobian = jnp.sinc(theta / (2 * jnp.pi)) * rotation(theta / 2)
    width = len(cov.pose)
    slot_shift = shift[width:].reshape(-1, 2)
    slot_shift = jnp.where(is_wall[:, None], slot_shift, slot_shift @ left_jacobian.T)
    pose_shift = jnp.concatenate([left_jacobian @ shift[:2], theta[None]])
    lever_pose = jnp.stack([-pose_shift[1], pose_shift[0], jnp.zeros_like(theta)])
    if width > 3:  # biases of odometry stay as they are
        pose_shift = jnp.concatenate([pose_shift, shift[3:width]])
        lever_pose = jnp.pad(lever_pose, (0, width - 3))
    lever_map = jnp.stack([-slot_shift[:, 1], slot_shift[:, 0]], axis=-1)
    lever_map = jnp.where(is_wall[:, None], 0.0, lever_map).reshape(-1)
    heading_variance = cov.pose[2, 2]
    a_pose = cov.pose[2] + heading_variance * lever_pose / 2
    a_map = cov.cross[2] + heading_variance * lever_map / 2
    left = jnp.stack([lever_pose, a_pose]), jnp.stack([lever_map, a_map])
    right = jnp.stack([a_pose, lever_pose]), jnp.stack([a_map, lever_map])
    return jnp.concatenate([pose_shift, slot_shift.reshape(-1)]), add_block_products(
        cov, left, right
    )
