"""Landmarks added to the state with their cross-covariances, merged, and given slots."""

import jax.numpy as jnp
from jax import lax

from jaxslam.core.features import Features
from jaxslam.core.linalg import add_outer_products, inverse_cholesky
from jaxslam.core.ranking import stable_order
from jaxslam.core.se2 import transform, wrap_angle, wrap_direction
from jaxslam.core.types import WALL, Array
from jaxslam.filtering.belief import Belief, prune
from jaxslam.filtering.covariance import downdate_rarely, put_rows, slot_rows
from jaxslam.filtering.ekf import check_linearisation, covariance_blocks, with_gaussian
from jaxslam.filtering.joint_covariance import CovarianceBlocks


def merge(belief: Belief, keep: Array, drop: Array, *, std: float = 0.01) -> Belief:
    """Condition on two landmarks being at one position, and free the slot of the second.

    This is a Kalman update by the measurement p_keep - p_drop = 0.

    Args:
        belief: Updated belief.
        keep: () int32 slot that stays.
        drop: () int32 slot of the duplicate, which is freed; L where there is nothing to merge.
        std: Standard deviation [m] of the difference of their positions.

    Returns:
        The belief; unchanged if the innovation covariance is not positive definite.
    """
    size = belief.num_seen.size
    found = drop < size
    pair = jnp.stack([keep, jnp.where(found, drop, keep)])

    def difference(x: Array) -> Array:
        return x[..., 0, :] - x[..., 1, :]

    before = covariance_blocks(belief)
    width = len(before.pose)
    hp_pose = difference(before.cross.reshape(width, size, 2)[:, pair]).T  # (2, 3) H P
    hp_map = slot_rows(belief.map_cov, pair)
    hp_map = hp_map[0] - hp_map[1]  # (2, 2 L)
    variance = std**2 * jnp.eye(2, dtype=hp_map.dtype)
    s = difference(hp_map.reshape(2, size, 2)[:, pair]) + variance
    root, _, is_definite = inverse_cholesky(s)
    root = jnp.where(found & is_definite, root, 0.0)
    y_pose, y_map = root @ hp_pose, root @ hp_map
    white_residual = -root @ difference(belief.landmark_positions[pair])
    cov = CovarianceBlocks(
        pose=add_outer_products(before.pose, y_pose, y_pose, sign=-1),
        cross=add_outer_products(before.cross, y_pose, y_map, sign=-1),
        map=downdate_rarely(belief.map_cov, y_map, found),
    )
    shift = jnp.concatenate([white_residual @ y_pose, white_residual @ y_map])
    belief = with_gaussian(belief, shift, cov)
    gone = found & is_definite & (jnp.arange(size, dtype=jnp.int32) == drop)
    observations = belief.num_seen.at[drop].get(mode="fill", fill_value=0)
    observations = jnp.where(found & is_definite, observations, 0)
    belief = belief._replace(num_seen=belief.num_seen.at[keep].add(observations))
    return prune(belief, gone)


def augment(
    belief: Belief,
    features: Features,
    R: Array,
    wanted: Array,
    *,
    max_new: int,
    new_slot: Array | None = None,
    cost: Array | None = None,
    linearisation: str = "standard",
) -> tuple[Belief, Array]:
    """Initialise landmarks from features, with their correlations to pose and map.

    For a feature z and the inverse measurement model l = g(pose, z), with its Jacobians G_p by the
    pose and G_z by the measurement,

        P_l,pose = G_p P_pp        P_l,map = G_p P_p,map
        P_ll'    = G_p P_pp G_p'^T  (+ G_z R G_z^T if l = l')

    Args:
        belief: Updated belief.
        features: Features of the scan.
        R: (M, 2, 2) their covariance R: range [m] and bearing [rad], or direction [rad] and 0.
        wanted: (M,) bool, features to initialise as landmarks.
        max_new: How many at most, F; the first come first.
        new_slot: (M,) int32 slot of each, which is its ID too; by default the slots of least
            eviction cost, and the next IDs.
        cost: (L,) eviction cost of the slots, infinite where it must not be evicted; by default
            only free slots are used.
        linearisation: One of `LINEARISATIONS`.

    Returns:
        The belief, and the slot (M,) int32 of each feature's new landmark, L for none.

    Raises:
        ValueError: The linearisation is none of them; while tracing.

    References:
        Thrun, Burgard, Fox (2005), Probabilistic Robotics, table 10.2.
    """
    check_linearisation(linearisation)
    size, max_new = belief.num_seen.size, min(max_new, wanted.size)
    # Wanted features first, so that a few rows suffice.
    order = stable_order(jnp.where(wanted, 0.0, 1.0))[:max_new]
    if new_slot is None:
        if cost is None:
            cost = jnp.where(belief.num_seen == 0, 0.0, jnp.inf)
        slot = claim_slots(cost, wanted[order])
    else:
        slot = jnp.where(wanted, new_slot, size)[order]
    xy, kind, direction = features.xy[order], features.kind[order], features.direction[order]
    # With first estimates the Jacobian counts from the pose as last predicted.
    start = belief.first_estimate[:2] if linearisation == "first_estimates" else belief.pose[:2]
    values, by_pose, by_measurement = _inverse_model(belief.pose, start, xy, kind, direction)
    new_pose, new_map, new_new = _new_covariance(belief, by_pose, by_measurement, R[order])

    # Rows of the map's covariance (2 F,), two per landmark; 2 L, which is nowhere, for no slot.
    row = jnp.stack([2 * slot, jnp.minimum(2 * slot + 1, 2 * size)], axis=-1).reshape(-1)
    new_map = new_map.at[:, row].set(new_new, mode="drop", unique_indices=True)
    map_cov = put_rows(belief.map_cov, new_map, row)
    in_mean = jnp.where(row < 2 * size, 3 + row, belief.mean.size)

    def put_values(field: Array) -> Array:
        return field.at[in_mean].set(values, mode="drop", unique_indices=True)

    def put(field: Array, value: Array) -> Array:
        return field.at[slot].set(value.astype(field.dtype), mode="drop")

    taken = slot < size
    new_id = belief.next_id + jnp.cumsum(taken, dtype=jnp.int32) - 1 if new_slot is None else slot
    cross_cov = belief.cross_cov.at[:, row].set(new_pose.T, mode="drop", unique_indices=True)
    if belief.bias is not None:
        new_bias = jnp.einsum("mij,kj->kmi", by_pose, belief.bias.pose_cov).reshape(-1, row.size)
        map_rows = belief.bias.map_cov.at[:, row].set(new_bias, mode="drop", unique_indices=True)
        belief = belief._replace(bias=belief.bias._replace(map_cov=map_rows))
    belief = belief._replace(
        mean=put_values(belief.mean),
        first_estimate=put_values(belief.first_estimate),
        cross_cov=cross_cov,
        map_cov=map_cov,
        num_seen=put(belief.num_seen, jnp.ones_like(slot)),
        last_seen=put(belief.last_seen, jnp.broadcast_to(belief.step, slot.shape)),
        kind=put(belief.kind, kind),
        id=put(belief.id, new_id),
        num_missed=put(belief.num_missed, jnp.zeros_like(slot)),
        num_pending=put(belief.num_pending, jnp.zeros_like(slot)),
        direction=put(belief.direction, wrap_angle(direction + belief.pose[2])),
        descriptor=put(belief.descriptor, features.descriptor[order]),
        next_id=belief.next_id + jnp.sum(taken, dtype=jnp.int32),
    )
    return belief, jnp.full(wanted.shape, size, jnp.int32).at[order].set(slot)


def _inverse_model(
    pose: Array, start: Array, xy: Array, kind: Array, direction: Array
) -> tuple[Array, Array, Array]:
    """Inverse measurement model l = g(pose, z) of F features, and its Jacobians.

    With p the feature's position in the map, o = p - pose_xy, and s = p - start,

        junction, corner:  l = p,             G_p = [1  0  -s_y]   G_z = [o / |o|, (-o_y, o_x)]
                                                    [0  1   s_x]
        wall:              l = (angle, 0),    G_p = [0  0  1]      G_z = [1  0]
                                                    [0  0  0]            [0  0]

    Args:
        pose: (3,) mean pose, map frame.
        start: (2,) position of the robot at which G_p is taken.
        xy: (F, 2) positions of the features [m], base_link frame.
        kind: (F,) int32.
        direction: (F,) [rad] base_link frame, of walls.

    Returns:
        Values l of the landmarks (2 F,), G_p (F, 2, 3) and G_z (F, 2, 2).
    """
    is_wall = (kind == WALL)[:, None]
    position = transform(pose, xy)
    angle = jnp.stack([wrap_direction(direction + pose[2]), jnp.zeros_like(direction)], axis=-1)

    offset = position - pose[None, :2]
    lever = position - start[None]
    zero, one = jnp.zeros_like(direction), jnp.ones_like(direction)
    by_pose = jnp.stack(
        [jnp.stack([one, zero, -lever[:, 1]], -1), jnp.stack([zero, one, lever[:, 0]], -1)], axis=1
    )
    wall_by_pose = jnp.zeros_like(by_pose).at[:, 0, 2].set(1.0)
    by_pose = jnp.where(is_wall[..., None], wall_by_pose, by_pose)

    distance = jnp.sqrt(jnp.maximum(jnp.sum(xy**2, axis=1), 1e-8))
    by_range, by_bearing = offset / distance[:, None], jnp.stack([-offset[:, 1], offset[:, 0]], -1)
    by_measurement = jnp.stack([by_range, by_bearing], axis=-1)
    wall_by_measurement = jnp.zeros_like(by_measurement).at[:, 0, 0].set(1.0)
    by_measurement = jnp.where(is_wall[..., None], wall_by_measurement, by_measurement)
    return jnp.where(is_wall, angle, position).reshape(-1), by_pose, by_measurement


def _new_covariance(
    belief: Belief, by_pose: Array, by_measurement: Array, noise: Array
) -> tuple[Array, Array, Array]:
    """Covariance of F new landmarks with the pose, with the map, and with each other.

    Args:
        belief: Before they are added.
        by_pose: (F, 2, 3) G_p.
        by_measurement: (F, 2, 2) G_z.
        noise: (F, 2, 2) R.

    Returns:
        P_l,pose (2 F, 3), P_l,map (2 F, 2 L) and P_ll' (2 F, 2 F).
    """
    count = len(by_pose)
    with_pose = jnp.einsum("mij,jk->mik", by_pose, belief.pose_cov).reshape(-1, 3)
    with_map = jnp.einsum("mij,jd->mid", by_pose, belief.cross_cov)
    with_new = jnp.einsum("mij,jk,nlk->minl", by_pose, belief.pose_cov, by_pose)
    index = jnp.arange(count)
    own = jnp.einsum("mij,mjk,mlk->mil", by_measurement, noise, by_measurement)
    with_new = with_new.at[index, :, index].add(own)  # (F, 2, F, 2)
    return with_pose, with_map.reshape(2 * count, -1), with_new.reshape(2 * count, -1)


def claim_slots(cost: Array, wanted: Array) -> Array:
    """Assign slots to features, the cheapest slot to the first feature.

    Args:
        cost: (L,) eviction cost of each slot: 0 for a free one, infinite for one that must not be
            evicted.
        wanted: (M,) bool, features that need a slot.

    Returns:
        (M,) int32 slot of each feature; L, out of range, where it gets none.
    """
    num_slots = cost.size
    negative_cost, order = lax.top_k(-cost, min(num_slots, wanted.size))  # of equals the first
    turn = jnp.cumsum(wanted, dtype=jnp.int32) - 1  # of each feature in the queue
    rank = jnp.clip(turn, 0, order.size - 1)
    available = wanted & (turn < order.size) & (negative_cost[rank] > -jnp.inf)
    return jnp.where(available, order[rank], num_slots).astype(jnp.int32)
