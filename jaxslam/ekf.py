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

from jaxslam.association import claim_slots
from jaxslam.belief import Belief, forget
from jaxslam.conditioning import Blocks, Conditioned, Rows, condition, plus
from jaxslam.covariance import put_rows, rows_at, subtract_seldom
from jaxslam.geometry import compose, rotation, to_world, wrap_angle, wrap_line
from jaxslam.linalg import add_products, inverse_root
from jaxslam.nodes import Nodes
from jaxslam.sensor import expect, observation, residual
from jaxslam.types import WALL, Array

LINEARISATIONS = ("standard", "first_estimates", "invariant")


def check_linearisation(name: str) -> None:
    """Raise ValueError unless `name` is one of `LINEARISATIONS`."""
    if name not in LINEARISATIONS:
        known = ", ".join(map(repr, LINEARISATIONS))
        raise ValueError(f"linearisation is {name!r}; known are {known}")


def blocks(belief: Belief) -> Blocks:
    """Covariance of the belief in blocks, as `condition` takes it."""
    return Blocks(belief.pose_cov, belief.cross_cov, belief.map_cov)


def _with_gaussian(belief: Belief, mean: Array, cov: Blocks) -> Belief:
    """The belief with another mean (D,), whose heading is wrapped, and another covariance."""
    return belief._replace(
        mean=mean.at[2].set(wrap_angle(mean[2])),
        pose_cov=cov.pose,
        cross_cov=cov.cross,
        map_cov=cov.map,
    )


def predict(
    belief: Belief, motion: Array, noise: Array, *, linearisation: str = "standard"
) -> Belief:
    """Move the belief by odometry; landmarks stay.

        mean' = mean (+) motion        cov' = F cov F^T + G Q G^T

    An error of the heading swings the displacement (dx, dy) [m, world frame], and nothing else
    changes between the old and the new pose's errors; G turns the noise into the world frame:

             [1  0  -dy]             [R(heading)  0]
        F =  [0  1   dx]        G =  [    0       1]
             [0  0    1]

    so F adds to the rows x and y a multiple of the row of the heading, and F cov F^T is two
    additions. With "first_estimates" the displacement counts from the pose as last predicted.

    Args:
        belief: Belief before the motion.
        motion: (3,) odometry increment [m, m, rad], frame of the pose before it.
        noise: (3, 3) its covariance Q in the same frame.
        linearisation: One of `LINEARISATIONS`.

    Raises:
        ValueError: The linearisation is none of them; while tracing.

    References:
        Paper, eqs. (3)-(5), (9)-(11).
    """
    check_linearisation(linearisation)
    pose = belief.pose
    predicted = compose(pose, motion)
    start = belief.anchor[:3] if linearisation == "first_estimates" else pose
    displacement = predicted[:2] - start[:2]
    by_heading = jnp.stack([-displacement[1], displacement[0]])  # d (x, y) / d heading, of F
    to_world_frame = jnp.eye(3, dtype=noise.dtype).at[:2, :2].set(rotation(pose[2]))  # G
    pose_cov = belief.pose_cov.at[:2].add(by_heading[:, None] * belief.pose_cov[2:])
    pose_cov = pose_cov.at[:, :2].add(pose_cov[:, 2:] * by_heading[None])
    return belief._replace(
        mean=belief.mean.at[:3].set(predicted),
        anchor=belief.anchor.at[:3].set(predicted),
        pose_cov=pose_cov + to_world_frame @ noise @ to_world_frame.T,
        cross_cov=belief.cross_cov.at[:2].add(by_heading[:, None] * belief.cross_cov[2:]),
    )


def innovations(
    belief: Belief, nodes: Nodes, noise: Array, slot: Array, *, linearisation: str = "standard"
) -> Rows:
    """Innovations of the matched features, and the Jacobians of their measurement model.

    Args:
        belief: Predicted belief.
        nodes: Features of the scan.
        noise: (M, 2, 2) their covariance R: range [m] and bearing [rad], or direction [rad] and 0.
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
    matched = slot < belief.seen.size
    safe_slot = jnp.where(matched, slot, 0)
    kind = nodes.kind
    predict_all = jax.vmap(expect, in_axes=(None, 0, 0))
    predicted, by_pose, by_slot = predict_all(belief.pose, belief.places[safe_slot], kind)
    if linearisation == "first_estimates":
        first_places = belief.anchor[3:].reshape(-1, 2)
        _, by_pose, by_slot = predict_all(belief.pose, first_places[safe_slot], kind)
    keep = matched[:, None]
    eye = jnp.eye(2, dtype=noise.dtype)
    return Rows(
        residual=jnp.where(keep, residual(observation(nodes), predicted, kind), 0.0),
        by_pose=jnp.where(keep[..., None], by_pose, 0.0),
        by_slot=jnp.where(keep[..., None], by_slot, 0.0),
        noise=jnp.where(keep[..., None], noise, eye),
        slot=safe_slot,
    )


def update(
    belief: Belief, seen: Rows, *, linearisation: str = "standard"
) -> tuple[Belief, Conditioned]:
    """Kalman update by all innovations of a scan at once.

    Args:
        belief: Predicted belief.
        seen: Linearised measurements, of `innovations`.
        linearisation: One of `LINEARISATIONS`.

    Returns:
        The belief, and the result of `condition`.

    Raises:
        ValueError: The linearisation is none of them; while tracing.

    References:
        Paper, eqs. (14)-(16). Invariant: Barrau, Bonnabel (2015), "An EKF-SLAM algorithm with
        consistency properties"; Zhang et al. (2017), "Convergence and consistency analysis for a
        3-D invariant-EKF SLAM".
    """
    check_linearisation(linearisation)
    done = condition(blocks(belief), seen)
    shift, cov = done.shift, done.cov
    if linearisation == "invariant":
        shift, cov = _retract_invariant(shift, cov, belief.kind == WALL)
    return _with_gaussian(belief, belief.mean + shift, cov), done


def _retract_invariant(shift: Array, cov: Blocks, is_wall: Array) -> tuple[Array, Blocks]:
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
    slot_shift = shift[3:].reshape(-1, 2)
    slot_shift = jnp.where(is_wall[:, None], slot_shift, slot_shift @ left_jacobian.T)
    pose_shift = jnp.concatenate([left_jacobian @ shift[:2], theta[None]])
    lever_pose = jnp.stack([-pose_shift[1], pose_shift[0], jnp.zeros_like(theta)])
    lever_map = jnp.stack([-slot_shift[:, 1], slot_shift[:, 0]], axis=-1)
    lever_map = jnp.where(is_wall[:, None], 0.0, lever_map).reshape(-1)
    heading_variance = cov.pose[2, 2]
    a_pose = cov.pose[2] + heading_variance * lever_pose / 2
    a_map = cov.cross[2] + heading_variance * lever_map / 2
    left = jnp.stack([lever_pose, a_pose]), jnp.stack([lever_map, a_map])
    right = jnp.stack([a_pose, lever_pose]), jnp.stack([a_map, lever_map])
    return jnp.concatenate([pose_shift, slot_shift.reshape(-1)]), plus(cov, left, right)


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
    size = belief.seen.size
    found = drop < size
    pair = jnp.stack([keep, jnp.where(found, drop, keep)])

    def difference(x: Array) -> Array:
        return x[..., 0, :] - x[..., 1, :]

    hp_pose = difference(belief.cross_cov.reshape(3, size, 2)[:, pair]).T  # (2, 3) H P
    hp_map = rows_at(belief.map_cov, pair)
    hp_map = hp_map[0] - hp_map[1]  # (2, 2 L)
    variance = std**2 * jnp.eye(2, dtype=hp_map.dtype)
    s = difference(hp_map.reshape(2, size, 2)[:, pair]) + variance
    root, _, good = inverse_root(s)
    root = jnp.where(found & good, root, 0.0)
    y_pose, y_map = root @ hp_pose, root @ hp_map
    white_residual = -root @ difference(belief.places[pair])
    cov = Blocks(
        pose=add_products(belief.pose_cov, y_pose, y_pose, sign=-1),
        cross=add_products(belief.cross_cov, y_pose, y_map, sign=-1),
        map=subtract_seldom(belief.map_cov, y_map, found),
    )
    shift = jnp.concatenate([white_residual @ y_pose, white_residual @ y_map])
    belief = _with_gaussian(belief, belief.mean + shift, cov)
    gone = found & good & (jnp.arange(size, dtype=jnp.int32) == drop)
    times_seen = belief.seen.at[drop].get(mode="fill", fill_value=0)
    times_seen = jnp.where(found & good, times_seen, 0)
    belief = belief._replace(seen=belief.seen.at[keep].add(times_seen))
    return forget(belief, gone)


def augment(
    belief: Belief,
    nodes: Nodes,
    noise: Array,
    wanted: Array,
    *,
    most: int,
    at: Array | None = None,
    worth: Array | None = None,
    linearisation: str = "standard",
) -> tuple[Belief, Array]:
    """Initialise landmarks from features, with their correlations to pose and map.

    For a feature z and the inverse measurement model l = g(pose, z), with its Jacobians G_p by the
    pose and G_z by the measurement,

        P_l,pose = G_p P_pp        P_l,map = G_p P_p,map
        P_ll'    = G_p P_pp G_p'^T  (+ G_z R G_z^T if l = l')

    Args:
        belief: Updated belief.
        nodes: Features of the scan.
        noise: (M, 2, 2) their covariance R: range [m] and bearing [rad], or direction [rad] and 0.
        wanted: (M,) bool, features to initialise as landmarks.
        most: How many at most, F; the first come first.
        at: (M,) int32 slot of each, which is its ID too; by default the slots of least eviction
            cost, and the next IDs.
        worth: (L,) eviction cost of the slots, infinite where it must not be evicted; by default
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
    size, most = belief.seen.size, min(most, wanted.size)
    # Wanted features first, so that a few rows suffice.
    order = jnp.argsort(~wanted, stable=True)[:most]
    if at is None:
        if worth is None:
            worth = jnp.where(belief.seen == 0, 0.0, jnp.inf)
        slot = claim_slots(worth, wanted[order])
    else:
        slot = jnp.where(wanted, at, size)[order]
    xy, kind, direction = nodes.xy[order], nodes.kind[order], nodes.direction[order]
    # With first estimates the Jacobian counts from the pose as last predicted.
    start = belief.anchor[:2] if linearisation == "first_estimates" else belief.pose[:2]
    values, by_pose, by_measurement = _inverse_model(belief.pose, start, xy, kind, direction)
    new_pose, new_map, new_new = _new_covariance(belief, by_pose, by_measurement, noise[order])

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
    new_id = belief.next_id + jnp.cumsum(taken, dtype=jnp.int32) - 1 if at is None else slot
    cross_cov = belief.cross_cov.at[:, row].set(new_pose.T, mode="drop", unique_indices=True)
    belief = belief._replace(
        mean=put_values(belief.mean),
        anchor=put_values(belief.anchor),
        cross_cov=cross_cov,
        map_cov=map_cov,
        seen=put(belief.seen, jnp.ones_like(slot)),
        last=put(belief.last, jnp.broadcast_to(belief.step, slot.shape)),
        kind=put(belief.kind, kind),
        id=put(belief.id, new_id),
        missed=put(belief.missed, jnp.zeros_like(slot)),
        looks=put(belief.looks, jnp.zeros_like(slot)),
        direction=put(belief.direction, wrap_angle(direction + belief.pose[2])),
        shape=put(belief.shape, nodes.shape[order]),
        next_id=belief.next_id + jnp.sum(taken, dtype=jnp.int32),
    )
    return belief, jnp.full(wanted.shape, size, jnp.int32).at[order].set(slot)


def _inverse_model(
    pose: Array, start: Array, xy: Array, kind: Array, direction: Array
) -> tuple[Array, Array, Array]:
    """Inverse measurement model l = g(pose, z) of F features, and its Jacobians.

    With p the feature's position in the world, o = p - pose_xy, and s = p - start,

        junction, corner:  l = p,             G_p = [1  0  -s_y]   G_z = [o / |o|, (-o_y, o_x)]
                                                    [0  1   s_x]
        wall:              l = (angle, 0),    G_p = [0  0  1]      G_z = [1  0]
                                                    [0  0  0]            [0  0]

    Args:
        pose: (3,) mean pose, world frame.
        start: (2,) position of the robot at which G_p is taken.
        xy: (F, 2) positions of the features [m], robot frame.
        kind: (F,) int32.
        direction: (F,) [rad] robot frame, of walls.

    Returns:
        Values l of the landmarks (2 F,), G_p (F, 2, 3) and G_z (F, 2, 2).
    """
    is_wall = (kind == WALL)[:, None]
    position = to_world(pose, xy)
    angle = jnp.stack([wrap_line(direction + pose[2]), jnp.zeros_like(direction)], axis=-1)

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
