"""EKF-SLAM as pure functions: predict, innovations, update, augment.

The state is the robot's pose and two numbers a landmark slot: the position of a node or corner,
or the direction of a wall (and a zero). The algebra is structured: a prediction touches three
rows and columns, an update gathers the columns it needs, no dense F or H is ever built.

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
    """Covariance of the belief, as conditioning takes it."""
    return Blocks(belief.pose_cov, belief.cross_cov, belief.map_cov)


def _with(belief: Belief, mean: Array, cov: Blocks) -> Belief:
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

    Args:
        belief: Belief before the motion.
        motion: (3,) odometry increment, frame of the pose before it.
        noise: (3, 3) its covariance Q in the same frame.
        linearisation: One of `LINEARISATIONS`.

    Raises:
        ValueError: The linearisation is none of them; while tracing.

    References:
        Paper, eqs. (3)-(5), (9)-(11).
    """
    check_linearisation(linearisation)
    pose = belief.pose
    moved = compose(pose, motion)
    from_ = belief.anchor[:3] if linearisation == "first_estimates" else pose
    # The heading alone changes the other rows: d(x, y) / d heading = (-dy, dx) of the way made.
    way = moved[:2] - from_[:2]
    lever = jnp.stack([-way[1], way[0]])
    turn = jnp.eye(3, dtype=noise.dtype).at[:2, :2].set(rotation(pose[2]))
    pose_cov = belief.pose_cov.at[:2].add(lever[:, None] * belief.pose_cov[2:])
    pose_cov = pose_cov.at[:, :2].add(pose_cov[:, 2:] * lever[None])
    return belief._replace(
        mean=belief.mean.at[:3].set(moved),
        anchor=belief.anchor.at[:3].set(moved),
        pose_cov=pose_cov + turn @ noise @ turn.T,
        cross_cov=belief.cross_cov.at[:2].add(lever[:, None] * belief.cross_cov[2:]),
    )


def innovations(
    belief: Belief, nodes: Nodes, noise: Array, slot: Array, *, linearisation: str = "standard"
) -> Rows:
    """Residuals of the features whose slot (M,) is not L, and their derivatives.

    Args:
        belief: Predicted belief.
        nodes: Features of the scan.
        noise: (M, 2, 2) their covariance.
        slot: (M,) int32 matched slots, L where a feature is unmatched; no two alike.
        linearisation: One of `LINEARISATIONS`.

    Raises:
        ValueError: The linearisation is none of them; while tracing.

    References:
        Paper, eqs. (12), (13).
    """
    check_linearisation(linearisation)
    matched = slot < belief.seen.size
    at = jnp.where(matched, slot, 0)
    kind = nodes.kind
    expecting = jax.vmap(expect, in_axes=(None, 0, 0))
    expected, by_pose, by_slot = expecting(belief.pose, belief.places[at], kind)
    if linearisation == "first_estimates":
        places = belief.anchor[3:].reshape(-1, 2)
        _, by_pose, by_slot = expecting(belief.pose, places[at], kind)
    keep = matched[:, None]
    eye = jnp.eye(2, dtype=noise.dtype)
    return Rows(
        residual=jnp.where(keep, residual(observation(nodes), expected, kind), 0.0),
        by_pose=jnp.where(keep[..., None], by_pose, 0.0),
        by_slot=jnp.where(keep[..., None], by_slot, 0.0),
        noise=jnp.where(keep[..., None], noise, eye),
        slot=at,
    )


def update(
    belief: Belief, seen: Rows, *, linearisation: str = "standard"
) -> tuple[Belief, Conditioned]:
    """Condition on all innovations of a scan at once.

    Returns:
        The belief, and what `condition` says of the innovations.

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
        shift, cov = _retracted(shift, cov, belief.kind == WALL)
    return _with(belief, belief.mean + shift, cov), done


def merge(belief: Belief, keep: Array, drop: Array, *, std: float = 0.01) -> Belief:
    """Condition on two landmarks being one place, and forget the second.

    Args:
        belief: Updated belief.
        keep: () int32 slot.
        drop: () int32 slot to be forgotten; L where there is nothing to merge.
        std: How well [m] they are one.
    """
    size = belief.seen.size
    found = drop < size
    pair = jnp.stack([keep, jnp.where(found, drop, keep)])
    difference = lambda x: x[..., 0, :] - x[..., 1, :]
    hp = difference(belief.cross_cov.reshape(3, size, 2)[:, pair]).T  # (2, 3)
    hm = rows_at(belief.map_cov, pair)
    hm = hm[0] - hm[1]  # (2, 2 L)
    s = difference(hm.reshape(2, size, 2)[:, pair]) + std**2 * jnp.eye(2, dtype=hm.dtype)
    root, _, good = inverse_root(s)
    root = jnp.where(found & good, root, 0.0)
    y = root @ hp, root @ hm
    w = -root @ difference(belief.places[pair])
    cov = Blocks(
        pose=add_products(belief.pose_cov, y[0], y[0], sign=-1),
        cross=add_products(belief.cross_cov, y[0], y[1], sign=-1),
        map=subtract_seldom(belief.map_cov, y[1], found),
    )
    belief = _with(belief, belief.mean + jnp.concatenate([w @ y[0], w @ y[1]]), cov)
    gone = found & good & (jnp.arange(size, dtype=jnp.int32) == drop)
    more = jnp.where(found & good, belief.seen.at[drop].get(mode="fill", fill_value=0), 0)
    belief = belief._replace(seen=belief.seen.at[keep].add(more))
    return forget(belief, gone)


def _retracted(shift: Array, cov: Blocks, flat: Array) -> tuple[Array, Blocks]:
    """A shift (D,) as a move along the group SE_{1+L}(2), and the covariance that moves with it.

    The right-invariant error of a position p is p - exp(turn) p_mean: a filter that keeps the
    covariance of that error as it is when its mean moves is, in plain coordinates, one that swings
    each shift by half the turn, and then adds to each position the lever of the heading's error
    by which it moved. Slots that are walls, `flat` (L,) bool, are directions: they do not swing.
    """
    turn = shift[2]
    # Left Jacobian of SO(2): the mean of the rotations by 0..turn.
    swing = jnp.sinc(turn / (2 * jnp.pi)) * rotation(turn / 2)
    by_slot = shift[3:].reshape(-1, 2)
    moved = jnp.where(flat[:, None], by_slot, by_slot @ swing.T)
    step = jnp.concatenate([swing @ shift[:2], turn[None]])
    lever_pose = jnp.stack([-step[1], step[0], jnp.zeros_like(turn)])
    lever = jnp.stack([-moved[:, 1], moved[:, 0]], axis=-1)
    lever = jnp.where(flat[:, None], 0.0, lever).reshape(-1)
    # P' = (I + lever e^T) P (I + e lever^T), e the heading.
    spread = cov.pose[2, 2]
    pose, map = cov.pose[2] + spread * lever_pose / 2, cov.cross[2] + spread * lever / 2
    two = lambda a, b: jnp.stack([a, b])
    left = two(lever_pose, pose), two(lever, map)
    right = two(pose, lever_pose), two(map, lever)
    return jnp.concatenate([step, moved.reshape(-1)]), plus(cov, left, right)


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
    """Take features in as new landmarks, correlated with all the state as they should be.

        l = g(pose, z),   P_l* = G_p P_p*,   P_ll = G_p P_pp G_p^T + G_z R G_z^T

    Args:
        belief: Updated belief.
        nodes: Features of the scan.
        noise: (M, 2, 2) their covariance in range and bearing, or in direction and 0.
        wanted: (M,) bool, features to take in.
        most: How many at most; the first come first.
        at: (M,) int32 slot that each is to get, which is its id too; by default those of least
            worth, and the next ids.
        worth: (L,) what is lost with a slot; by default free ones may be taken, and no others.
        linearisation: One of `LINEARISATIONS`.

    Returns:
        The belief, and the slot (M,) that each feature got, L for none.

    Raises:
        ValueError: The linearisation is none of them; while tracing.
    """
    check_linearisation(linearisation)
    size, most = belief.seen.size, min(most, wanted.size)
    # Put the wanted features first, so that a few rows suffice.
    order = jnp.argsort(~wanted, stable=True)[:most]
    if at is None:
        if worth is None:
            worth = jnp.where(belief.seen == 0, 0.0, jnp.inf)
        slot = claim_slots(worth, wanted[order])
    else:
        slot = jnp.where(wanted, at, size)[order]
    xy, kind, direction = nodes.xy[order], nodes.kind[order], nodes.direction[order]
    is_wall = (kind == WALL)[:, None]
    pose = belief.pose
    place = to_world(pose, xy)
    wall = jnp.stack([wrap_line(direction + pose[2]), jnp.zeros_like(direction)], axis=-1)
    # As the last predicted pose saw it, where first estimates count.
    seat = belief.anchor[:2] if linearisation == "first_estimates" else pose[:2]
    arm = place - pose[None, :2]
    swung = place - seat[None]
    zero, one = jnp.zeros_like(direction), jnp.ones_like(direction)
    by_pose = jnp.stack(
        [jnp.stack([one, zero, -swung[:, 1]], -1), jnp.stack([zero, one, swung[:, 0]], -1)], axis=1
    )
    turns = jnp.zeros_like(by_pose).at[:, 0, 2].set(1.0)
    by_pose = jnp.where(is_wall[..., None], turns, by_pose)
    # d (x, y) / d (range, bearing) in the world frame is (arm / range, arm turned left).
    far = jnp.sqrt(jnp.maximum(jnp.sum(xy**2, axis=1), 1e-8))
    by_seen = jnp.stack([arm / far[:, None], jnp.stack([-arm[:, 1], arm[:, 0]], -1)], axis=-1)
    first = jnp.zeros_like(by_seen).at[:, 0, 0].set(1.0)
    by_seen = jnp.where(is_wall[..., None], first, by_seen)

    cross = jnp.einsum("mij,jk->mik", by_pose, belief.pose_cov).reshape(-1, 3)
    rows = jnp.einsum("mij,jd->mid", by_pose, belief.cross_cov)
    among = jnp.einsum("mij,jk,nlk->minl", by_pose, belief.pose_cov, by_pose)
    index = jnp.arange(most)
    own = jnp.einsum("mij,mjk,mlk->mil", by_seen, noise[order], by_seen)
    among = among.at[index, :, index].add(own)  # (F, 2, F, 2)
    row = jnp.stack([2 * slot, jnp.minimum(2 * slot + 1, 2 * size)], axis=-1).reshape(-1)
    alone = {"mode": "drop", "unique_indices": True}
    rows = rows.reshape(2 * most, -1).at[:, row].set(among.reshape(2 * most, -1), **alone)
    map_cov = put_rows(belief.map_cov, rows, row)
    place = jnp.where(is_wall, wall, place).reshape(-1)
    in_mean = jnp.where(row < 2 * size, 3 + row, belief.mean.size)

    def put(field: Array, value: Array) -> Array:
        return field.at[slot].set(value.astype(field.dtype), mode="drop")

    taken = slot < size
    number = belief.next_id + jnp.cumsum(taken, dtype=jnp.int32) - 1 if at is None else slot
    belief = belief._replace(
        mean=belief.mean.at[in_mean].set(place, **alone),
        anchor=belief.anchor.at[in_mean].set(place, **alone),
        cross_cov=belief.cross_cov.at[:, row].set(cross.T, **alone),
        map_cov=map_cov,
        seen=put(belief.seen, jnp.ones_like(slot)),
        last=put(belief.last, jnp.broadcast_to(belief.step, slot.shape)),
        kind=put(belief.kind, kind),
        id=put(belief.id, number),
        missed=put(belief.missed, jnp.zeros_like(slot)),
        looks=put(belief.looks, jnp.zeros_like(slot)),
        direction=put(belief.direction, wrap_angle(direction + pose[2])),
        shape=put(belief.shape, nodes.shape[order]),
        next_id=belief.next_id + jnp.sum(taken, dtype=jnp.int32),
    )
    return belief, jnp.full(wanted.shape, size, jnp.int32).at[order].set(slot)
