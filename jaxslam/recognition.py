"""Data association of a scan with the map: matches, their verification, new and missed landmarks.

Features and landmarks are compared in pairs, (M, L). The two numbers of a measurement have no axis
of their own in these arrays: for arrays as small as these, such an axis is slow.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxslam.association import compatible, match
from jaxslam.belief import Belief
from jaxslam.conditioning import Rows
from jaxslam.covariance import blocks_of, rows_at
from jaxslam.geometry import to_world, wrap_angle, wrap_line
from jaxslam.nodes import Nodes
from jaxslam.sensor import differences, expect, observation
from jaxslam.types import CORNER, NODE, WALL, Array
from jaxslam.types import expect as expect_type


class MatchSpec(NamedTuple):
    """Thresholds of data association; static under jit.

    Attributes:
        gate: Largest squared Mahalanobis distance of a match; the chi-square quantile of two
            degrees of freedom at 99 %.
        margin: Least difference in squared distance between the nearest landmark and the next; a
            feature with less is ambiguous and stays unmatched.
        far: Squared distance to all landmarks of its kind from which a feature may be new.
        apart: [m] distance to all landmarks of its kind from which a feature may be new; two
            landmarks nearer than this may be duplicates.
        wall_apart: [rad] likewise between wall directions.
        shape: [-] largest logarithm of the ratio of two clearances that match.
        turn: [rad] largest difference between two corners that match, in direction and in angle.
        lost: [m] standard deviation of a landmark's position relative to the robot above which its
            match needs verification.
        witness: [m] least distance to another match of the scan that can verify it.
        looks: Number of consecutive scans with such a match that verify it instead.
    """

    gate: float = 9.21
    margin: float = 4.0
    far: float = 25.0
    apart: float = 0.3
    wall_apart: float = 0.26
    shape: float = 0.3
    turn: float = 0.5
    lost: float = 0.3
    witness: float = 0.5
    looks: int = 2


class Recognised(NamedTuple):
    """Association of the features of a scan with landmarks.

    Attributes:
        slot: (M,) int32 slot of the matched landmark, L for none.
        new: (M,) bool, the feature is to become a new landmark.
        at: (M,) int32 slot that a new landmark must get, L for none; None where any slot will do.
    """

    slot: Array
    new: Array
    at: Array | None


def distances(belief: Belief, nodes: Nodes, noise: Array) -> Array:
    """Squared Mahalanobis distance (M, L) of every feature from every slot.

    For feature m with measurement z_m and noise R_m, and landmark l with prediction h_l and
    Jacobians H_p (2, 3), H_l (2, 2) with respect to the pose p and the landmark:

        S_l  = H_p P_pp H_p^T + H_p P_pl H_l^T + (H_p P_pl H_l^T)^T + H_l P_ll H_l^T
        d_ml = v^T (S_l + R_m)^-1 v,    v = z_m - h_l

    Args:
        belief: Predicted belief.
        nodes: Features of the scan.
        noise: (M, 2, 2) their measurement covariance.
    """
    predicted, predicted_cov = _predicted_measurements(belief)

    def entry(i: int, j: int) -> Array:
        """Entry [i, j] of S_l + R_m, of all pairs (M, L)."""
        return predicted_cov[None, :, i, j] + noise[:, None, i, j]

    a, b, d = entry(0, 0), 0.5 * (entry(0, 1) + entry(1, 0)), entry(1, 1)
    measured = observation(nodes)
    x, y = (measured[:, None, i] - predicted[None, :, i] for i in range(2))
    x, y = differences(x, y, (belief.kind == WALL)[None])
    return _squared_norm(a, b, d, x, y)


def _predicted_measurements(belief: Belief) -> tuple[Array, Array]:
    """Predicted measurement (L, 2) of every slot, and its covariance (L, 2, 2) without noise."""
    size = belief.seen.size
    predicted, by_pose, by_slot = jax.vmap(expect, in_axes=(None, 0, 0))(
        belief.pose, belief.places, belief.kind
    )
    cross_cov = belief.cross_cov.reshape(3, size, 2).transpose(1, 0, 2)  # (L, 3, 2)
    slot_cov = blocks_of(belief.map_cov)  # (L, 2, 2)
    mixed = jnp.einsum("lij,ljk,lmk->lim", by_pose, cross_cov, by_slot)
    cov = jnp.einsum("lij,jk,lmk->lim", by_pose, belief.pose_cov, by_pose)
    cov += mixed + jnp.swapaxes(mixed, 1, 2)
    cov += jnp.einsum("lij,ljk,lmk->lim", by_slot, slot_cov, by_slot)
    return predicted, cov


def _squared_norm(a: Array, b: Array, d: Array, x: Array, y: Array) -> Array:
    """Squared Mahalanobis norms of (x, y) by covariances [[a, b], [b, d]], all of one shape."""
    determinant = jnp.maximum(a * d - b * b, 1e-12)
    return (d * x * x - 2 * b * x * y + a * y * y) / determinant


def alike(belief: Belief, nodes: Nodes, *, shape: float, turn: float) -> Array:
    """Pairs (M, L) bool of feature and slot with equal kind and similar descriptor.

    Junctions must have similar clearance; corners a similar angle, and face a similar direction.
    Positions are not compared.

    Args:
        belief: Predicted belief.
        nodes: Features of the scan.
        shape: [-] largest logarithm of the ratio of clearances.
        turn: [rad] largest difference of corners, in direction and in angle.
    """
    same_kind = nodes.kind[:, None] == belief.kind[None]
    same_kind &= (belief.seen > 0)[None] & nodes.valid[:, None]
    facing = nodes.direction[:, None] + belief.pose[2] - belief.direction[None]
    return same_kind & _similar(
        nodes.kind[:, None],
        nodes.shape[:, None],
        belief.shape[None],
        facing,
        shape=shape,
        turn=turn,
    )


def _similar(
    kind: Array, first: Array, second: Array, facing: Array, *, shape: float, turn: float
) -> Array:
    """Whether the descriptors of two things of one kind agree; always, for walls.

    Args:
        kind: int32 their kind.
        first: Descriptor of the first: clearance [m] of a junction, angle [rad] of a corner.
        second: Descriptor of the second.
        facing: [rad] difference of the directions that they face.
        shape: [-] largest logarithm of the ratio of clearances.
        turn: [rad] largest difference of corners, in direction and in angle.
    """
    log_ratio = jnp.log(jnp.maximum(first, 1e-3) / jnp.maximum(second, 1e-3))
    junction = jnp.abs(log_ratio) < shape
    corner = (jnp.abs(wrap_angle(facing)) < turn) & (jnp.abs(first - second) < turn)
    return jnp.where(kind == NODE, junction, jnp.where(kind == CORNER, corner, True))


def unlike(spec: MatchSpec, belief: Belief, nodes: Nodes, distance: Array) -> Array:
    """Features (M,) bool that are far enough from all landmarks of their kind to be new.

    Args:
        spec: Thresholds.
        belief: Predicted belief.
        nodes: Features of the scan.
        distance: (M, L) squared Mahalanobis distances.
    """
    same_kind = (nodes.kind[:, None] == belief.kind[None]) & (belief.seen > 0)[None]
    feature, landmark = to_world(belief.pose, nodes.xy), belief.places
    dx = feature[:, None, 0] - landmark[None, :, 0]
    dy = feature[:, None, 1] - landmark[None, :, 1]
    angle = nodes.direction[:, None] + belief.pose[2] - landmark[None, :, 0]
    is_wall = (nodes.kind == WALL)[:, None]
    near = (dx * dx + dy * dy < spec.apart**2) | (distance < spec.far)
    near = jnp.where(is_wall, jnp.abs(wrap_line(angle)) < spec.wall_apart, near)
    return nodes.valid & ~jnp.any(same_kind & near, axis=1)


def recognise(spec: MatchSpec, belief: Belief, nodes: Nodes, noise: Array) -> Recognised:
    """Associate features with landmarks by Mahalanobis distance, kind and descriptor.

    Args:
        spec: Thresholds.
        belief: Predicted belief.
        nodes: Features of the scan.
        noise: (M, 2, 2) their measurement covariance.
    """
    distance = lax.stop_gradient(distances(belief, nodes, noise))
    possible = alike(belief, nodes, shape=spec.shape, turn=spec.turn)
    slot = match(distance, possible, gate=spec.gate, margin=spec.margin)
    new = (slot == belief.seen.size) & unlike(spec, belief, nodes, distance)
    return Recognised(slot, new, None)


def second_look(
    spec: MatchSpec, belief: Belief, nodes: Nodes, rows: Rows, s: Array
) -> tuple[Array, Array]:
    """Verify the matches of a scan before they update the state.

        consistent = matches that pass the joint compatibility test        (`compatible`)
        uncertain  = point landmarks whose position relative to the robot has a large covariance
        supported  = another consistent point match lies at the right distance,
                     or this is the `spec.looks`-th scan in a row with such a match
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
        nodes: Features that are matched.
        rows: Their innovations; zero where there is no match.
        s: (2 M, 2 M) joint covariance of the innovations.

    Returns:
        The accepted matches (M,) bool, and for each slot (L,) int32 the number of consecutive scans
        in which it was matched and not yet accepted.
    """
    matched = jnp.any(rows.by_slot != 0.0, axis=(1, 2))
    is_point = matched & (nodes.kind != WALL)
    degrees = jnp.where(matched, jnp.where(nodes.kind == WALL, 1, 2), 0).astype(jnp.int32)
    consistent = compatible(s, rows.residual, degrees)

    squared_range = jnp.sum(nodes.xy**2, axis=1)
    uncertain = is_point & (_position_variance(rows, s, squared_range) > spec.lost**2)
    agrees = _distances_agree(spec, belief, nodes, rows, squared_range)
    supported = jnp.any(agrees & (is_point & consistent)[None], axis=1)
    supported |= belief.looks[rows.slot] + 1 >= spec.looks

    accepted = consistent & (~uncertain | supported)
    pending = is_point & consistent & ~accepted
    size = belief.seen.size
    looks = belief.looks.at[jnp.where(accepted, rows.slot, size)].set(0, mode="drop")
    return accepted, looks.at[jnp.where(pending, rows.slot, size)].add(1, mode="drop")


def _position_variance(rows: Rows, s: Array, squared_range: Array) -> Array:
    """Variance (M,) [m^2] of predicted positions relative to the robot: var_r + r^2 var_bearing.

    That of the prediction alone: the measurement noise is taken off the innovation covariance.
    """
    count = rows.slot.size
    index = jnp.arange(count, dtype=jnp.int32)
    predicted_cov = s.reshape(count, 2, count, 2)[index, :, index] - rows.noise
    return predicted_cov[:, 0, 0] + squared_range * predicted_cov[:, 1, 1]


def _distances_agree(
    spec: MatchSpec, belief: Belief, nodes: Nodes, rows: Rows, squared_range: Array
) -> Array:
    """Pairs (M, M) bool of matches whose features are as far apart as their landmarks.

    The squared difference of the two distances must be inside the gate. The variance of a distance
    is bounded by the trace of the covariance of the offset: of the landmarks
    tr P_ii + tr P_jj - 2 tr P_ij, of the features tr F_i + tr F_j with tr F = R_r + r^2 R_bearing.
    Features nearer to each other than `spec.witness` do not count.
    """
    count, size = rows.slot.size, belief.seen.size
    index = jnp.arange(count, dtype=jnp.int32)
    measured = _pairwise_distances(nodes.xy)
    mapped = _pairwise_distances(belief.places[rows.slot])
    map_cov = rows_at(belief.map_cov, rows.slot).reshape(count, 2, size, 2)[:, :, rows.slot]
    own = _trace(map_cov[index, :, index])
    map_variance = own[:, None] + own[None] - 2 * _trace(jnp.moveaxis(map_cov, 2, 1))
    feature = rows.noise[:, 0, 0] + squared_range * rows.noise[:, 1, 1]
    variance = map_variance + feature[:, None] + feature[None]
    agrees = (measured - mapped) ** 2 < spec.gate * jnp.maximum(variance, 0.0)
    return agrees & (measured > spec.witness) & (index[:, None] != index[None])


def _pairwise_distances(xy: Array) -> Array:
    """Distances (M, M) [m] between points (M, 2), smooth at zero."""
    dx, dy = xy[:, None, 0] - xy[None, :, 0], xy[:, None, 1] - xy[None, :, 1]
    return jnp.sqrt(dx**2 + dy**2 + 1e-6)


def _trace(blocks: Array) -> Array:
    """Traces (...) of blocks (..., 2, 2)."""
    return blocks[..., 0, 0] + blocks[..., 1, 1]


def overdue(belief: Belief, view: tuple[float, float]) -> Array:
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
        view: First and last bearing [rad] of the scanner, base_link frame. A scanner of a whole
            turn (to 0.1 rad) sees all around.
    """
    offset = belief.places - belief.pose[None, :2]
    distance = jnp.sqrt(jnp.sum(offset**2, axis=1))
    bearing = wrap_angle(jnp.arctan2(offset[:, 1], offset[:, 0]) - belief.pose[2])
    sees_all_around = view[1] - view[0] >= 2 * jnp.pi - 0.1
    in_view = sees_all_around | ((bearing > view[0] + 0.2) & (bearing < view[1] - 0.2))
    in_circle = (distance < belief.shape / 2) & (distance > 0.1)
    return (belief.kind == NODE) & (belief.seen > 0) & in_circle & in_view


def twin(spec: MatchSpec, belief: Belief, slot: Array) -> Array:
    """Find a duplicate of a landmark: another slot that holds the same physical landmark.

    A duplicate has the same kind (not a wall), a similar descriptor, is nearer than `spec.apart`,
    and inside the gate by the covariance of the offset between landmarks i and j,

        S = P_ii + P_jj - P_ij - P_ij^T + (1 cm)^2 I

    Args:
        spec: Thresholds.
        belief: Updated belief.
        slot: () int32 slot i of the landmark, L for none.

    Returns:
        () int32 slot of the nearest duplicate by Mahalanobis distance, L for none.
    """
    size = belief.seen.size
    index = jnp.arange(size, dtype=jnp.int32)
    landmark = jnp.minimum(slot, size - 1)
    kind, descriptor, positions = belief.kind, belief.shape, belief.places
    dx, dy = (positions - positions[landmark][None]).T
    own_cov = blocks_of(belief.map_cov)  # (L, 2, 2)
    rows = rows_at(belief.map_cov, landmark[None])
    cross_cov = rows.reshape(2, size, 2).transpose(1, 0, 2)  # (L, 2, 2) P_ij
    cov = own_cov + own_cov[landmark][None] - cross_cov - jnp.swapaxes(cross_cov, 1, 2)
    distance = _squared_norm(cov[:, 0, 0] + 1e-4, cov[:, 0, 1], cov[:, 1, 1] + 1e-4, dx, dy)

    facing = belief.direction - belief.direction[landmark]
    is_duplicate = _similar(
        kind, descriptor, descriptor[landmark], facing, shape=spec.shape, turn=spec.turn
    )
    is_duplicate &= (kind == kind[landmark]) & (kind != WALL) & (belief.seen > 0)
    is_duplicate &= (index != landmark) & (slot < size)
    is_duplicate &= (dx * dx + dy * dy < spec.apart**2) & (distance < spec.gate)
    nearest = jnp.argmin(jnp.where(is_duplicate, distance, jnp.inf))
    return jnp.where(jnp.any(is_duplicate), nearest, size).astype(jnp.int32)


def identify(belief: Belief, nodes: Nodes, known: Array) -> Recognised:
    """Associate features with landmarks by known ids; of several features with one id, the first.

    Args:
        belief: Predicted belief.
        nodes: Features of the scan.
        known: (M,) int32 landmark 0..L-1 of each feature, -1 for none; it is its slot, too.

    Raises:
        ValueError: `known` has another shape or type than the features; while tracing.
    """
    expect_type("inputs.known", known, nodes.kind.shape, jnp.int32)
    size = belief.seen.size
    has_id = nodes.valid & (known >= 0) & (known < size)
    same_id = (known[:, None] == known[None]) & has_id[None]
    has_id &= ~jnp.any(jnp.tril(same_id, -1), axis=1)
    slot = jnp.where(has_id, known, size)
    in_map = belief.seen.at[slot].get(mode="fill", fill_value=0) > 0
    return Recognised(jnp.where(in_map, slot, size), has_id & ~in_map, slot)
