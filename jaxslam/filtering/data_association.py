"""Data association of a scan with the map: matches with landmarks, and features that are new.

Features and landmarks are compared in pairs, (M, L). The two numbers of a measurement have no axis
of their own in these arrays: for arrays as small as these, such an axis is slow.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.core.features import Features
from jaxslam.core.se2 import transform, wrap_angle, wrap_direction
from jaxslam.core.types import CORNER, JUNCTION, WALL, Array, check_array
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.compatibility import match_nearest
from jaxslam.filtering.covariance import slot_blocks
from jaxslam.filtering.measurement_model import measure, predict_measurement, wrapped_differences


class AssociationSpec(NamedTuple):
    """Thresholds of data association; static under jit.

    Attributes:
        gate: Largest squared Mahalanobis distance of a match; the chi-square quantile of two
            degrees of freedom at 99 %.
        ambiguity_margin: Least difference in squared distance between the nearest landmark and the
            next; a feature with less is ambiguous and stays unmatched.
        new_gate: Squared distance to all landmarks of its kind from which a feature may be new.
        min_separation: [m] distance to all landmarks of its kind from which a feature may be new;
            two landmarks nearer than this may be duplicates.
        min_wall_angle: [rad] likewise between wall directions.
        max_log_clearance_ratio: [-] largest logarithm of the ratio of two clearances that match.
        max_corner_difference: [rad] largest difference between two corners that match, in direction
            and in angle.
        verify_above_std: [m] standard deviation of a landmark's position relative to the robot
            above which its match needs verification.
        support_distance: [m] least distance to another match of the scan that can verify it.
        verify_scans: Number of consecutive scans with such a match that verify it instead.
    """

    gate: float = 9.21
    ambiguity_margin: float = 4.0
    new_gate: float = 25.0
    min_separation: float = 0.3
    min_wall_angle: float = 0.26
    max_log_clearance_ratio: float = 0.3
    max_corner_difference: float = 0.5
    verify_above_std: float = 0.3
    support_distance: float = 0.5
    verify_scans: int = 2


class Matches(NamedTuple):
    """Matches of the features of a scan, as a step narrows them down.

    Attributes:
        slot: (M,) int32 slot of the matched landmark, L for none.
        used: (M,) bool, the match updates the state; a match with an unconfirmed landmark does not.
        order: (K,) int32 feature of each of the K rows of the update.
    """

    slot: Array
    used: Array
    order: Array


class Association(NamedTuple):
    """Association of the features of a scan with landmarks.

    Attributes:
        slot: (M,) int32 slot of the matched landmark, L for none.
        is_new: (M,) bool, the feature is to become a new landmark.
        new_slot: (M,) int32 slot that a new landmark must get, L for none; None for any slot.
    """

    slot: Array
    is_new: Array
    new_slot: Array | None


def mahalanobis_distances(belief: Belief, features: Features, R: Array) -> Array:
    """Squared Mahalanobis distance (M, L) of every feature from every slot.

    For feature m with measurement z_m and noise R_m, and landmark l with prediction h_l and
    Jacobians H_p (2, 3), H_l (2, 2) with respect to the pose p and the landmark:

        S_l  = H_p P_pp H_p^T + H_p P_pl H_l^T + (H_p P_pl H_l^T)^T + H_l P_ll H_l^T
        d_ml = v^T (S_l + R_m)^-1 v,    v = z_m - h_l

    Args:
        belief: Predicted belief.
        features: Features of the scan.
        R: (M, 2, 2) their measurement covariance.
    """
    predicted, predicted_cov = _predicted_measurements(belief)

    def entry(i: int, j: int) -> Array:
        """Entry [i, j] of S_l + R_m, of all pairs (M, L)."""
        return predicted_cov[None, :, i, j] + R[:, None, i, j]

    a, b, d = entry(0, 0), 0.5 * (entry(0, 1) + entry(1, 0)), entry(1, 1)
    measured = measure(features)
    x, y = (measured[:, None, i] - predicted[None, :, i] for i in range(2))
    x, y = wrapped_differences(x, y, (belief.kind == WALL)[None])
    return squared_mahalanobis(a, b, d, x, y)


def _predicted_measurements(belief: Belief) -> tuple[Array, Array]:
    """Predicted measurement (L, 2) of every slot, and its covariance (L, 2, 2) without noise."""
    size = belief.num_seen.size
    predicted, by_pose, by_slot = jax.vmap(predict_measurement, in_axes=(None, 0, 0))(
        belief.pose, belief.landmark_positions, belief.kind
    )
    cross_cov = belief.cross_cov.reshape(3, size, 2).transpose(1, 0, 2)  # (L, 3, 2)
    slot_cov = slot_blocks(belief.map_cov)  # (L, 2, 2)
    mixed = jnp.einsum("lij,ljk,lmk->lim", by_pose, cross_cov, by_slot)
    cov = jnp.einsum("lij,jk,lmk->lim", by_pose, belief.pose_cov, by_pose)
    cov += mixed + jnp.swapaxes(mixed, 1, 2)
    cov += jnp.einsum("lij,ljk,lmk->lim", by_slot, slot_cov, by_slot)
    return predicted, cov


def squared_mahalanobis(a: Array, b: Array, d: Array, x: Array, y: Array) -> Array:
    """Squared Mahalanobis norms of (x, y) by covariances [[a, b], [b, d]], all of one shape."""
    determinant = jnp.maximum(a * d - b * b, 1e-12)
    return (d * x * x - 2 * b * x * y + a * y * y) / determinant


def resembles(
    belief: Belief,
    features: Features,
    *,
    max_log_clearance_ratio: float,
    max_corner_difference: float,
) -> Array:
    """Pairs (M, L) bool of feature and slot with equal kind and similar descriptor.

    Junctions must have similar clearance; corners a similar angle, and face a similar direction.
    Positions are not compared.

    Args:
        belief: Predicted belief.
        features: Features of the scan.
        max_log_clearance_ratio: [-] largest logarithm of the ratio of clearances.
        max_corner_difference: [rad] largest difference of corners, in direction and in angle.
    """
    same_kind = features.kind[:, None] == belief.kind[None]
    same_kind &= (belief.num_seen > 0)[None] & features.valid[:, None]
    facing = features.direction[:, None] + belief.pose[2] - belief.direction[None]
    return same_kind & similar_descriptors(
        features.kind[:, None],
        features.descriptor[:, None],
        belief.descriptor[None],
        facing,
        max_log_clearance_ratio=max_log_clearance_ratio,
        max_corner_difference=max_corner_difference,
    )


def similar_descriptors(
    kind: Array,
    first: Array,
    second: Array,
    facing: Array,
    *,
    max_log_clearance_ratio: float,
    max_corner_difference: float,
) -> Array:
    """Whether the descriptors of two things of one kind agree; always, for walls.

    Args:
        kind: int32 their kind.
        first: Descriptor of the first: clearance [m] of a junction, angle [rad] of a corner.
        second: Descriptor of the second.
        facing: [rad] difference of the directions that they face.
        max_log_clearance_ratio: [-] largest logarithm of the ratio of clearances.
        max_corner_difference: [rad] largest difference of corners, in direction and in angle.
    """
    log_ratio = jnp.log(jnp.maximum(first, 1e-3) / jnp.maximum(second, 1e-3))
    is_similar_junction = jnp.abs(log_ratio) < max_log_clearance_ratio
    is_similar_corner = jnp.abs(wrap_angle(facing)) < max_corner_difference
    is_similar_corner &= jnp.abs(first - second) < max_corner_difference
    other = jnp.where(kind == CORNER, is_similar_corner, True)
    return jnp.where(kind == JUNCTION, is_similar_junction, other)


def far_from_landmarks(
    spec: AssociationSpec, belief: Belief, features: Features, distance: Array
) -> Array:
    """Features (M,) bool that are far enough from all landmarks of their kind to be new.

    Args:
        spec: Thresholds.
        belief: Predicted belief.
        features: Features of the scan.
        distance: (M, L) squared Mahalanobis distances.
    """
    same_kind = (features.kind[:, None] == belief.kind[None]) & (belief.num_seen > 0)[None]
    feature, landmark = transform(belief.pose, features.xy), belief.landmark_positions
    dx = feature[:, None, 0] - landmark[None, :, 0]
    dy = feature[:, None, 1] - landmark[None, :, 1]
    angle = features.direction[:, None] + belief.pose[2] - landmark[None, :, 0]
    is_wall = (features.kind == WALL)[:, None]
    near = (dx * dx + dy * dy < spec.min_separation**2) | (distance < spec.new_gate)
    near = jnp.where(is_wall, jnp.abs(wrap_direction(angle)) < spec.min_wall_angle, near)
    return features.valid & ~jnp.any(same_kind & near, axis=1)


def associate(spec: AssociationSpec, belief: Belief, features: Features, R: Array) -> Association:
    """Associate features with landmarks by Mahalanobis distance, kind and descriptor.

    Args:
        spec: Thresholds.
        belief: Predicted belief.
        features: Features of the scan.
        R: (M, 2, 2) their measurement covariance.
    """
    distance = lax.stop_gradient(mahalanobis_distances(belief, features, R))
    possible = resembles(
        belief,
        features,
        max_log_clearance_ratio=spec.max_log_clearance_ratio,
        max_corner_difference=spec.max_corner_difference,
    )
    slot = match_nearest(distance, possible, gate=spec.gate, margin=spec.ambiguity_margin)
    is_new = (slot == belief.num_seen.size) & far_from_landmarks(spec, belief, features, distance)
    return Association(slot, is_new, None)


def use_known_ids(belief: Belief, features: Features, landmark_ids: Array) -> Association:
    """Associate features with landmarks by known ids; of several features with one id, the first.

    Args:
        belief: Predicted belief.
        features: Features of the scan.
        landmark_ids: (M,) int32 landmark 0..L-1 of each feature, -1 for none; it is its slot, too.

    Raises:
        ValueError: `landmark_ids` has another shape or type than the features; while tracing.
    """
    check_array("landmark_ids", landmark_ids, features.kind.shape, jnp.int32)
    size = belief.num_seen.size
    has_id = features.valid & (landmark_ids >= 0) & (landmark_ids < size)
    same_id = (landmark_ids[:, None] == landmark_ids[None]) & has_id[None]
    has_id &= ~jnp.any(jnp.tril(same_id, -1), axis=1)
    slot = jnp.where(has_id, landmark_ids, size)
    in_map = belief.num_seen.at[slot].get(mode="fill", fill_value=0) > 0
    return Association(jnp.where(in_map, slot, size), has_id & ~in_map, slot)
