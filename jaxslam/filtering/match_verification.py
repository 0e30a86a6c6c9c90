"""Matches verified by joint compatibility and rigidity; missed detections; duplicate landmarks."""

import jax.numpy as jnp

from jaxslam.core.features import Features
from jaxslam.core.se2 import wrap_angle
from jaxslam.core.types import JUNCTION, WALL, Array
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.compatibility import JointMatches, jointly_compatible
from jaxslam.filtering.covariance import slot_blocks, slot_rows
from jaxslam.filtering.data_association import (
    AssociationSpec,
    similar_descriptors,
    squared_mahalanobis,
)
from jaxslam.filtering.joint_covariance import LinearizedMeasurements


def verify_matches(
    spec: AssociationSpec,
    belief: Belief,
    features: Features,
    linearized: LinearizedMeasurements,
    s: Array,
) -> tuple[JointMatches, Array]:
    """Verify the matches of a scan before they update the state.

        consistent = matches that pass the joint compatibility test        (`jointly_compatible`)
        uncertain  = point landmarks whose position relative to the robot has a large covariance
        supported  = another consistent point match lies at the right distance,
                     or this is the `spec.verify_scans`-th scan in a row with such a match
        accepted   = consistent and (not uncertain or supported)

    The gate of a landmark that was out of view for long is wide, and may contain other landmarks.
    Its match is supported by a second one as follows. The distance between two features does not
    depend on the pose, whose error is what makes the gate wide, so it is compared with the map's:

        feature i  o---- |f_i - f_j| ----o  feature j        base_link frame
                   :                     :                   : matched
        landmark i o---- |l_i - l_j| ----o  landmark j       map frame

    Args:
        spec: Thresholds.
        belief: Predicted belief.
        features: Features that are matched.
        linearized: Their innovations; zero where there is no match.
        s: (2 M, 2 M) joint covariance of the innovations.

    Returns:
        The accepted matches, their joint covariance factored; and for each slot (L,) int32 the
        number of consecutive scans in which it was matched and not yet accepted.
    """
    matched = jnp.any(linearized.H_landmark != 0.0, axis=(1, 2))
    is_point = matched & (features.kind != WALL)
    degrees = jnp.where(matched, jnp.where(features.kind == WALL, 1, 2), 0).astype(jnp.int32)
    squared_range = jnp.sum(features.xy**2, axis=1)
    uncertain = is_point & (
        _position_variance(linearized, s, squared_range) > spec.verify_above_std**2
    )
    agrees = _distances_agree(spec, belief, features, linearized, squared_range)
    seen_before = belief.num_pending[linearized.slot] + 1 >= spec.verify_scans

    def accept(consistent: Array) -> Array:
        supported = jnp.any(agrees & (is_point & consistent)[None], axis=1) | seen_before
        return ~uncertain | supported

    verified = jointly_compatible(s, linearized.residual, degrees, review=accept)
    accepted = verified.kept
    pending = is_point & verified.passed & ~accepted
    size = belief.num_seen.size
    num_pending = belief.num_pending.at[jnp.where(accepted, linearized.slot, size)].set(
        0, mode="drop"
    )
    num_pending = num_pending.at[jnp.where(pending, linearized.slot, size)].add(1, mode="drop")
    return verified, num_pending


def _position_variance(rows: LinearizedMeasurements, s: Array, squared_range: Array) -> Array:
    """Variance (M,) [m^2] of predicted positions relative to the robot: var_r + r^2 var_bearing.

    That of the prediction alone: the measurement noise is taken off the innovation covariance.
    """
    count = rows.slot.size
    index = jnp.arange(count, dtype=jnp.int32)
    predicted_cov = s.reshape(count, 2, count, 2)[index, :, index] - rows.R
    return predicted_cov[:, 0, 0] + squared_range * predicted_cov[:, 1, 1]


def _distances_agree(
    spec: AssociationSpec,
    belief: Belief,
    features: Features,
    rows: LinearizedMeasurements,
    squared_range: Array,
) -> Array:
    """Pairs (M, M) bool of matches whose features are as far apart as their landmarks.

    The squared difference of the two distances must be inside the gate. The variance of a distance
    is bounded by the trace of the covariance of the offset: of the landmarks
    tr P_ii + tr P_jj - 2 tr P_ij, of the features tr F_i + tr F_j with tr F = R_r + r^2 R_bearing.
    Features nearer to each other than `spec.support_distance` do not count.
    """
    count, size = rows.slot.size, belief.num_seen.size
    index = jnp.arange(count, dtype=jnp.int32)
    measured = _pairwise_distances(features.xy)
    mapped = _pairwise_distances(belief.landmark_positions[rows.slot])
    map_cov = slot_rows(belief.map_cov, rows.slot).reshape(count, 2, size, 2)[:, :, rows.slot]
    own = _trace(map_cov[index, :, index])
    map_variance = own[:, None] + own[None] - 2 * _trace(jnp.moveaxis(map_cov, 2, 1))
    feature_variance = rows.R[:, 0, 0] + squared_range * rows.R[:, 1, 1]
    variance = map_variance + feature_variance[:, None] + feature_variance[None]
    agrees = (measured - mapped) ** 2 < spec.gate * jnp.maximum(variance, 0.0)
    return agrees & (measured > spec.support_distance) & (index[:, None] != index[None])


def _pairwise_distances(xy: Array) -> Array:
    """Distances (M, M) [m] between points (M, 2), smooth at zero."""
    dx, dy = xy[:, None, 0] - xy[None, :, 0], xy[:, None, 1] - xy[None, :, 1]
    return jnp.sqrt(dx**2 + dy**2 + 1e-6)


def _trace(blocks: Array) -> Array:
    """Traces (...) of blocks (..., 2, 2)."""
    return blocks[..., 0, 0] + blocks[..., 1, 1]


def missed_detection(belief: Belief, field_of_view: tuple[float, float]) -> Array:
    r"""Junctions (L,) bool that the scan must show if they exist, to detect missed ones.

    No obstacle lies in the circle around a junction J whose radius is its clearance c. From inside
    the circle J is visible. The robot R must be inside half the radius, to allow for errors of
    both, but not within 0.1 m of J, and J must be inside the field of view by 0.2 rad.

          . - - - - - .
        /    . - - .    \       outer circle: radius c, no obstacle inside
       |   /         \   |      inner circle: radius c / 2, where R must be
       |  |     J     |  |
       |   \    R    /   |
        \    ' - - '    /
          ' - - - - - '

    Args:
        belief: Updated belief.
        field_of_view: First and last bearing [rad] of the scanner, base_link frame. A scanner of a
            whole turn (to 0.1 rad) sees all around.
    """
    offset = belief.landmark_positions - belief.pose[None, :2]
    distance = jnp.sqrt(jnp.sum(offset**2, axis=1))
    bearing = wrap_angle(jnp.arctan2(offset[:, 1], offset[:, 0]) - belief.pose[2])
    sees_all_around = field_of_view[1] - field_of_view[0] >= 2 * jnp.pi - 0.1
    in_view = sees_all_around | (
        (bearing > field_of_view[0] + 0.2) & (bearing < field_of_view[1] - 0.2)
    )
    in_circle = (distance < belief.descriptor / 2) & (distance > 0.1)
    return (belief.kind == JUNCTION) & (belief.num_seen > 0) & in_circle & in_view


def find_duplicate(spec: AssociationSpec, belief: Belief, slot: Array) -> Array:
    """Find a duplicate of a landmark: another slot that holds the same physical landmark.

    A duplicate has the same kind (not a wall) and a similar descriptor, is nearer than
    `spec.min_separation`, and inside the gate by the covariance of the offset between landmarks i
    and j,

        S = P_ii + P_jj - P_ij - P_ij^T + (1 cm)^2 I

    Args:
        spec: Thresholds.
        belief: Updated belief.
        slot: () int32 slot i of the landmark, L for none.

    Returns:
        () int32 slot of the nearest duplicate by Mahalanobis distance, L for none.
    """
    size = belief.num_seen.size
    index = jnp.arange(size, dtype=jnp.int32)
    landmark = jnp.minimum(slot, size - 1)
    kind, descriptor, positions = belief.kind, belief.descriptor, belief.landmark_positions
    dx, dy = (positions - positions[landmark][None]).T
    own_cov = slot_blocks(belief.map_cov)  # (L, 2, 2)
    rows = slot_rows(belief.map_cov, landmark[None])
    cross_cov = rows.reshape(2, size, 2).transpose(1, 0, 2)  # (L, 2, 2) P_ij
    cov = own_cov + own_cov[landmark][None] - cross_cov - jnp.swapaxes(cross_cov, 1, 2)
    distance = squared_mahalanobis(cov[:, 0, 0] + 1e-4, cov[:, 0, 1], cov[:, 1, 1] + 1e-4, dx, dy)

    facing = belief.direction - belief.direction[landmark]
    is_duplicate = similar_descriptors(
        kind,
        descriptor,
        descriptor[landmark],
        facing,
        max_log_clearance_ratio=spec.max_log_clearance_ratio,
        max_corner_difference=spec.max_corner_difference,
    )
    is_duplicate &= (kind == kind[landmark]) & (kind != WALL) & (belief.num_seen > 0)
    is_duplicate &= (index != landmark) & (slot < size)
    is_duplicate &= (dx * dx + dy * dy < spec.min_separation**2) & (distance < spec.gate)
    nearest = jnp.argmin(jnp.where(is_duplicate, distance, jnp.inf))
    return jnp.where(jnp.any(is_duplicate), nearest, size).astype(jnp.int32)
