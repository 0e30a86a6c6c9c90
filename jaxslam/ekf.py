"""EKF-SLAM as pure functions: predict, innovations, update, augment.

The state is the robot's pose and two numbers a landmark slot: the position of a node or corner,
or the direction of a wall (and a zero). The algebra is structured: a prediction touches three
rows and columns, an update gathers the columns it needs, no dense F or H is ever built.

References:
    Paper, section 3, eqs. (1)-(16), with eq. (7) corrected: a bearing is relative to the robot's
    heading. Thrun, Burgard, Fox (2005), Probabilistic Robotics, chapter 10.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.association import claim_slots
from jaxslam.belief import Belief
from jaxslam.geometry import compose, range_bearing, rotation, to_world, wrap_angle, wrap_line
from jaxslam.nodes import Nodes
from jaxslam.types import CORNER, NODE, WALL, Array


class Innovations(NamedTuple):
    """Residuals of matched features and what they depend on; zero rows where unmatched."""

    residual: Array  # (M, 2) range [m] and bearing [rad], or direction [rad] and 0
    by_pose: Array  # (M, 2, 3) derivative of the expectation by the pose
    by_slot: Array  # (M, 2, 2) and by the landmark's two numbers
    noise: Array  # (M, 2, 2) covariance of the observation; identity where unmatched
    slot: Array  # (M,) int32, L where unmatched


def predict(belief: Belief, motion: Array, noise: Array) -> Belief:
    """Move the belief by odometry; landmarks stay.

        mean' = mean (+) motion        cov' = F cov F^T + G Q G^T

    Args:
        belief: Belief before the motion.
        motion: (3,) odometry increment, frame of the pose before it.
        noise: (3, 3) its covariance Q in the same frame.

    References:
        Paper, eqs. (3)-(5), (9)-(11).
    """
    pose = belief.pose
    moved = compose(pose, motion)
    # The heading alone changes the other rows: d(x, y) / d heading = (-dy, dx) of the way made.
    way = moved[:2] - pose[:2]
    lever = jnp.stack([-way[1], way[0]])
    cov = belief.cov
    cov = cov.at[:2].add(lever[:, None] * cov[2:3])
    cov = cov.at[:, :2].add(cov[:, 2:3] * lever[None])
    turn = jnp.eye(3, dtype=noise.dtype).at[:2, :2].set(rotation(pose[2]))
    return belief._replace(
        mean=belief.mean.at[:3].set(moved), cov=cov.at[:3, :3].add(turn @ noise @ turn.T)
    )


def observation(nodes: Nodes) -> Array:
    """Features as the filter sees them, (M, 2): range and bearing, or direction and 0."""
    polar = jax.vmap(range_bearing)(nodes.xy)
    wall = jnp.stack([nodes.direction, jnp.zeros_like(nodes.direction)], axis=-1)
    return jnp.where((nodes.kind == WALL)[:, None], wall, polar)


def polar_cov(xy: Array, cov: Array) -> Array:
    """Covariance (2, 2) of range and bearing of a point (2,) with covariance (2, 2)."""
    jacobian = jax.jacfwd(range_bearing)(xy)
    return jacobian @ cov @ jacobian.T


def expect(pose: Array, place: Array, kind: Array) -> tuple[Array, Array, Array]:
    """Expected observation (2,) of a slot (2,), and its derivatives by pose and slot.

    References:
        Paper, eqs. (6)-(8); the bearing of (7) corrected by the robot's heading.
    """
    offset = place - pose[:2]
    square = jnp.sum(offset**2)
    away = square > 1e-8
    square = jnp.where(away, square, 1.0)
    distance = jnp.sqrt(square)
    dx, dy = jnp.where(away, offset, jnp.array([1.0, 0.0], offset.dtype))
    bearing = wrap_angle(jnp.arctan2(dy, dx) - pose[2])
    zero, one = jnp.zeros_like(dx), jnp.ones_like(dx)
    by_slot = jnp.stack(
        [jnp.stack([dx / distance, dy / distance]), jnp.stack([-dy / square, dx / square])]
    )
    by_pose = jnp.concatenate([-by_slot, jnp.stack([zero, -one])[:, None]], axis=1)
    polar = jnp.stack([jnp.where(away, distance, 0.0), bearing])
    is_wall = kind == WALL
    wall = jnp.stack([wrap_line(place[0] - pose[2]), zero])
    wall_by_pose = jnp.zeros((2, 3), offset.dtype).at[0, 2].set(-1.0)
    wall_by_slot = jnp.zeros((2, 2), offset.dtype).at[0, 0].set(1.0)
    return (
        jnp.where(is_wall, wall, polar),
        jnp.where(is_wall, wall_by_pose, by_pose),
        jnp.where(is_wall, wall_by_slot, by_slot),
    )


def residual(seen: Array, expected: Array, kind: Array) -> Array:
    """Difference (..., 2) of observations; the one place where angles are wrapped."""
    error = seen - expected
    wall = jnp.stack([wrap_line(error[..., 0]), jnp.zeros_like(error[..., 0])], axis=-1)
    polar = jnp.stack([error[..., 0], wrap_angle(error[..., 1])], axis=-1)
    return jnp.where((kind == WALL)[..., None], wall, polar)


def distances(belief: Belief, nodes: Nodes, noise: Array) -> Array:
    """Squared Mahalanobis distance (M, L) of every feature to every slot.

    Args:
        belief: Predicted belief.
        nodes: Features of the scan.
        noise: (M, 2, 2) their covariance.
    """
    size = belief.seen.size
    expected, by_pose, by_slot = jax.vmap(expect, in_axes=(None, 0, 0))(
        belief.pose, belief.places, belief.kind
    )
    across = belief.cov[:3, 3:].reshape(3, size, 2).transpose(1, 0, 2)  # (L, 3, 2)
    index = jnp.arange(size)
    own = belief.cov[3:, 3:].reshape(size, 2, size, 2)[index, :, index]  # (L, 2, 2)
    mixed = jnp.einsum("lij,ljk,lmk->lim", by_pose, across, by_slot)
    spread = jnp.einsum("lij,jk,lmk->lim", by_pose, belief.pose_cov, by_pose)
    spread += mixed + jnp.swapaxes(mixed, 1, 2)
    spread += jnp.einsum("lij,ljk,lmk->lim", by_slot, own, by_slot)
    error = residual(observation(nodes)[:, None], expected[None], belief.kind[None])  # (M, L, 2)
    s = spread[None] + noise[:, None]
    a, b, d = s[..., 0, 0], 0.5 * (s[..., 0, 1] + s[..., 1, 0]), s[..., 1, 1]
    determinant = jnp.maximum(a * d - b * b, 1e-12)
    x, y = error[..., 0], error[..., 1]
    return (d * x * x - 2 * b * x * y + a * y * y) / determinant


def innovations(belief: Belief, nodes: Nodes, noise: Array, slot: Array) -> Innovations:
    """Residuals of the features whose slot (M,) is not L.

    Args:
        belief: Predicted belief.
        nodes: Features of the scan.
        noise: (M, 2, 2) their covariance.
        slot: (M,) int32 matched slots, L where a feature is unmatched.

    References:
        Paper, eqs. (12), (13).
    """
    matched = slot < belief.seen.size
    at = jnp.where(matched, slot, 0)
    kind = nodes.kind
    expected, by_pose, by_slot = jax.vmap(expect, in_axes=(None, 0, 0))(
        belief.pose, belief.places[at], kind
    )
    keep = matched[:, None]
    eye = jnp.eye(2, dtype=noise.dtype)
    return Innovations(
        residual=jnp.where(keep, residual(observation(nodes), expected, kind), 0.0),
        by_pose=jnp.where(keep[..., None], by_pose, 0.0),
        by_slot=jnp.where(keep[..., None], by_slot, 0.0),
        noise=jnp.where(keep[..., None], noise, eye),
        slot=at,
    )


def whiten(s: Array, b: Array) -> tuple[Array, Array]:
    """Return L^-1 b (n, k) and log det S () of S = L L^T (n, n), for b (n, k).

    Forward elimination of [S, b] in array operations alone: programs that call LAPACK can hang when
    several run at once on the threads of one CPU. Unrolled, what is left gets smaller with each
    row, and stays where it is: a scan over the rows takes five times as long.
    """
    n = s.shape[0]
    left, white, logs = jnp.concatenate([s, b], axis=1), [], []
    for k in range(n):
        pivot = left[0, 0]
        # S is positive definite; if rounding or nonsense made it otherwise, say so with NaN.
        row = left[0] / jnp.sqrt(jnp.where(pivot > 0.0, pivot, jnp.nan))
        # The column below the pivot is the row to its right: S stays symmetric.
        left = left[1:, 1:] - row[1 : n - k, None] * row[None, 1:]
        white.append(row[n - k :])
        logs.append(jnp.log(pivot))
    return jnp.stack(white), sum(logs)


def update(belief: Belief, seen: Innovations) -> tuple[Belief, Array, Array]:
    """Condition on all innovations of a scan at once.

        S = H P H^T + R,   S = L L^T,   Y = L^-1 H P,   P' = P - Y^T Y,   mean' = mean + Y^T L^-1 v

    P stays symmetric by construction, and no inverse is taken.

    Returns:
        The belief, the squared Mahalanobis norm () of the residuals, and the logarithm () of the
        determinant of S; padding adds nothing to either.

    References:
        Paper, eqs. (14)-(16).
    """
    m = seen.slot.size
    cov = belief.cov
    slots = cov[3:].reshape(-1, 2, cov.shape[1])[seen.slot]  # (M, 2, D)
    hp = jnp.sum(seen.by_pose[..., None] * cov[None, None, :3], axis=2)
    hp += jnp.sum(seen.by_slot[..., None] * slots[:, None], axis=2)
    hp = hp.reshape(2 * m, -1)  # (2M, D)
    gathered = hp[:, 3:].reshape(2 * m, -1, 2)[:, seen.slot]  # (2M, M, 2)
    s = jnp.einsum("ri,mki->rmk", hp[:, :3], seen.by_pose)
    s += jnp.einsum("rmi,mki->rmk", gathered, seen.by_slot)
    index = jnp.arange(m)
    s = s.reshape(m, 2, m, 2).at[index, :, index].add(seen.noise).reshape(2 * m, 2 * m)
    white, logdet = whiten(s, jnp.concatenate([hp, seen.residual.reshape(-1, 1)], axis=1))
    y, v = white[:, :-1], white[:, -1]
    mean = belief.mean + v @ y
    mean = mean.at[2].set(wrap_angle(mean[2]))
    return belief._replace(mean=mean, cov=cov - y.T @ y), v @ v, logdet


def augment(
    belief: Belief, nodes: Nodes, noise: Array, wanted: Array, *, most: int, at: Array | None = None
) -> tuple[Belief, Array]:
    """Take features in as new landmarks, correlated with all the state as they should be.

        l = g(pose, z),   P_l* = G_p P_p*,   P_ll = G_p P_pp G_p^T + G_z R G_z^T

    Args:
        belief: Updated belief.
        nodes: Features of the scan.
        noise: (M, 2, 2) their covariance in range and bearing, or in direction and 0.
        wanted: (M,) bool, features to take in.
        most: How many at most; the first come first.
        at: (M,) int32 slot that each is to get, which is its id too; by default the first that
            are free, and the next ids.

    Returns:
        The belief, and the slot (M,) that each feature got, L for none.
    """
    size = belief.seen.size
    # Put the wanted features first, so that a few rows suffice.
    order = jnp.argsort(~wanted, stable=True)[:most]
    if at is None:
        slot = claim_slots(belief.seen == 0, wanted[order])
    else:
        slot = jnp.where(wanted, at, size)[order]
    xy, kind, direction = nodes.xy[order], nodes.kind[order], nodes.direction[order]
    is_wall = (kind == WALL)[:, None]
    pose = belief.pose
    place = to_world(pose, xy)
    wall = jnp.stack([wrap_line(direction + pose[2]), jnp.zeros_like(direction)], axis=-1)
    arm = place - pose[None, :2]
    zero, one = jnp.zeros_like(direction), jnp.ones_like(direction)
    by_pose = jnp.stack(
        [jnp.stack([one, zero, -arm[:, 1]], -1), jnp.stack([zero, one, arm[:, 0]], -1)], axis=1
    )
    turns = jnp.zeros_like(by_pose).at[:, 0, 2].set(1.0)
    by_pose = jnp.where(is_wall[..., None], turns, by_pose)
    # d (x, y) / d (range, bearing) in the world frame is (arm / range, arm turned left).
    far = jnp.sqrt(jnp.maximum(jnp.sum(xy**2, axis=1), 1e-8))
    by_seen = jnp.stack([arm / far[:, None], jnp.stack([-arm[:, 1], arm[:, 0]], -1)], axis=-1)
    first = jnp.zeros_like(by_seen).at[:, 0, 0].set(1.0)
    by_seen = jnp.where(is_wall[..., None], first, by_seen)

    rows = jnp.einsum("mij,jd->mid", by_pose, belief.cov[:3])  # (F, 2, D)
    among = jnp.einsum("mij,jk,nlk->minl", by_pose, belief.pose_cov, by_pose)
    index = jnp.arange(most)
    own = jnp.einsum("mij,mjk,mlk->mil", by_seen, noise[order], by_seen)
    among = among.at[index, :, index].add(own)  # (F, 2, F, 2)
    row = jnp.where(slot < size, 3 + 2 * slot, 3 + 2 * size)
    row = jnp.stack([row, jnp.minimum(row + 1, 3 + 2 * size)], axis=-1).reshape(-1)
    rows = rows.reshape(2 * most, -1).at[:, row].set(among.reshape(2 * most, -1), mode="drop")
    cov = belief.cov.at[row].set(rows, mode="drop").at[:, row].set(rows.T, mode="drop")
    mean = belief.mean.at[row].set(jnp.where(is_wall, wall, place).reshape(-1), mode="drop")

    def put(field: Array, value: Array) -> Array:
        return field.at[slot].set(value.astype(field.dtype), mode="drop")

    taken = slot < size
    number = belief.next_id + jnp.cumsum(taken, dtype=jnp.int32) - 1 if at is None else slot
    belief = belief._replace(
        mean=mean,
        cov=cov,
        seen=put(belief.seen, jnp.ones_like(slot)),
        last=put(belief.last, jnp.broadcast_to(belief.step, slot.shape)),
        kind=put(belief.kind, kind),
        id=put(belief.id, number),
        direction=put(belief.direction, wrap_angle(direction + pose[2])),
        shape=put(belief.shape, nodes.shape[order]),
        next_id=belief.next_id + jnp.sum(taken, dtype=jnp.int32),
    )
    return belief, jnp.full(wanted.shape, size, jnp.int32).at[order].set(slot)


def alike(belief: Belief, nodes: Nodes, *, shape: float, turn: float) -> Array:
    """Pairs (M, L) bool of feature and slot that could be one thing, wherever they are.

    Same kind; nodes of like clearance (`shape`, in logarithm), corners of like angle that face
    like directions (`turn` [rad]).
    """
    same = nodes.kind[:, None] == belief.kind[None]
    same &= (belief.seen > 0)[None] & nodes.valid[:, None]
    ratio = jnp.maximum(nodes.shape[:, None], 1e-3) / jnp.maximum(belief.shape[None], 1e-3)
    clearance = jnp.abs(jnp.log(ratio)) < shape
    facing = wrap_angle(nodes.direction[:, None] + belief.pose[2] - belief.direction[None])
    opening = nodes.shape[:, None] - belief.shape[None]
    corner = (jnp.abs(facing) < turn) & (jnp.abs(opening) < turn)
    kind = nodes.kind[:, None]
    return same & jnp.where(kind == NODE, clearance, jnp.where(kind == CORNER, corner, True))
